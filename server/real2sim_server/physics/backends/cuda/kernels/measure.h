// Sums over bodies, and over contacts: small numbers that go to the host.
#pragma once

#include "substep.h"

// Takes a stop back, so that substeps may go on after those that are done.
extern "C" __global__ void __launch_bounds__(THREADS) begin_run(const Space* given, uint32 done) {
    if (thread_number() != 0) return;
    given->held->stop_after = 0;
    given->held->done = done;
    given->held->fault = 0;
}

// What one particle adds to the sums of its body; see particle.add_motion and add_material.
__device__ __forceinline__ void add_particle(
    const Space& space, const Particles& all, uint32 p, uint64 key, double* sums) {
    const double dx = space.dx, m = all.at(MASS, p);
    const auto xi = all.several<3>(XI, p);
    double x[3], v[3], L[9], square = 0, gradient = 0, off = 0;
    for (int axis = 0; axis < 3; ++axis) {
        x[axis] = (coordinate(key, axis) * BLOCK + double(xi[axis])) * dx;
        v[axis] = all.at(VELOCITY + axis, p);
        square += v[axis] * v[axis];
        off = greatest(off, magnitude(double(xi[axis]) - PARTICLE_CENTRE));
    }
    for (int c = 0; c < 9; ++c) {
        L[c] = all.at(GRADIENT + c, p);
        gradient += L[c] * L[c];
    }
    const double affine = m * dx * dx / 4;
    sums[0] += m;
    for (int axis = 0; axis < 3; ++axis) {
        sums[1 + axis] += m * x[axis];
        sums[4 + axis] += m * v[axis];
    }
    sums[7] += m * (x[1] * v[2] - x[2] * v[1]) + affine * (L[7] - L[5]);
    sums[8] += m * (x[2] * v[0] - x[0] * v[2]) + affine * (L[2] - L[6]);
    sums[9] += m * (x[0] * v[1] - x[1] * v[0]) + affine * (L[3] - L[1]);
    sums[10] += 0.5 * (m * square + affine * gradient);
    const real* row = space.table + all.material(p) * MATERIAL_ROW;
    const double volume = all.at(VOLUME, p);
    sums[11] += volume * double(all.at(ENERGY, p));
    const auto F = all.several<9>(ELASTIC_F, p);
    const double ratio = laws::det(F);
    double stretch = 0;
    for (int c = 0; c < 9; ++c) stretch += double(F[c]) * double(F[c]);
    double stiffening = greatest(stretch / 3, 1 / greatest(ratio, 1e-2));
    stiffening *= double(laws::wave_hardening(all.at(HISTORY, p), row));
    const double wave =
        (double(row[LAMBDA]) + 2 * double(row[MU])) * stiffening * volume / m;
    // Comparisons that NaN fails keep NaN out of maxima, so it is added instead.
    sums[12] = greatest(sums[12], square) + (square - square);
    sums[13] = greatest(sums[13], wave) + (wave - wave);
    sums[14] = least(sums[14], ratio) + (ratio - ratio);
    sums[REACH] = greatest(sums[REACH], off);
}

__device__ __forceinline__ void combine(double* sums, const double* others, uint32 c) {
    if (c < 12) sums[c] += others[c];
    else if (c == 14) sums[c] = least(sums[c], others[c]) + (others[c] - others[c]) * 0;
    else sums[c] = greatest(sums[c], others[c]) + (others[c] - others[c]);
}

__device__ __forceinline__ double nothing(uint32 c) { return c == 14 ? 1e300 : 0; }

// One row of sums for each block, in the order of threads.
extern "C" __global__ void __launch_bounds__(THREADS) measure_blocks(const Space* given, uint32) {
    __shared__ double sums[THREADS][COLUMNS];
    const Space& space = *given;
    const uint32 block = blockIdx.x;
    if (space.held->fault != 0 || block >= space.held->blocks) return;
    const Particles all = particles_of(space);
    double own[COLUMNS];
    for (uint32 c = 0; c < COLUMNS; ++c) own[c] = nothing(c);
    const uint32 end = space.block_start[block + 1];
    for (uint32 p = space.block_start[block] + threadIdx.x; p < end; p += THREADS)
        add_particle(space, all, p, space.block_key[block], own);
    for (uint32 c = 0; c < COLUMNS; ++c) sums[threadIdx.x][c] = own[c];
    __syncthreads();
    if (threadIdx.x >= COLUMNS) return;
    double* row = space.rows + uint64(block) * COLUMNS;
    row[threadIdx.x] = nothing(threadIdx.x);
    for (uint32 t = 0; t < THREADS; ++t) combine(row, sums[t], threadIdx.x);
}

