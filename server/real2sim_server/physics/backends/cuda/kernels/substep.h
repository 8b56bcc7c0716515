// One substep in two launches, three where colliders are thin: fields collect what blocks have scattered and touch what is there;
// blocks take it up, move and deform their particles, and scatter for the next substep. No sum is
// left to the order of threads: a tile is added up particle by particle, as on the CPU.
#pragma once

#include "layout.h"

// What advance_blocks and advance_obstructed do, above the number of the substep.
constexpr uint32 MOVES = 1u << 16, DEFORMS = 1u << 17, SCATTERS = 1u << 18;
constexpr uint32 STEP_MASK = (1u << 16) - 1;
// Lines of a tile in shared memory are apart so that 27 nodes lie in different banks, but two.
constexpr int ROW = SIDE, PLANE_ROW = SIDE * SIDE + 3;
constexpr uint32 PADDED = SIDE * PLANE_ROW;
// Particles that are staged at once.
constexpr uint32 CHUNK = sizeof(real) == 4 ? THREADS : THREADS / 2;
// Blocks of threads that a multiprocessor can hold: so many registers are left to each.
constexpr int RESIDENT = sizeof(real) == 4 ? 3 : 2, RESIDENT_OBSTRUCTED = 2;
constexpr real LOWEST = real(-0.5), HIGHEST = real(5.5);

__device__ __forceinline__ int padded_node(int i, int j, int k) {
    return i * PLANE_ROW + j * ROW + k;
}
__device__ __forceinline__ int padded(uint32 node) {
    return padded_node(node / (SIDE * SIDE), node / SIDE % SIDE, node % SIDE);
}

// Where a particle is on its tile: first of its nodes, and how far it is from there [cells].
struct Place {
    int first;
    Numbers<real, 3> from;
};
__device__ __forceinline__ Place place_of(const Numbers<real, 3>& xi) {
    int node[3];
    Place place;
    for (int axis = 0; axis < 3; ++axis) {
        const real first = rounded_down(xi[axis] - real(0.5));
        node[axis] = int(first) + 1;
        place.from[axis] = xi[axis] - first;
    }
    place.first = padded_node(node[0], node[1], node[2]);
    return place;
}

// What a particle gives: weights along axes, and for each of four components its value at the first
// node and its slopes along x, y and z; see particle.momentum.
struct Staged {
    real weights[9][CHUNK + 1];  // So that those of one axis lie in different banks.
    Real4 values[4][CHUNK];
    int first[CHUNK];
};

__device__ __forceinline__ void stage_place(Staged& staged, const Place& place) {
    const uint32 lane = threadIdx.x;
    for (int axis = 0; axis < 3; ++axis) {
        const Numbers<real, 3> w = laws::spline_weights(place.from[axis]);
        for (int n = 0; n < 3; ++n) staged.weights[3 * axis + n][lane] = w[n];
    }
    staged.first[lane] = place.first;
}

__device__ __forceinline__ void stage_momentum(
    Staged& staged, const Particles& all, uint32 p, const Place& place, real dt, real dx,
    const Numbers<real, 3>& v, const Numbers<real, 9>& L, const Numbers<real, 6>& t) {
    stage_place(staged, place);
    const real m = all.at(MASS, p), md = m * dx;
    const real k = -dt * real(4) / dx * all.at(VOLUME, p);
    const int stress[3][3] = {{0, 3, 4}, {3, 1, 5}, {4, 5, 2}};
    for (int c = 0; c < 3; ++c) {
        real slopes[3], start = m * v[c];
        for (int axis = 0; axis < 3; ++axis) {
            slopes[axis] = k * t[stress[axis][c]] + md * L[3 * c + axis];
            start -= slopes[axis] * place.from[axis];
        }
        staged.values[c][threadIdx.x] = {start, slopes[0], slopes[1], slopes[2]};
    }
    staged.values[3][threadIdx.x] = {m, 0, 0, 0};
}

// w V (x_p - x_i) and w V, V at rest.
__device__ __forceinline__ void stage_moment(
    Staged& staged, const Particles& all, uint32 p, const Place& place) {
    stage_place(staged, place);
    const real V = all.at(VOLUME, p);
    const Numbers<real, 3>& from = place.from;
    staged.values[0][threadIdx.x] = {V * from[0], -V, 0, 0};
    staged.values[1][threadIdx.x] = {V * from[1], 0, -V, 0};
    staged.values[2][threadIdx.x] = {V * from[2], 0, 0, -V};
    staged.values[3][threadIdx.x] = {V, 0, 0, 0};
}

