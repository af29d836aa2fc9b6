/* SPDX-License-Identifier: Apache-2.0 */
/* Selection of the kernel copy for this processor, and the digest of the sources. */
#include <stdint.h>

#define EXPORT __attribute__((visibility("default")))

/* SHA-256 of the sources; detects a library that is older than its sources. */
EXPORT const char *source_digest(void) { return SOURCE_DIGEST; }

#if defined(__x86_64__)
#include <cpuid.h>

/* Return 3 if the processor has x86-64-v3 (AVX2 and its companions) and the system saves the
 * registers (Intel SDM, volume 1, 14.3 and 14.7.1), else 2. */
EXPORT int64_t level(void) {
    unsigned a, b, c, d, low, high;
    if (!__get_cpuid(1, &a, &b, &c, &d) || !(c & bit_OSXSAVE) || !(c & bit_AVX) || !(c & bit_FMA) ||
        !(c & bit_MOVBE) || !(c & bit_F16C))
        return 2;
    __asm__("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    if ((low & 6) != 6) return 2;
    if (!__get_cpuid_count(7, 0, &a, &b, &c, &d) || !(b & bit_AVX2) || !(b & bit_BMI) ||
        !(b & bit_BMI2))
        return 2;
    if (!__get_cpuid(0x80000001, &a, &b, &c, &d) || !(c & bit_LZCNT)) return 2;
    return 3;
}
#else
EXPORT int64_t level(void) { return 0; }
#endif

/* The compiler emits calls to these two functions; defining them avoids a C library. */
#if defined(__linux__)
void *memset(void *to, int value, unsigned long count) {
    char *at = to;
    for (unsigned long i = 0; i < count; i++) at[i] = (char)value;
    return to;
}
void *memcpy(void *to, const void *from, unsigned long count) {
    char *at = to;
    const char *source = from;
    for (unsigned long i = 0; i < count; i++) at[i] = source[i];
    return to;
}
#endif
