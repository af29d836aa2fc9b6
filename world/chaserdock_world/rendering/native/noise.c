/* Noise on an image. */
#include "pixels.h"

/* Added, 1.5 * 2^23 rounds a float of less than 2^22 to the nearest whole number, halves to even, which its bits then show. */
#define WHOLE 12582912.0f
#define WHOLE_BITS 0x4b400000

/* out = image + rounded noise, within 0 to 255. ``deviation``: grey levels of standard deviation over the bank's steps. */
static inline uint8_t noisy(uint8_t level, float deviation, int16_t white) {
    union { float f; int32_t i; } rounded;
    float noise = deviation * (float)white;
    noise = noise > 255.0f ? 255.0f : (noise < -255.0f ? -255.0f : noise);
    rounded.f = noise + WHOLE;
    int32_t sum = level + (rounded.i - WHOLE_BITS);
    return (uint8_t)(sum < 0 ? 0 : (sum > 255 ? 255 : sum));
}

/* out = image + noise, rounded, within 0 to 255. ``image`` and ``out`` (rows, columns), which may be the same; ``bank``: white
 * noise in fixed point, ``stride`` apart from row to row; ``sigma`` (256): standard deviation by grey level, in fixed point;
 * ``scale``, a power of two with the noise's sign, makes grey levels of their product (so that it matters not which of them
 * it is multiplied with first). */
EXPORT void NAME(add_noise)(const uint8_t *image, const int16_t *bank, int64_t stride, const int16_t *sigma, double scale,
                           int64_t rows, int64_t columns, uint8_t *out) {
    float by_level[256];
    for (int i = 0; i < 256; i++) by_level[i] = (float)sigma[i] * (float)scale;
    for (int64_t r = 0; r < rows; r++, image += columns, out += columns, bank += stride) {
        int64_t first = 0;
        for (; first + BLOCK <= columns; first += BLOCK) {
            float deviation[BLOCK];
            int level = level_of_block(image + first);
            if (level >= 0) {
                float one = by_level[level];
                for (int i = 0; i < BLOCK; i++) out[first + i] = noisy((uint8_t)level, one, bank[first + i]);
                continue;
            }
            for (int i = 0; i < BLOCK; i++) deviation[i] = by_level[image[first + i]];
            for (int i = 0; i < BLOCK; i++) out[first + i] = noisy(image[first + i], deviation[i], bank[first + i]);
        }
        for (; first < columns; first++) out[first] = noisy(image[first], by_level[image[first]], bank[first]);
    }
}
