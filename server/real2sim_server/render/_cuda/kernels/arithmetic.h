// Functions that are bitwise equal on all devices. They only use operations that IEEE 754 rounds
// exactly, compiled without contraction; fmaf is explicit.
#pragma once

// e^-x for x in [0, 80], with a relative error of 3e-7 for x < 6: 2^n by the exponent, the rest by a
// polynomial.
__device__ __forceinline__ float exp_negative(float x) {
    const float n = rintf(x * -1.44269504f);
    const float f = fmaf(x, -1.44269504f, -n);
    float p = 1.5403530e-4f;
    p = fmaf(p, f, 1.3333558e-3f);
    p = fmaf(p, f, 9.6181291e-3f);
    p = fmaf(p, f, 5.5504109e-2f);
    p = fmaf(p, f, 2.4022651e-1f);
    p = fmaf(p, f, 6.9314718e-1f);
    p = fmaf(p, f, 1.0f);
    return __uint_as_float(__float_as_uint(p) + (uint32(int(n)) << 23));
}

// Natural logarithm of x in [1, 1e6], relative error 2e-7, by the exponent and the series of atanh.
__device__ __forceinline__ float log_of(float x) {
    int bits = __float_as_int(x) - 0x3f3504f3;
    const int n = bits >> 23;
    const float m = __int_as_float((bits & 0x7fffff) + 0x3f3504f3);
    const float s = (m - 1.0f) / (m + 1.0f);
    const float q = s * s;
    float p = fmaf(q, 2.0f / 9.0f, 2.0f / 7.0f);
    p = fmaf(p, q, 2.0f / 5.0f);
    p = fmaf(p, q, 2.0f / 3.0f);
    p = fmaf(p, q, 2.0f);
    return fmaf(float(n), 0.69314718f, p * s);
}

__device__ __forceinline__ uint32 saturating_sum(uint32 a, uint32 b) {
    const uint32 sum = a + b;
    return sum < a ? 0xffffffffu : sum;
}

__device__ __forceinline__ uint32 bits_before(uint32 mask, uint32 lane) {
    return __popc(mask & ((1u << lane) - 1u));
}
