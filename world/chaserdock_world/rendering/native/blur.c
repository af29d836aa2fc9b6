/* Gaussian blur in fixed point, to the bit OpenCV's of 8-bit images, several times faster where an image is even. */
#include "pixels.h"

/* Pixels -radius..columns + radius of a block from ``first`` on, beyond the row its last ones again. */
static const uint8_t *around(const uint8_t *row, int64_t columns, int64_t first, int64_t radius, uint8_t *own) {
    if (first >= radius && first + BLOCK + radius <= columns) return row + first - radius;
    for (int64_t i = 0; i < BLOCK + 2 * radius; i++) {
        int64_t at = first - radius + i;
        own[i] = row[at < 0 ? 0 : (at < columns ? at : columns - 1)];
    }
    return own;
}

/* Sums along a row, (BLOCK): at most 255 * 256. */
static inline void blur_across(const uint8_t *pixels, const uint16_t *taps, int64_t radius, float *out) {
    for (int half = 0; half < BLOCK; half += 16) {
        const uint8_t *p = pixels + half + radius;
        u16x16 sum = __builtin_convertvector(*(const u8x16 *)p, u16x16) * taps[radius];
        for (int64_t j = 1; j <= radius; j++)
            sum += (__builtin_convertvector(*(const u8x16 *)(p - j), u16x16) +
                    __builtin_convertvector(*(const u8x16 *)(p + j), u16x16)) * taps[radius - j];
        *(f32x16 *)(out + half) = __builtin_convertvector(sum, f32x16);
    }
}

/* Of a row's blocks, the level that each and its two neighbours have, or -1. ``row``: working memory, two more than blocks. */
static void levels_of_row(const uint8_t *pixels, int64_t columns, int64_t blocks, int32_t *row, int32_t *about) {
    uint8_t own[BLOCK];
    for (int64_t b = 0; b < columns / BLOCK; b++) row[b + 1] = level_of_block(pixels + b * BLOCK);
    if (columns % BLOCK) row[blocks] = level_of_block(around(pixels, columns, (blocks - 1) * BLOCK, 0, own));
    row[0] = row[1], row[blocks + 1] = row[blocks];
    for (int64_t b = 0; b < blocks; b++)
        about[b] = (row[b] ^ row[b + 1]) | (row[b + 2] ^ row[b + 1]) ? -1 : row[b + 1];
}

/* out = image blurred across and down by ``taps`` (2 radius + 1), symmetric, of sum 256; beyond its border the image goes on
 * as it ends. ``image`` and ``out`` (rows, columns). Radius at most BLOCK. Working
 * memory, by blocks: ``sums`` (2 radius + 1, blocks, BLOCK), ``levels`` (2 radius + 5, blocks + 2), ``made`` (2 radius + 1,
 * blocks).
 *
 * Where all within reach is of one level, so is the result. Elsewhere each sum along a row is made once, when it is first
 * asked for. All sums are whole numbers below 2^24, which floats hold exactly. */
EXPORT void NAME(blur)(const uint8_t *image, int64_t rows, int64_t columns, const uint16_t *taps, int64_t radius, float *sums,
                      int32_t *levels, int32_t *made, uint8_t *out) {
    int64_t width = 2 * radius + 1, blocks = (columns + BLOCK - 1) / BLOCK, slot[2 * BLOCK + 1];
    int32_t *row = levels + width * blocks, *differs = row + blocks + 2;
    uint8_t own[3 * BLOCK], last[BLOCK];
    for (int64_t i = 0; i < width * blocks; i++) made[i] = -1;
    for (int64_t y = 0, known = 0; y < rows; y++, out += columns) {
        int64_t low = y < radius ? 0 : y - radius, high = y + radius < rows ? y + radius : rows - 1;
        /* The rows that come into reach: which of their blocks are even. */
        for (; known <= high; known++)
            levels_of_row(image + known * columns, columns, blocks, row, levels + (known % width) * blocks);
        for (int64_t k = low; k <= high; k++) slot[k - low] = (k % width) * blocks;
        for (int64_t b = 0; b < blocks; b++) differs[b] = levels[slot[0] + b] >> 31;
        for (int64_t k = 1; k <= high - low; k++)
            for (int64_t b = 0; b < blocks; b++) differs[b] |= levels[slot[k] + b] ^ levels[slot[0] + b];
        for (int64_t b = 0; b < blocks; b++) {
            int64_t first = b * BLOCK, count = columns - first < BLOCK ? columns - first : BLOCK;
            uint8_t *to = count == BLOCK ? out + first : last;
            if (!differs[b]) {
                *(u8x32 *)to = (u8x32){0} + (uint8_t)levels[slot[0] + b];
            } else {
                f32x16 sum[2] = {(f32x16){0} + 32768.0f, (f32x16){0} + 32768.0f};
                for (int64_t j = 0; j < width; j++) {
                    int64_t k = y - radius + j, place;
                    k = k < low ? low : (k > high ? high : k);
                    place = slot[k - low] + b;
                    float *across = sums + place * BLOCK;
                    if (made[place] != (int32_t)k) {
                        blur_across(around(image + k * columns, columns, first, radius, own), taps, radius, across);
                        made[place] = (int32_t)k;
                    }
                    for (int half = 0; half < 2; half++) sum[half] += *(f32x16 *)(across + 16 * half) * (float)taps[j];
                }
                for (int half = 0; half < 2; half++)
                    *(u8x16 *)(to + 16 * half) =
                        __builtin_convertvector(__builtin_convertvector(sum[half], i32x16) >> 16, u8x16);
            }
            if (count < BLOCK)
                for (int64_t i = 0; i < count; i++) out[first + i] = last[i];
        }
    }
}
