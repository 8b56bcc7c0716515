// Keys of particles, and a stable radix sort by 8 bits a pass. Block b of a pass has the b-th part
// of the list; equal keys keep their order, so the result is the same however blocks run.
#pragma once

#include "scan.h"

// Passes by the bytes of keys, and one by law, which comes first: what it leaves, the others keep.
constexpr uint32 BY_LAW = 15, FLIPPED = 16;

// Key of the block of each particle's first node; positions count from that block.
extern "C" __global__ void __launch_bounds__(THREADS) find_keys(const Space* given, uint32 keep) {
    const Space& space = *given;
    const uint32 p = thread_number();
    if (p >= space.particles || is_halted(space, AFTER_ANY)) return;
    const Particles all = particles_of(space);
    uint64 key = all.key(p);
    if (!keep) {
        uint64 moved = 0;
        for (int axis = 0; axis < 3; ++axis) {
            const real xi = all.at(XI + axis, p), v = all.at(VELOCITY + axis, p);
            const real shift = rounded_down((xi - real(0.5)) / BLOCK);
            // A motion of more than a few blocks at once means that the solver diverges.
            if (!(magnitude(shift) <= real(1024)) || !(magnitude(v) <= real(1e30))) {
                atomicOr(&space.held->fault, DIVERGED);
                return;
            }
            all.at(XI + axis, p) = xi - shift * BLOCK;
            const int block = coordinate(key, axis) + int(shift);
            if (magnitude(block) >= COORDINATE_LIMIT - 2) {
                atomicOr(&space.held->fault, TOO_FAR);
                return;
            }
            moved = moved << COORDINATE_BITS | uint64(block + COORDINATE_LIMIT);
        }
        key = moved << BODY_BITS | body_of(key);
        all.key(p) = key;
    }
    space.keys[0][p] = key;
    space.order[0][p] = p;
}

struct Pass {
    const uint64* keys;
    const uint32* order;
    uint64* keys_out;
    uint32* order_out;
    uint32 first, last, number;
};

__device__ __forceinline__ Pass pass_of(const Space& space, uint32 argument) {
    const bool flipped = argument & FLIPPED;
    Pass pass;
    pass.keys = space.keys[flipped];
    pass.order = space.order[flipped];
    pass.keys_out = space.keys[!flipped];
    pass.order_out = space.order[!flipped];
    pass.number = argument & 15u;
    const uint32 chunks = (space.particles + THREADS - 1) / THREADS;
    const uint32 each = (chunks + space.sort_blocks - 1) / space.sort_blocks * THREADS;
    pass.first = min(blockIdx.x * each, space.particles);
    pass.last = min(pass.first + each, space.particles);
    return pass;
}

// Lanes of the warp with the same digit as this one. Lanes without a key have a digit of their own.
__device__ __forceinline__ uint32 same_digit(
    const Space& space, const Pass& pass, uint32 index, uint32& digit) {
    digit = DIGITS;
    if (index < pass.last) {
        if (pass.number == BY_LAW) {
            const uint32 material = particles_of(space).material(pass.order[index]);
            digit = uint32(space.table[material * MATERIAL_ROW + LAW]);
        } else {
            digit = uint32(pass.keys[index] >> 8 * pass.number) & (DIGITS - 1);
        }
    }
    return __match_any_sync(ALL_LANES, digit);
}

__device__ __forceinline__ uint32 bits_before(uint32 mask, uint32 lane) {
    return __popc(mask & ((1u << lane) - 1u));
}

// Counts digits by block.
extern "C" __global__ void __launch_bounds__(THREADS) count_digits(
    const Space* given, uint32 argument) {
    __shared__ uint32 counts[DIGITS];
    const Space& space = *given;
    if (is_halted(space, AFTER_ANY)) return;
    const Pass pass = pass_of(space, argument);
    for (uint32 digit = threadIdx.x; digit < DIGITS; digit += THREADS) counts[digit] = 0;
    __syncthreads();
    for (uint32 first = pass.first; first < pass.last; first += THREADS) {
        uint32 digit;
        const uint32 same = same_digit(space, pass, first + threadIdx.x, digit);
        if (digit < DIGITS && bits_before(same, threadIdx.x % WARP) == 0)
            atomicAdd(&counts[digit], uint32(__popc(same)));
    }
    __syncthreads();
    for (uint32 digit = threadIdx.x; digit < DIGITS; digit += THREADS)
        space.digit_counts[blockIdx.x * DIGITS + digit] = counts[digit];
}

