// Which blocks of the grid hold particles, which are neighbours, and what contact may concern:
// layout.py, on the device. Lists are made by counting, summing up the counts, and filling in; the
// keys of blocks are sorted as their particles are, and those of fields as layout.py has them.
#pragma once

#include "scan.h"

// Lists that are summed up: heads of blocks among particles; fields first met, by offset and block;
// then four behind each other: groups, near colliders and pairs of each field, thin ones of blocks.
constexpr uint32 BLOCKS = 0, FIELDS = 1, LISTS = 2;
constexpr double BLOCK_REACH = 3.5, PARTICLE_CENTRE = 2.5, PARTICLE_REACH = 6.0;
constexpr double COLLIDER_MARGIN = 2.0;

// Where lists begin that are summed up together.
struct Together {
    uint32 contacts, pairs, thins, end;
};
__device__ __forceinline__ Together together(const Held& held) {
    return {held.fields, 2 * held.fields, 3 * held.fields, 3 * held.fields + held.blocks};
}

__device__ __forceinline__ uint32 length_of(const Space& space, uint32 list) {
    if (list == BLOCKS) return space.particles;
    return list == FIELDS ? AROUND * space.held->blocks : together(*space.held).end;
}

__device__ __forceinline__ bool is_head(const Particles& all, uint32 p) {
    return p == 0 || all.key(p) != all.key(p - 1);
}

// Sum of each piece of a list.
extern "C" __global__ void __launch_bounds__(THREADS) add_pieces(const Space* given, uint32 list) {
    const Space& space = *given;
    if (is_halted(space, AFTER_ANY)) return;
    const uint32 length = length_of(space, list), first = blockIdx.x * PIECE;
    if (first >= length) return;
    uint32 sum = 0, total;
    for (uint32 i = first + threadIdx.x; i < min(first + PIECE, length); i += THREADS)
        sum += space.counts[i];
    sum_before(sum, total);
    if (threadIdx.x == 0) space.sums[blockIdx.x] = total;
}

// Sums over the pieces before; how many blocks and fields there are. One block of threads.
extern "C" __global__ void __launch_bounds__(THREADS) sum_pieces(const Space* given, uint32 list) {
    const Space& space = *given;
    if (is_halted(space, AFTER_ANY)) return;
    const uint32 length = length_of(space, list), pieces = (length + PIECE - 1) / PIECE;
    const uint32 each = (pieces + THREADS - 1) / THREADS;
    const uint32 first = min(threadIdx.x * each, pieces), last = min(first + each, pieces);
    uint32 sum = 0, total;
    for (uint32 i = first; i < last; ++i) sum += space.sums[i];
    uint32 before = sum_before(sum, total);
    for (uint32 i = first; i < last; ++i) {
        const uint32 here = space.sums[i];
        space.sums[i] = before;
        before += here;
    }
    if (threadIdx.x != 0) return;
    Held& held = *space.held;
    space.counts[length] = total;
    if (list == BLOCKS) {
        held.current ^= 1u;  // Particles stand in the new order from here on.
        held.blocks = total;
    }
    if (list == FIELDS) held.fields = total;
    if (list == BLOCKS ? total > space.block_capacity : held.fields > space.field_capacity)
        held.fault |= OVERFLOW;
}

// Sums over all before, in place of the counts of a list.
extern "C" __global__ void __launch_bounds__(THREADS) spread_sums(const Space* given, uint32 list) {
    const Space& space = *given;
    if (is_halted(space, AFTER_ANY)) return;
    const uint32 length = length_of(space, list), begin = blockIdx.x * PIECE;
    if (begin >= length) return;
    constexpr uint32 EACH = PIECE / THREADS;
    const uint32 first = min(begin + threadIdx.x * EACH, length);
    const uint32 last = min(first + EACH, length);
    uint32 sum = 0, total;
    for (uint32 i = first; i < last; ++i) sum += space.counts[i];
    uint32 before = space.sums[blockIdx.x] + sum_before(sum, total);
    for (uint32 i = first; i < last; ++i) {
        const uint32 here = space.counts[i];
        space.counts[i] = before;
        before += here;
    }
}

// Marks the first particle of each block. They still stand in the set that is not current.
extern "C" __global__ void __launch_bounds__(THREADS) mark_blocks(const Space* given, uint32) {
    const Space& space = *given;
    const uint32 p = thread_number();
    if (p >= space.particles || is_halted(space, AFTER_ANY)) return;
    const Particles sorted = {space.sets[space.held->current ^ 1u], space.pitch};
    space.counts[p] = is_head(sorted, p);
}

