"""Eight-lane SIMD arithmetic against NumPy in float64."""

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from real2sim_server.render._cpu.lanes import LANES, Planes, logarithm, mask_bits, mask_of


@intrinsic
def logarithm_of_eight(typingctx, planes):
    def generate(context, builder, signature, arguments):
        data = context.make_array(planes)(context, builder, arguments[0]).data
        eight = Planes(builder, data, ir.IntType(64)(0), planes=1)
        eight.store(0, logarithm(eight.load(0)))
        return context.get_dummy_value()

    return types.void(planes), generate


@intrinsic
def same_lanes(typingctx, lanes):
    def generate(context, builder, signature, arguments):
        return mask_bits(builder, mask_of(builder, arguments[0]))

    return types.int64(types.int64), generate


@numba.njit
def through_a_mask(lanes):
    return same_lanes(lanes)


@numba.njit
def logarithms(numbers):
    for first in range(0, len(numbers), LANES):
        logarithm_of_eight(numbers[first : first + LANES])


def test_logarithm_is_accurate_for_all_opacities():
    opacities = np.concatenate([np.geomspace(1e-6, 1, 4000), np.linspace(0.9, 1, 96)])
    opacities = opacities.astype(np.float32)
    found = opacities.copy()
    logarithms(found)
    expected = np.log(opacities.astype(np.float64))
    assert (np.abs(found - expected) < 3e-7 * np.abs(expected).clip(1)).all()


def test_logarithm_of_one_is_zero():
    numbers = np.ones(LANES, np.float32)
    logarithms(numbers)
    assert (numbers == 0).all()


def test_masks_round_trip_to_bits():
    assert [through_a_mask(lanes) for lanes in range(256)] == list(range(256))
