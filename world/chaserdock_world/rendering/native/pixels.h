/* Grey levels in blocks of 32, which may begin anywhere. Most blocks of an image are empty space, all of one level. */
#ifndef CHASERDOCK_PIXELS_H
#define CHASERDOCK_PIXELS_H

#include "base.h"

#define BLOCK 32

typedef uint8_t u8x16 __attribute__((vector_size(16), aligned(1), may_alias));
typedef uint8_t u8x32 __attribute__((vector_size(32), aligned(1), may_alias));
typedef uint16_t u16x16 __attribute__((vector_size(32), aligned(2), may_alias));
typedef int32_t i32x16 __attribute__((vector_size(64), aligned(4), may_alias));
typedef float f32x16 __attribute__((vector_size(64), aligned(4), may_alias));
typedef uint64_t word __attribute__((aligned(1), may_alias));

/* The level that all pixels of a block have, or -1. */
static inline int level_of_block(const uint8_t *pixels) {
    const word *w = (const word *)pixels;
    uint64_t same = pixels[0] * 0x0101010101010101ull;
    return ((w[0] ^ same) | (w[1] ^ same) | (w[2] ^ same) | (w[3] ^ same)) ? -1 : pixels[0];
}

#endif