// Adds what is staged to a tile, one particle after the other: a warp for each component, a lane
// for each of a particle's nodes.
__device__ __forceinline__ void add_staged(real (*tile)[PADDED], const Staged& staged, uint32 count) {
    const uint32 lane = threadIdx.x % WARP, c = threadIdx.x / WARP;
    const int a = lane / 9, b = lane / 3 % 3, d = lane % 3;
    const int own = padded_node(a, b, d);
    for (uint32 p = 0; p < count; ++p) {
        if (lane < AROUND) {
            const real w = staged.weights[a][p] * staged.weights[3 + b][p] *
                           staged.weights[6 + d][p];
            const Real4 q = staged.values[c][p];
            const real value = q.x + real(a) * q.y + real(b) * q.z + real(d) * q.w;
            tile[c][staged.first[p] + own] += w * value;
        }
        __syncwarp();
    }
}

__device__ __forceinline__ void clear_tile(real (*tile)[PADDED]) {
    for (uint32 n = threadIdx.x; n < PADDED; n += THREADS)
        for (int c = 0; c < 4; ++c) tile[c][n] = 0;
}
__device__ __forceinline__ void store_tile(const real (*tile)[PADDED], Real4* out) {
    for (uint32 node = threadIdx.x; node < TILE; node += THREADS) {
        const int at = padded(node);
        out[node] = {tile[0][at], tile[1][at], tile[2][at], tile[3][at]};
    }
}

// Velocities of the fields around a block.
__device__ __forceinline__ void load_velocities(
    const Space& space, uint32 block, real (*tile)[PADDED]) {
    for (uint32 node = threadIdx.x; node < TILE; node += THREADS) {
        const int i = node / (SIDE * SIDE) - 1, j = node / SIDE % SIDE - 1, k = node % SIDE - 1;
        const int o = (i + BLOCK) / BLOCK * 9 + (j + BLOCK) / BLOCK * 3 + (k + BLOCK) / BLOCK;
        const uint32 field = space.block_fields[block * AROUND + o];
        const int own = ((i & 3) * BLOCK + (j & 3)) * BLOCK + (k & 3);
        const Real4 v = space.velocity[uint64(field) * NODES + own];
        const int at = padded(node);
        tile[0][at] = v.x;
        tile[1][at] = v.y;
        tile[2][at] = v.z;
    }
}

// Velocity and its gradient from the nodes around a particle; see particle.velocity_gradient.
__device__ __forceinline__ void gather(
    const real (*tile)[PADDED], const Place& place, real dx, Numbers<real, 3>& v,
    Numbers<real, 9>& L) {
    Numbers<real, 3> w[3];
    for (int axis = 0; axis < 3; ++axis) w[axis] = laws::spline_weights(place.from[axis]);
    const real scale = real(4) / dx;
    for (int c = 0; c < 3; ++c) {
        real sum = 0, by_i = 0, by_j = 0, by_k = 0;
        for (int i = 0; i < 3; ++i) {
            real plane = 0, plane_j = 0, plane_k = 0;
            for (int j = 0; j < 3; ++j) {
                const real* line = tile[c] + place.first + padded_node(i, j, 0);
                const real one = w[2][1] * line[1], two = w[2][2] * line[2];
                const real along = w[2][0] * line[0] + one + two;
                plane += w[1][j] * along;
                plane_j += w[1][j] * real(j) * along;
                plane_k += w[1][j] * (one + real(2) * two);
            }
            sum += w[0][i] * plane;
            by_i += w[0][i] * real(i) * plane;
            by_j += w[0][i] * plane_j;
            by_k += w[0][i] * plane_k;
        }
        v[c] = sum;
        L[3 * c] = scale * (by_i - place.from[0] * sum);
        L[3 * c + 1] = scale * (by_j - place.from[1] * sum);
        L[3 * c + 2] = scale * (by_k - place.from[2] * sum);
    }
}