extern "C" __global__ void __launch_bounds__(THREADS) fill_blocks(const Space* given, uint32) {
    const Space& space = *given;
    const uint32 p = thread_number();
    if (p >= space.particles || is_halted(space, AFTER_ANY)) return;
    const Particles all = particles_of(space);
    if (is_head(all, p)) {
        space.block_start[space.counts[p]] = p;
        space.block_key[space.counts[p]] = all.key(p);
    }
    if (p == 0) space.block_start[space.held->blocks] = space.particles;
}

// How many of sorted keys are below a key.
__device__ __forceinline__ uint32 below(const uint64* keys, uint32 length, uint64 key) {
    uint32 first = 0, last = length;
    while (first < last) {
        const uint32 middle = (first + last) / 2;
        if (keys[middle] < key) first = middle + 1;
        else last = middle;
    }
    return first;
}

__device__ __forceinline__ bool holds(const uint64* keys, uint32 length, uint64 key) {
    const uint32 at = below(keys, length, key);
    return at < length && keys[at] == key;
}

// Marks fields where they are met first: no block at a smaller offset number meets them as well.
extern "C" __global__ void __launch_bounds__(THREADS) mark_fields(const Space* given, uint32) {
    const Space& space = *given;
    const uint32 blocks = space.held->blocks, index = thread_number();
    if (is_halted(space, AFTER_ANY) || index >= AROUND * blocks) return;
    const uint32 own = index / blocks;
    const uint64 key = space.block_key[index % blocks] + key_step(own);
    bool first = true;
    for (uint32 o = 0; o < own && first; ++o)
        first = !holds(space.block_key, blocks, key - key_step(o));
    space.counts[index] = first;
}

// Puts the keys of fields in order: those met at each offset are sorted already.
extern "C" __global__ void __launch_bounds__(THREADS) fill_fields(const Space* given, uint32) {
    const Space& space = *given;
    const uint32 blocks = space.held->blocks, index = thread_number();
    if (is_halted(space, AFTER_ANY) || index >= AROUND * blocks) return;
    if (space.counts[index + 1] == space.counts[index]) return;
    const uint64 key = space.block_key[index % blocks] + key_step(index / blocks);
    uint32 rank = 0;
    for (uint32 o = 0; o < AROUND; ++o) {
        const uint32 before = below(space.block_key, blocks, key - key_step(o));
        rank += space.counts[o * blocks + before] - space.counts[o * blocks];
    }
    space.field_key[rank] = key;
}

// Fields around each block, and blocks around each field.
extern "C" __global__ void __launch_bounds__(THREADS) link_fields(const Space* given, uint32) {
    const Space& space = *given;
    const uint32 blocks = space.held->blocks, fields = space.held->fields;
    const uint32 index = thread_number(), at = index / AROUND, o = index % AROUND;
    if (is_halted(space, AFTER_ANY) || at >= fields) return;
    const uint64 around = space.field_key[at] + key_step(o);
    const uint32 block = below(space.block_key, blocks, around);
    const bool there = block < blocks && space.block_key[block] == around;
    space.field_blocks[index] = there ? int(block) : -1;
    if (at < blocks)
        space.block_fields[index] =
            below(space.field_key, fields, space.block_key[at] + key_step(o));
}

__device__ __forceinline__ bool same_place(const Space& space, uint32 a, uint32 b) {
    return space.field_key[a] >> BODY_BITS == space.field_key[b] >> BODY_BITS;
}

// Whether a collider may touch what reaches `reach` [cells] from the `middle` of a block.
__device__ __forceinline__ bool is_near(
    const Space& space, uint64 key, uint32 collider, uint32 step, double middle, double reach) {
    const double* row = collider_row(space, collider, step);
    // Distance to a height field is measured along one normal, which misses nearby slopes.
    const double slack = int(row[KIND]) == HEIGHT_FIELD ? BLOCK_REACH : 0.0;
    const double x = (coordinate(key, 0) * BLOCK + middle) * space.dx;
    const double y = (coordinate(key, 1) * BLOCK + middle) * space.dx;
    const double z = (coordinate(key, 2) * BLOCK + middle) * space.dx;
    const double far = (reach + COLLIDER_MARGIN + slack) * space.dx;
    return contact::collider_distance(row, space.heights, x, y, z).at0 < far;
}

