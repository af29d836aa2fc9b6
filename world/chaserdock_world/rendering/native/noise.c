/* SPDX-License-Identifier: Apache-2.0 */
/* Adds grey-level dependent noise to an image. */
#include "base.h"

/* Pixels processed at once. Most blocks of an image are empty space of one grey level. */
#define BLOCK 32

typedef uint64_t word __attribute__((aligned(1), may_alias));

/* Adding 1.5 * 2^23 rounds a float of less than 2^22 to the nearest integer, ties to even, in the
 * low bits of the sum. */
#define WHOLE 12582912.0f
#define WHOLE_BITS 0x4b400000 /* WHOLE as an integer */

/* The level that all pixels of a block have, or -1. */
static inline int level_of_block(const uint8_t *pixels) {
    const word *w = (const word *)pixels;
    uint64_t same = pixels[0] * 0x0101010101010101ull;
    return ((w[0] ^ same) | (w[1] ^ same) | (w[2] ^ same) | (w[3] ^ same)) ? -1 : pixels[0];
}

/* A level with noise, rounded and limited to 0..255. ``deviation``: grey levels of standard
 * deviation per unit of ``white``. */
static inline uint8_t noisy(uint8_t level, float deviation, int16_t white) {
    union { float f; int32_t i; } rounded;
    float noise = deviation * (float)white;
    noise = noise > 255.0f ? 255.0f : (noise < -255.0f ? -255.0f : noise);
    rounded.f = noise + WHOLE;
    int32_t sum = level + (rounded.i - WHOLE_BITS);
    return (uint8_t)(sum < 0 ? 0 : (sum > 255 ? 255 : sum));
}

/* out = image + noise, rounded and limited to 0..255. ``image`` and ``out`` (rows, columns) may be
 * the same array; ``bank``: white noise in fixed point with row stride ``stride``; ``sigma`` (256):
 * standard deviation by grey level, in fixed point;
 * ``scale``: grey levels per unit of their product, a power of two with the noise's sign, so that
 * the order of the products does not change the result; NaN gives any level. */
EXPORT void NAME(add_noise)(const uint8_t *image, const int16_t *bank, int64_t stride,
                            const int16_t *sigma, double scale, int64_t rows, int64_t columns,
                            uint8_t *out) {
    float by_level[256];
    for (int i = 0; i < 256; i++) by_level[i] = (float)sigma[i] * (float)scale;
    for (int64_t r = 0; r < rows; r++, image += columns, out += columns, bank += stride) {
        int64_t first = 0;
        for (; first + BLOCK <= columns; first += BLOCK) {
            float deviation[BLOCK];
            int level = level_of_block(image + first);
            if (level >= 0) {
                float one = by_level[level];
                for (int i = 0; i < BLOCK; i++)
                    out[first + i] = noisy((uint8_t)level, one, bank[first + i]);
                continue;
            }
            for (int i = 0; i < BLOCK; i++) deviation[i] = by_level[image[first + i]];
            for (int i = 0; i < BLOCK; i++)
                out[first + i] = noisy(image[first + i], deviation[i], bank[first + i]);
        }
        for (; first < columns; first++)
            out[first] = noisy(image[first], by_level[image[first]], bank[first]);
    }
}