// Velocity of a particle once thin colliders near by have had their say; see particle.obstructed.
__device__ __forceinline__ void hold_particle(
    const Space& space, const Particles& all, uint32 p, uint32 block, uint32 step,
    const Numbers<real, 3>& xi, Numbers<real, 3>& v) {
    const uint64 key = space.block_key[block];
    Numbers<double, 3> x, held = {double(v[0]), double(v[1]), double(v[2])};
    for (int axis = 0; axis < 3; ++axis)
        x[axis] = (coordinate(key, axis) * BLOCK + double(xi[axis])) * space.dx;
    const double friction = space.friction[body_of(key)];
    const double mass = all.at(MASS, p), volume = all.at(VOLUME, p);
    const uint32 first = space.thin_start[block], last = space.thin_start[block + 1];
    for (uint32 turn = 0; turn < min(last - first, 2u); ++turn)
        for (uint32 near = first; near < last; ++near) {
            double* total = space.by_thin + (uint64(near) * THREADS + threadIdx.x) * TOTALS;
            const double* row = collider_row(space, space.thin_collider[near], step);
            held = contact::TOUCH_PARTICLE(
                row, space.heights, real(space.step->dt), friction, volume, x, held, mass, total);
        }
    for (int axis = 0; axis < 3; ++axis) v[axis] = real(held[axis]);
}

// Deformation and stress of one particle; see particle.deform.
__device__ __forceinline__ Numbers<real, 6> deform(
    const Space& space, const Particles& all, uint32 p, real dt, const Numbers<real, 9>& L) {
    const real* row = space.table + all.material(p) * MATERIAL_ROW;
    const auto trial = laws::advance_gradient(all.several<9>(ELASTIC_F, p), L, dt);
    const auto found = laws::stress_update(trial, all.at(HISTORY, p), row, dt);
    Numbers<real, 6> tau = found.at1;
    if (row[VISCOSITY] > real(0))
        tau = laws::add_viscosity(tau, L, laws::det(found.at0), row[VISCOSITY]);
    all.put(ELASTIC_F, p, found.at0);
    all.put(STRESS, p, tau);
    all.at(ENERGY, p) = found.at2;
    if (row[PLASTIC] > real(0)) {
        all.at(HISTORY, p) = found.at3;
        all.put(TOTAL_F, p, laws::advance_gradient(all.several<9>(TOTAL_F, p), L, dt));
    }
    return tau;
}

// One particle through a substep, as far as `does` says; staged for its tile where it scatters.
template <bool OBSTRUCTED>
__device__ __forceinline__ void advance_particle(
    const Space& space, const Particles& all, uint32 p, uint32 block, uint32 does,
    const real (*velocities)[PADDED], Staged& staged) {
    const real dx = real(space.dx);
    const real dt = does & (MOVES | SCATTERS) ? real(space.step->dt) : real(0);
    const uint32 step = does & STEP_MASK;
    auto xi = all.several<3>(XI, p);
    Numbers<real, 3> v;
    Numbers<real, 9> L;
    bool stays = true;
    // What is found anew is not read.
    if (!(does & MOVES)) {
        v = all.several<3>(VELOCITY, p);
        L = all.several<9>(GRADIENT, p);
    } else {
        gather(velocities, place_of(xi), dx, v, L);
        if constexpr (OBSTRUCTED) hold_particle(space, all, p, block, step, xi, v);
        const real stride = dt / dx;
        for (int axis = 0; axis < 3; ++axis) {
            xi[axis] += stride * v[axis];
            // NaN fails both comparisons, so the particle counts as gone.
            stays = stays && xi[axis] >= LOWEST && xi[axis] < HIGHEST;
        }
        all.put(XI, p, xi);
        all.put(VELOCITY, p, v);
        all.put(GRADIENT, p, L);
        if (!stays) space.held->stop_after = step + 1;
    }
    const auto tau = does & DEFORMS ? deform(space, all, p, does & MOVES ? dt : real(0), L)
                                    : all.several<6>(STRESS, p);
    if (!(does & SCATTERS)) return;
    // What has left the tile is scattered nowhere: all are sorted before anything else.
    Place place = place_of(stays ? xi : Numbers<real, 3>{real(1), real(1), real(1)});
    stage_momentum(staged, all, p, place, dt, dx, v, L, tau);
}

