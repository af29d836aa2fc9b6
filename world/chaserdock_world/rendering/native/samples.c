/* Several samples to a pixel: from an image to its samples and back, to the bit as OpenCV resizes. */
#include "pixels.h"

typedef uint32_t four __attribute__((aligned(1), may_alias));
typedef uint16_t two __attribute__((aligned(1), may_alias));

/* fine (n rows, n columns) = the levels of ``view`` (rows, columns; ``stride`` from row to row), each n x n times. n: 2, 4. */
EXPORT void NAME(spread_samples)(const uint8_t *view, int64_t stride, int64_t rows, int64_t columns, int64_t n,
                                uint8_t *fine) {
    for (int64_t y = 0; y < rows; y++, view += stride) {
        int64_t width = n * columns;
        uint8_t *to = fine + y * n * width;
        if (n == 4)
            for (int64_t x = 0; x < columns; x++) {
                uint32_t level = view[x] * 0x01010101u;
                ((four *)to)[x] = level, ((four *)(to + width))[x] = level;
                ((four *)(to + 2 * width))[x] = level, ((four *)(to + 3 * width))[x] = level;
            }
        else
            for (int64_t x = 0; x < columns; x++) {
                uint16_t level = (uint16_t)(view[x] * 0x0101u);
                ((two *)to)[x] = level, ((two *)(to + width))[x] = level;
            }
    }
}

/* view = means of the n x n samples of each pixel, rounded: halves up for n = 2, to even for n = 4. */
EXPORT void NAME(mean_of_samples)(const uint8_t *fine, int64_t rows, int64_t columns, int64_t n, uint8_t *view,
                                 int64_t stride) {
    for (int64_t y = 0; y < rows; y++, view += stride) {
        int64_t width = n * columns;
        const uint8_t *from = fine + y * n * width;
        if (n == 4)
            for (int64_t x = 0; x < columns; x++) {
                uint32_t pairs = 0;
                for (int r = 0; r < 4; r++) {
                    uint32_t s = ((const four *)(from + r * width))[x];
                    pairs += (s & 0x00ff00ffu) + ((s >> 8) & 0x00ff00ffu);
                }
                uint32_t sum = (pairs & 0xffffu) + (pairs >> 16);
                view[x] = (uint8_t)((sum + 7u + ((sum >> 4) & 1u)) >> 4);
            }
        else
            for (int64_t x = 0; x < columns; x++) {
                uint32_t a = ((const two *)from)[x], b = ((const two *)(from + width))[x];
                view[x] = (uint8_t)(((a & 0xffu) + (a >> 8) + (b & 0xffu) + (b >> 8) + 2u) >> 2);
            }
    }
}
