/* SPDX-License-Identifier: Apache-2.0 */
/* Blurs a supersampled image and averages it to pixels in one pass. */
#include "base.h"

/* Samples of a row that are worked on at once: they stay in the first cache. */
#define STRIP 64

static inline int64_t within(int64_t i, int64_t most) { return i < 0 ? 0 : i > most ? most : i; }

/* Write the image (height, width) of samples ``fine`` (2 height, 2 width): each pixel is their mean
 * by ``weights`` (2 reach + 2) along both axes, which add up to 256; samples beyond the border are
 * as the nearest one. ``work``: 4 (width + reach + 1). */
EXPORT void NAME(spread_and_halve)(const uint8_t *restrict fine, int64_t height, int64_t width,
                                   const uint16_t *restrict weights, int64_t reach,
                                   uint8_t *restrict out, uint16_t *restrict work) {
    /* A row of sums along the columns, with `reach` more on either side; then its even and odd
     * ones apart. */
    const int64_t samples = 2 * width, half = width + reach + 1;
    uint16_t *restrict sums = work + reach, *restrict even = work + 2 * half,
                       *restrict odd = even + half;
    for (int64_t y = 0; y < height; y++, out += width) {
        for (int64_t first = 0; first < samples; first += STRIP) {
            uint16_t strip[STRIP] = {0};
            int64_t count = samples - first < STRIP ? samples - first : STRIP;
            for (int64_t k = 0; k < 2 * reach + 2; k++) {
                const uint16_t w = weights[k];
                const uint8_t *restrict row =
                    fine + samples * within(2 * y - reach + k, 2 * height - 1) + first;
                if (count == STRIP)
                    for (int i = 0; i < STRIP; i++) strip[i] = (uint16_t)(strip[i] + w * row[i]);
                else
                    for (int64_t i = 0; i < count; i++)
                        strip[i] = (uint16_t)(strip[i] + w * row[i]);
            }
            for (int64_t i = 0; i < count; i++) sums[first + i] = strip[i];
        }
        for (int64_t i = 1; i <= reach; i++) {
            sums[-i] = sums[0];
            sums[samples - 1 + i] = sums[samples - 1];
        }
        for (int64_t i = 0; i < half; i++) even[i] = work[2 * i], odd[i] = work[2 * i + 1];
        for (int64_t first = 0; first < width; first += STRIP) {
            uint32_t strip[STRIP];
            int64_t count = width - first < STRIP ? width - first : STRIP;
            for (int i = 0; i < STRIP; i++) strip[i] = 1u << 15;
            for (int64_t k = 0; k <= reach; k++) {
                const uint32_t a = weights[2 * k], b = weights[2 * k + 1];
                const uint16_t *restrict e = even + first + k, *restrict o = odd + first + k;
                if (count == STRIP)
                    for (int i = 0; i < STRIP; i++) strip[i] += a * e[i] + b * o[i];
                else
                    for (int64_t i = 0; i < count; i++) strip[i] += a * e[i] + b * o[i];
            }
            for (int64_t i = 0; i < count; i++) out[first + i] = (uint8_t)(strip[i] >> 16);
        }
    }
}