__device__ __forceinline__ bool near_field(
    const Space& space, uint32 field, uint32 collider, uint32 step) {
    return is_near(
        space, space.field_key[field], collider, step, (BLOCK - 1) / 2.0, BLOCK_REACH);
}

__device__ __forceinline__ bool near_block(
    const Space& space, uint32 block, uint32 collider, uint32 step) {
    if (collider_row(space, collider, step)[THIN] < 0.5) return false;
    return is_near(
        space, space.block_key[block], collider, step, PARTICLE_CENTRE, PARTICLE_REACH);
}

// Counts what is near each field and block when a substep begins.
extern "C" __global__ void __launch_bounds__(THREADS) mark_lists(const Space* given, uint32 step) {
    const Space& space = *given;
    const Held& held = *space.held;
    const uint32 index = thread_number();
    if (is_halted(space, AFTER_ANY)) return;
    const Together at = together(held);
    if (index < held.fields) {
        uint32 contacts = 0, last = index;
        for (uint32 k = 0; k < space.colliders; ++k) contacts += near_field(space, index, k, step);
        while (last + 1 < held.fields && same_place(space, index, last + 1)) ++last;
        space.counts[index] = index == 0 || !same_place(space, index, index - 1);
        space.counts[at.contacts + index] = contacts;
        space.counts[at.pairs + index] = last - index;
    }
    if (index < held.blocks) {
        uint32 thins = 0;
        for (uint32 k = 0; k < space.colliders; ++k) thins += near_block(space, index, k, step);
        space.counts[at.thins + index] = thins;
    }
}

// Starts of the lists, and what is on them.
extern "C" __global__ void __launch_bounds__(THREADS) fill_lists(const Space* given, uint32 step) {
    const Space& space = *given;
    Held& held = *space.held;
    const uint32 index = thread_number();
    if (is_halted(space, AFTER_ANY)) return;
    const Together at = together(held);
    const uint32* counts = space.counts;
    const uint32 contacts = counts[at.pairs] - counts[at.contacts];
    const uint32 pairs = counts[at.thins] - counts[at.pairs];
    const uint32 thins = counts[at.end] - counts[at.thins];
    if (index == 0) {
        held.groups = counts[at.contacts];
        held.contacts = contacts;
        held.pairs = pairs;
        held.thins = thins;
        space.group_start[held.groups] = held.fields;
        space.contact_start[held.fields] = contacts;
        space.pair_start[held.fields] = pairs;
        space.thin_start[held.blocks] = thins;
    }
    if (contacts > space.contact_capacity || pairs > space.pair_capacity ||
        thins > space.thin_capacity)
        return;  // find_near says so.
    if (index < held.fields) {
        if (counts[index + 1] != counts[index]) space.group_start[counts[index]] = index;
        uint32 next = counts[at.contacts + index] - counts[at.contacts];
        space.contact_start[index] = next;
        const uint32 first = next;
        for (uint32 k = 0; k < space.colliders; ++k)
            if (near_field(space, index, k, step)) {
                space.contact_collider[next] = k;
                space.contact_field[next++] = index;
            }
        uint32 pair = counts[at.pairs + index] - counts[at.pairs];
        const uint32 end = counts[at.pairs + index + 1] - counts[at.pairs];
        space.pair_start[index] = pair;
        const bool shared = pair < end || (index > 0 && same_place(space, index, index - 1));
        for (; pair < end; ++pair) space.pair_field[pair] = index;
        space.field_near[index] = shared || next > first;
    }
    if (index < held.blocks) {
        uint32 next = counts[at.thins + index] - counts[at.thins];
        space.thin_start[index] = next;
        for (uint32 k = 0; k < space.colliders; ++k)
            if (near_block(space, index, k, step)) {
                space.thin_collider[next] = k;
                space.thin_block[next++] = index;
            }
    }
}

// Which blocks must tell their moments, as contact is possible around them.
extern "C" __global__ void __launch_bounds__(THREADS) find_near(const Space* given, uint32) {
    const Space& space = *given;
    Held& held = *space.held;
    const uint32 index = thread_number();
    if (is_halted(space, AFTER_ANY)) return;
    if (held.contacts > space.contact_capacity || held.pairs > space.pair_capacity ||
        held.thins > space.thin_capacity) {
        if (index == 0) atomicOr(&held.fault, OVERFLOW);
        return;
    }
    if (index >= held.blocks) return;
    uint32 near = 0;
    for (uint32 o = 0; o < AROUND; ++o)
        near |= space.field_near[space.block_fields[index * AROUND + o]];
    space.block_near[index] = near;
}
