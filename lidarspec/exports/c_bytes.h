#include <stddef.h>
#include <stdint.h>
#include <string.h>

#ifdef __cplusplus
extern "C" {
#endif

#ifndef LIDARSPEC_BYTES
#define LIDARSPEC_BYTES
static inline uint64_t lidarspec_le(const uint8_t *p, int size)
{
    uint64_t value = 0;
    while (size-- > 0)
        value = value << 8 | p[size];
    return value;
}
static inline uint64_t lidarspec_be(const uint8_t *p, int size)
{
    uint64_t value = 0;
    while (size-- > 0)
        value = value << 8 | *p++;
    return value;
}
static inline int64_t lidarspec_signed(uint64_t value, int width)
{
    const uint64_t sign = UINT64_C(1) << (width - 1);
    return value & sign ? -(int64_t)(~value & (sign - 1)) - 1 : (int64_t)value;
}
static inline float lidarspec_float(uint64_t bits)
{
    const uint32_t word = (uint32_t)bits;
    float value;
    memcpy(&value, &word, sizeof value);
    return value;
}
static inline double lidarspec_double(uint64_t bits)
{
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}
static inline float lidarspec_half(uint64_t bits)
{
    const uint32_t sign = (uint32_t)(bits & 0x8000) << 16, exponent = (uint32_t)(bits >> 10) & 31, fraction = (uint32_t)bits & 0x3ff;
    if (exponent == 0) return (sign ? -1.0f : 1.0f) * (float)fraction / 16777216.0f;
    return lidarspec_float(sign | (exponent == 31 ? 0x7f800000u : (exponent + 112) << 23) | fraction << 13);
}
static inline int64_t lidarspec_int(int64_t value) { return value; }
static inline int lidarspec_within(int64_t value, int64_t most) { return value >= 0 && value <= most; }
static inline int64_t lidarspec_floor_div(int64_t a, int64_t b)
{
    return b == 0 ? 0 : a / b - (a % b != 0 && (a % b < 0) != (b < 0));
}
static inline int64_t lidarspec_floor_mod(int64_t a, int64_t b)
{
    return b == 0 ? 0 : a - b * lidarspec_floor_div(a, b);
}
static inline uint64_t lidarspec_mirrored(uint64_t value, int width)
{
    uint64_t mirrored = 0;
    for (; width > 0; --width, value >>= 1)
        mirrored = mirrored << 1 | (value & 1);
    return mirrored;
}
static inline uint64_t lidarspec_swapped(uint64_t value, int size)
{
    uint64_t swapped = 0;
    for (; size > 0; --size, value >>= 8)
        swapped = swapped << 8 | (value & 0xff);
    return swapped;
}
#endif
