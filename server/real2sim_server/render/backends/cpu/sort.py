"""Order of all records by depth: one stable LSD radix sort.

Work is split into chunks of fixed number, so the result does not depend on the number of threads;
ties keep the order of instances and of Gaussians in them.
"""

from __future__ import annotations

import numpy as np
from numba import prange
from numpy.typing import NDArray

from ...._numba import PARALLEL_LOOPS
from .kernel import kernel
from .records import CHUNK, Records

DIGIT_BITS = 11
SORT_CHUNKS = 8
Pairs = NDArray[np.uint64]


def sort_records(records: Records, regions: int, pairs: Pairs, scratch: Pairs) -> Pairs:
    """Depth order of the records in the first ``regions`` regions.

    Args:
        pairs, scratch: [M] uint64 work space, M at least the number of records in use.

    Returns:
        Part of one of the two arrays: record indices in the low 32 bits, from near to far.
    """
    ends = np.cumsum(records.counts[:regions])
    total = int(ends[-1]) if regions else 0
    if total == 0:
        return pairs[:0]
    low, high = gather_pairs(records.depths.view(np.uint32), records.counts, ends, pairs)
    bits = int(high - low).bit_length()
    passes = -(-bits // DIGIT_BITS)
    for index in range(passes):
        width = -(-bits // passes)
        radix_pass(pairs, scratch, total, 32 + index * width, width)
        pairs, scratch = scratch, pairs
    return pairs[:total]


@kernel(parallel=PARALLEL_LOOPS)
def gather_pairs(keys, counts, ends, pairs):
    """Pack (key - smallest key) and record index; return the smallest and largest key.

    Keys are the bits of depths, which sort like depths since these are positive.
    """
    lows = np.full(ends.shape[0], 0xFFFFFFFF, np.uint32)
    highs = np.zeros(ends.shape[0], np.uint32)
    for region in prange(ends.shape[0]):
        for i in range(region * CHUNK, region * CHUNK + counts[region]):
            lows[region] = min(lows[region], keys[i])
            highs[region] = max(highs[region], keys[i])
    low, high = np.uint32(0xFFFFFFFF), np.uint32(0)
    for region in range(ends.shape[0]):
        low, high = min(low, lows[region]), max(high, highs[region])
    for region in prange(ends.shape[0]):
        target = ends[region] - counts[region]
        for i in range(counts[region]):
            index = region * CHUNK + i
            pairs[target + i] = (np.uint64(keys[index] - low) << np.uint64(32)) | np.uint64(index)
    return np.int64(low), np.int64(high)


@kernel(parallel=PARALLEL_LOOPS)
def radix_pass(source, target, total, shift, width):
    """Stable counting sort of ``source[:total]`` by ``width`` bits from ``shift`` on."""
    size = 1 << width
    mask, low = np.uint64(size - 1), np.uint64(shift)
    step = (total + SORT_CHUNKS - 1) // SORT_CHUNKS
    cursor = np.zeros((SORT_CHUNKS, size), np.int64)
    for chunk in prange(SORT_CHUNKS):
        for i in range(chunk * step, min(total, (chunk + 1) * step)):
            cursor[chunk, (source[i] >> low) & mask] += 1
    position = 0
    for digit in range(size):
        for chunk in range(SORT_CHUNKS):
            count = cursor[chunk, digit]
            cursor[chunk, digit] = position
            position += count
    for chunk in prange(SORT_CHUNKS):
        for i in range(chunk * step, min(total, (chunk + 1) * step)):
            digit = (source[i] >> low) & mask
            target[cursor[chunk, digit]] = source[i]
            cursor[chunk, digit] += 1