__device__ __forceinline__ void scatter_moments(
    const Space& space, const Particles& all, uint32 block, real (*tile)[PADDED], Staged& staged) {
    const uint32 begin = space.block_start[block], end = space.block_start[block + 1];
    __syncthreads();
    clear_tile(tile);
    for (uint32 first = begin; first < end; first += CHUNK) {
        const uint32 p = first + threadIdx.x;
        if (threadIdx.x < CHUNK && p < end) {
            auto xi = all.several<3>(XI, p);
            for (int axis = 0; axis < 3; ++axis)
                if (!(xi[axis] >= LOWEST && xi[axis] < HIGHEST)) xi = {real(1), real(1), real(1)};
            stage_moment(staged, all, p, place_of(xi));
        }
        __syncthreads();
        add_staged(tile, staged, min(end - first, CHUNK));
        __syncthreads();
    }
    store_tile(tile, space.moments + uint64(block) * TILE);
}

// Particles of a block through a substep; of those near thin colliders, or of the others.
template <bool OBSTRUCTED> __device__ __forceinline__ void advance_block(
    const Space& space, uint32 does, real (*velocities)[PADDED], real (*tile)[PADDED],
    Staged& staged) {
    const uint32 block = blockIdx.x;
    if (block >= space.held->blocks || is_halted(space, does & STEP_MASK)) return;
    if (OBSTRUCTED != (space.thin_start[block] < space.thin_start[block + 1])) return;
    const Particles all = particles_of(space);
    const uint32 begin = space.block_start[block], end = space.block_start[block + 1];
    if (does & MOVES) {
        load_velocities(space, block, velocities);
        if (block == 0 && threadIdx.x == 0) space.held->done = (does & STEP_MASK) + 1;
    }
    if (does & SCATTERS) clear_tile(tile);
    __syncthreads();
    for (uint32 first = begin; first < end; first += CHUNK) {
        const uint32 p = first + threadIdx.x;
        if (threadIdx.x < CHUNK && p < end)
            advance_particle<OBSTRUCTED>(space, all, p, block, does, velocities, staged);
        __syncthreads();
        if (does & SCATTERS) add_staged(tile, staged, min(end - first, CHUNK));
        __syncthreads();
    }
    if (!(does & SCATTERS)) return;
    store_tile(tile, space.tiles + uint64(block) * TILE);
    if (space.block_near[block]) scatter_moments(space, all, block, tile, staged);
}

extern "C" __global__ void __launch_bounds__(THREADS, RESIDENT) advance_blocks(
    const Space* given, uint32 does) {
    __shared__ real velocities[3][PADDED], tile[4][PADDED];
    __shared__ Staged staged;
    advance_block<false>(*given, does, velocities, tile, staged);
}

// A kernel of its own, as what thin colliders do takes registers that all others would miss.
extern "C" __global__ void __launch_bounds__(THREADS, RESIDENT_OBSTRUCTED) advance_obstructed(
    const Space* given, uint32 does) {
    __shared__ real velocities[3][PADDED], tile[4][PADDED];
    __shared__ Staged staged;
    advance_block<true>(*given, does, velocities, tile, staged);
}

__device__ __forceinline__ void add(Real4& sum, const Real4& other) {
    sum.x += other.x;
    sum.y += other.y;
    sum.z += other.z;
    sum.w += other.w;
}

// Sum of one node over the two tiles along each axis that hold it, in the order of their blocks.
__device__ __forceinline__ Real4 node_sum(
    const Space& space, const Real4* tiles, uint32 field, uint32 node) {
    const int at[3] = {int(node / (BLOCK * BLOCK)), int(node / BLOCK % BLOCK), int(node % BLOCK)};
    Real4 sum = {0, 0, 0, 0};
    for (uint32 turn = 0; turn < 8; ++turn) {
        int o = 0, index = 0;
        for (int axis = 0; axis < 3; ++axis) {
            // Its own block's, and that of the block below, or for the last node of the one above.
            const int second = turn >> (2 - axis) & 1;
            const int side = at[axis] == BLOCK - 1 ? second : second - 1;
            o = o * 3 + side + 1;
            index = index * SIDE + at[axis] - BLOCK * side + 1;
        }
        const int block = space.field_blocks[field * AROUND + o];
        if (block >= 0) add(sum, tiles[uint64(block) * TILE + index]);
    }
    return sum;
}