// Sums of each body over its blocks. One block of threads for each body: 8 parts, 16 columns.
extern "C" __global__ void __launch_bounds__(THREADS) measure_bodies(const Space* given, uint32) {
    __shared__ double sums[THREADS / COLUMNS][COLUMNS];
    const Space& space = *given;
    const uint32 body = blockIdx.x, c = threadIdx.x % COLUMNS, part = threadIdx.x / COLUMNS;
    if (space.held->fault != 0) return;
    constexpr uint32 PARTS = THREADS / COLUMNS;
    sums[part][c] = nothing(c);
    for (uint32 block = part; block < space.held->blocks; block += PARTS)
        if (body_of(space.block_key[block]) == body)
            combine(sums[part], space.rows + uint64(block) * COLUMNS, c);
    __syncthreads();
    if (part != 0) return;
    double* out = space.measured + uint64(body) * COLUMNS;
    out[c] = nothing(c);
    for (uint32 p = 0; p < PARTS; ++p) combine(out, sums[p], c);
}

// Adds up what each contact did, over its nodes or threads, and begins anew.
extern "C" __global__ void __launch_bounds__(THREADS) sum_contacts(const Space* given, uint32) {
    const Space& space = *given;
    const Held& held = *space.held;
    const uint32 row = thread_number() / (2 * TOTALS), c = threadIdx.x % (2 * TOTALS);
    if (held.fault != 0 || row >= held.contacts + held.pairs + held.thins) return;
    const bool by_collider = row < held.contacts;
    const bool by_pair = !by_collider && row < held.contacts + held.pairs;
    if (!by_pair && c >= TOTALS) return;
    const uint32 width = by_pair ? 2 * TOTALS : TOTALS;
    const uint32 length = by_collider || by_pair ? NODES : THREADS;
    double* values;
    if (by_collider) values = space.by_collider + uint64(row) * NODES * TOTALS;
    else if (by_pair) values = space.by_pair + uint64(row - held.contacts) * NODES * 2 * TOTALS;
    else values = space.by_thin + uint64(row - held.contacts - held.pairs) * THREADS * TOTALS;
    double sum = 0;
    for (uint32 n = 0; n < length; ++n) {
        sum += values[n * width + c];
        values[n * width + c] = 0;
    }
    space.touched[uint64(row) * 2 * TOTALS + c] = sum;
}

// Adds contacts to the totals of bodies, in the order of fields. A thread for each total.
extern "C" __global__ void __launch_bounds__(THREADS) add_totals(const Space* given, uint32) {
    const Space& space = *given;
    const Held& held = *space.held;
    if (held.fault != 0) return;
    const uint64 index = thread_number();
    const uint32 c = index % TOTALS;
    const uint64 cell = index / TOTALS, of_colliders = uint64(space.bodies) * space.colliders;
    if (cell < of_colliders) {
        const uint32 body = cell / space.colliders, collider = cell % space.colliders;
        double* total = space.collider_totals + index;
        for (uint32 at = 0; at < held.contacts; ++at)
            if (space.contact_collider[at] == collider &&
                body_of(space.field_key[space.contact_field[at]]) == body)
                *total += space.touched[uint64(at) * 2 * TOTALS + c];
        for (uint32 at = 0; at < held.thins; ++at)
            if (space.thin_collider[at] == collider &&
                body_of(space.block_key[space.thin_block[at]]) == body)
                *total += space.touched[
                    uint64(held.contacts + held.pairs + at) * 2 * TOTALS + c];
    } else if (cell < of_colliders + uint64(space.bodies) * space.bodies) {
        const uint32 own = (cell - of_colliders) / space.bodies;
        const uint32 other = (cell - of_colliders) % space.bodies;
        double* total = space.body_totals + (cell - of_colliders) * TOTALS + c;
        for (uint32 at = 0; at < held.pairs; ++at) {
            const uint32 a = space.pair_field[at], b = a + 1 + (at - space.pair_start[a]);
            const uint32 body_a = body_of(space.field_key[a]), body_b = body_of(space.field_key[b]);
            const double* row = space.touched + uint64(held.contacts + at) * 2 * TOTALS;
            if (body_a == own && body_b == other) *total += row[c];
            if (body_b == own && body_a == other) *total += row[TOTALS + c];
        }
    }
}
