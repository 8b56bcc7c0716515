// Running sums over a block of threads.
#pragma once

#include "space.h"

// Sum over the threads before this one, and over all.
__device__ __forceinline__ uint32 sum_before(uint32 value, uint32& total) {
    __shared__ uint32 values[THREADS];
    values[threadIdx.x] = value;
    __syncthreads();
    for (uint32 step = 1; step < THREADS; step *= 2) {
        const uint32 other = threadIdx.x >= step ? values[threadIdx.x - step] : 0;
        __syncthreads();
        values[threadIdx.x] += other;
        __syncthreads();
    }
    total = values[THREADS - 1];
    const uint32 before = values[threadIdx.x] - value;
    __syncthreads();
    return before;
}
