/* Noise on a picture. */
#include "base.h"

/* out = image + noise, rounded, within 0 to 255. ``image`` and ``out`` (rows, columns); ``bank``: white noise in fixed point,
 * ``stride`` apart from row to row; ``sigma`` (256): standard deviation by grey level, in fixed point; ``scale``, a power of
 * two with the noise's sign, makes grey levels of their product. */
EXPORT void NAME(add_noise)(const uint8_t *image, const int16_t *bank, int64_t stride, const int16_t *sigma, double scale,
                           int64_t rows, int64_t columns, uint8_t *out) {
    int16_t deviation[256];
    /* Added and taken away again, 1.5 * 2^23 rounds a float of less than 2^22 to the nearest whole number, halves to even. */
    const float whole = 12582912.0f, to_levels = (float)scale;
    for (int64_t r = 0; r < rows; r++, image += columns, out += columns, bank += stride)
        for (int64_t first = 0; first < columns; first += 256) {
            int64_t n = columns - first < 256 ? columns - first : 256;
            for (int64_t i = 0; i < n; i++) deviation[i] = sigma[image[first + i]];
            for (int64_t i = 0; i < n; i++) {
                float noise = (float)deviation[i] * (float)bank[first + i] * to_levels;
                noise = noise > 255.0f ? 255.0f : (noise < -255.0f ? -255.0f : noise);
                int32_t level = (int32_t)image[first + i] + (int32_t)((noise + whole) - whole);
                out[first + i] = (uint8_t)(level < 0 ? 0 : (level > 255 ? 255 : level));
            }
        }
}
