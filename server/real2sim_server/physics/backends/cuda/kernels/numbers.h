// Numbers and what is done with them, by the names that translated functions call them.
#pragma once

typedef unsigned int uint32;
typedef unsigned long long uint64;

template <class T, int N> struct Numbers {
    T at[N];
    __device__ __forceinline__ T& operator[](int n) { return at[n]; }
    __device__ __forceinline__ const T& operator[](int n) const { return at[n]; }
};
template <class T> struct alignas(16) Four { T x, y, z, w; };

constexpr double INFINITE = 1.7e308;  // Beyond all that is compared with it.

// As in NumPy and Numba: NaN loses every comparison.
template <class T> __device__ __forceinline__ T least(T a, T b) { return b < a ? b : a; }
template <class T> __device__ __forceinline__ T greatest(T a, T b) { return b > a ? b : a; }
template <class T> __device__ __forceinline__ T squared(T x) { return x * x; }
__device__ __forceinline__ int magnitude(int x) { return x < 0 ? -x : x; }
__device__ __forceinline__ float magnitude(float x) { return fabsf(x); }
__device__ __forceinline__ double magnitude(double x) { return fabs(x); }
__device__ __forceinline__ float root(float x) { return sqrtf(x); }
__device__ __forceinline__ double root(double x) { return sqrt(x); }
__device__ __forceinline__ float logarithm(float x) { return logf(x); }
__device__ __forceinline__ double logarithm(double x) { return log(x); }
__device__ __forceinline__ float exponential(float x) { return expf(x); }
__device__ __forceinline__ double exponential(double x) { return exp(x); }
__device__ __forceinline__ float signed_as(float x, float y) { return copysignf(x, y); }
__device__ __forceinline__ double signed_as(double x, double y) { return copysign(x, y); }
// Of what is above zero. The libraries' own is a call, with a stack.
template <class T> __device__ __forceinline__ T power(T x, T y) {
    return exponential(y * logarithm(x));
}
__device__ __forceinline__ float rounded_down(float x) { return floorf(x); }
__device__ __forceinline__ double rounded_down(double x) { return floor(x); }