// Turns counts of a digit into sums over the blocks before; a block of threads for each digit.
extern "C" __global__ void __launch_bounds__(THREADS) sum_digits(const Space* given, uint32) {
    const Space& space = *given;
    if (is_halted(space, AFTER_ANY)) return;
    uint32* counts = space.digit_counts + blockIdx.x;
    if (space.sort_blocks == 1) {
        if (threadIdx.x == 0) counts[DIGITS] = counts[0], counts[0] = 0;
        return;
    }
    const uint32 each = (space.sort_blocks + THREADS - 1) / THREADS;
    const uint32 first = min(threadIdx.x * each, space.sort_blocks);
    const uint32 last = min(first + each, space.sort_blocks);
    uint32 sum = 0, total;
    for (uint32 block = first; block < last; ++block) sum += counts[block * DIGITS];
    uint32 before = sum_before(sum, total);
    for (uint32 block = first; block < last; ++block) {
        const uint32 here = counts[block * DIGITS];
        counts[block * DIGITS] = before;
        before += here;
    }
    if (threadIdx.x == 0) counts[space.sort_blocks * DIGITS] = total;
}

// Puts keys and numbers of particles where sum_digits says.
extern "C" __global__ void __launch_bounds__(THREADS) scatter_digits(
    const Space* given, uint32 argument) {
    __shared__ uint32 next[DIGITS], starts[WARPS][DIGITS];
    const Space& space = *given;
    if (is_halted(space, AFTER_ANY)) return;
    const Pass pass = pass_of(space, argument);
    const uint32 lane = threadIdx.x % WARP, warp = threadIdx.x / WARP;
    // Each thread has two digits; all smaller ones come before.
    const uint32* totals = space.digit_counts + space.sort_blocks * DIGITS;
    const uint32* counts = space.digit_counts + blockIdx.x * DIGITS;
    const uint32 even = 2 * threadIdx.x, of_even = totals[even];
    uint32 all;
    const uint32 before = sum_before(of_even + totals[even + 1], all);
    next[even] = before + counts[even];
    next[even + 1] = before + of_even + counts[even + 1];
    for (uint32 first = pass.first; first < pass.last; first += THREADS) {
        for (uint32 digit = threadIdx.x; digit < DIGITS; digit += THREADS)
            for (uint32 w = 0; w < WARPS; ++w) starts[w][digit] = 0;
        __syncthreads();
        const uint32 index = first + threadIdx.x;
        uint32 digit;
        const uint32 same = same_digit(space, pass, index, digit);
        const uint32 rank = bits_before(same, lane);
        if (digit < DIGITS && rank == 0) starts[warp][digit] = __popc(same);
        __syncthreads();
        for (uint32 own = threadIdx.x; own < DIGITS; own += THREADS) {
            uint32 at = next[own];
            for (uint32 w = 0; w < WARPS; ++w) {
                const uint32 count = starts[w][own];
                starts[w][own] = at;
                at += count;
            }
            next[own] = at;
        }
        __syncthreads();
        if (digit < DIGITS) {
            const uint32 to = starts[warp][digit] + rank;
            pass.keys_out[to] = pass.keys[index];
            pass.order_out[to] = pass.order[index];
        }
        __syncthreads();
    }
}

// Brings particles in the order that the sort found, from one set to the other.
extern "C" __global__ void __launch_bounds__(THREADS) reorder(const Space* given, uint32 argument) {
    const Space& space = *given;
    const uint32 p = thread_number();
    if (p >= space.particles || is_halted(space, AFTER_ANY)) return;
    const bool flipped = argument & FLIPPED;
    const Particles from = particles_of(space);
    const Particles to = {space.sets[space.held->current ^ 1u], space.pitch};
    const uint32 source = space.order[flipped][p];
    to.key(p) = space.keys[flipped][p];
    to.material(p) = from.material(source);
    to.origin(p) = from.origin(source);
    const uint32 numbers = space.plastic ? TOTAL_F + 9 : TOTAL_F;
    for (uint32 c = 0; c < numbers; ++c) to.at(c, p) = from.at(c, source);
}