__device__ __forceinline__ void load(const Real4& from, double* to) {
    to[0] = from.x;
    to[1] = from.y;
    to[2] = from.z;
    to[3] = from.w;
}
__device__ __forceinline__ void store(const double* from, Real4& to) {
    to.x = real(from[0]);
    to.y = real(from[1]);
    to.z = real(from[2]);
}

// Contact of two bodies at one node.
__device__ __forceinline__ void touch_bodies(
    const Space& space, uint32 a, uint32 b, uint32 node, const Numbers<double, 3>& x) {
    Real4& of_a = space.velocity[uint64(a) * NODES + node];
    Real4& of_b = space.velocity[uint64(b) * NODES + node];
    if (!(of_a.w > 0 && of_b.w > 0)) return;
    double node_a[4], node_b[4], moment_a[4], moment_b[4];
    load(of_a, node_a);
    load(of_b, node_b);
    load(space.offset[uint64(a) * NODES + node], moment_a);
    load(space.offset[uint64(b) * NODES + node], moment_b);
    const double friction = contact::pair_friction(
        space.friction[body_of(space.field_key[a])], space.friction[body_of(space.field_key[b])]);
    const uint64 row = space.pair_start[a] + (b - a - 1);
    double* total = space.by_pair + (row * NODES + node) * 2 * TOTALS;
    contact::resolve_node_pair(
        node_a, node_b, moment_a, moment_b, friction, space.dx, x, total, total + TOTALS);
    store(node_a, of_a);
    store(node_b, of_b);
}

// Contact of one body's node with every collider near its field.
__device__ __forceinline__ void touch_colliders(
    const Space& space, uint32 field, uint32 node, uint32 step, const Numbers<double, 3>& x) {
    const uint32 first = space.contact_start[field], last = space.contact_start[field + 1];
    Real4& own = space.velocity[uint64(field) * NODES + node];
    if (first == last || !(own.w > 0)) return;
    double velocity[4], moment[4];
    load(own, velocity);
    load(space.offset[uint64(field) * NODES + node], moment);
    const double friction = space.friction[body_of(space.field_key[field])];
    for (uint32 at = first; at < last; ++at)
        contact::resolve_node_collider(
            collider_row(space, space.contact_collider[at], step), space.heights, space.dx,
            friction, x, velocity, moment, space.by_collider + (uint64(at) * NODES + node) * TOTALS);
    store(velocity, own);
}

// Tiles to the fields of one group: sums, gravity, contact. Nodes do not know each other.
extern "C" __global__ void __launch_bounds__(THREADS, 3) collect_fields(
    const Space* given, uint32 step) {
    const Space& space = *given;
    const uint32 group = thread_number() / NODES, node = threadIdx.x % NODES;
    if (group >= space.held->groups || is_halted(space, step)) return;
    const uint32 begin = space.group_start[group], end = space.group_start[group + 1];
    const real dt = real(space.step->dt);
    for (uint32 field = begin; field < end; ++field) {
        const uint64 own = uint64(field) * NODES + node;
        Real4 sum = node_sum(space, space.tiles, field, node);
        if (sum.w > 0) {
            const real inverse = real(1) / sum.w;
            sum.x = sum.x * inverse + dt * real(space.gravity[0]);
            sum.y = sum.y * inverse + dt * real(space.gravity[1]);
            sum.z = sum.z * inverse + dt * real(space.gravity[2]);
        }
        space.velocity[own] = sum;
        if (space.field_near[field])
            space.offset[own] = node_sum(space, space.moments, field, node);
    }
    const uint64 key = space.field_key[begin];
    const uint32 at[3] = {node / (BLOCK * BLOCK), node / BLOCK % BLOCK, node % BLOCK};
    Numbers<double, 3> x;
    for (int axis = 0; axis < 3; ++axis)
        x[axis] = (coordinate(key, axis) * BLOCK + int(at[axis])) * space.dx;
    for (uint32 a = begin; a < end; ++a)
        for (uint32 b = a + 1; b < end; ++b) touch_bodies(space, a, b, node, x);
    for (uint32 field = begin; field < end; ++field)
        touch_colliders(space, field, node, step, x);
}
