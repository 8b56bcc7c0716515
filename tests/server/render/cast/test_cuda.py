"""The CUDA kernels of cast(), compiled for the CPU, match the other backends."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest
import torch

from real2sim_server.geometry import transform_from
from real2sim_server.render import Instance, RenderError
from real2sim_server.render._cuda.needs import unmet_nvrtc_need
from real2sim_server.render.cast import Echo, cast, select_caster
from real2sim_server.render.cast import cuda as cuda_cast
from real2sim_server.render.cast.call import checked_request
from real2sim_server.render.cast.cuda import CudaCaster
from real2sim_server.render.cast.types import CastRequest
from real2sim_server.scene import Beams, Lidar

from ..kernel_twin import COMPILER, NEEDS_COMPILER
from .kernel_twin import CastTwinLauncher, cast_twin
from .test_cast import ROWS, digest, driving, scattered, table

pytestmark = pytest.mark.skipif(COMPILER is None, reason=NEEDS_COMPILER)
SENSORS = {
    "spinning": Beams.spinning(ROWS[::2], columns=48),
    "offsets": Beams.spinning(
        ROWS[::2],
        columns=48,
        clockwise=False,
        azimuth_offset=np.radians(np.tile([8.0, 3, -3, -8], 2)),
    ),
    "table": table(),
}


def sweep(beams: Beams, *, returns: int = 3) -> CastRequest:
    """A sweep of a moving, turning sensor, with a moving and a deformed object."""
    lidar = Lidar(
        "any", beams, min_range=1.0, max_range=40.0, divergence=(0.01, 0.005), returns=returns
    )
    instances, attributes = scattered()
    seconds = beams.slots[0] * 1e-6
    moves = np.stack([9 * seconds, 0 * seconds, 0 * seconds], -1)
    moved = np.asarray(instances[1].T_world_object) @ transform_from(moves, [1.0, 0, 0, 0])
    return checked_request(
        instances,
        lidar,
        driving(lidar, speed=15.0, turn_deg=30.0),
        object_poses=[None, moved, None],
        attributes=attributes,
    )


def on_twin(request: CastRequest, *, backwards: bool = False) -> Echo:
    return CudaCaster(CastTwinLauncher(backwards=backwards)).cast(request)


@pytest.mark.parametrize("sensor", SENSORS)
def test_kernels_match_the_cpu_backend(sensor: str) -> None:
    request = sweep(SENSORS[sensor])
    found, expected = on_twin(request), select_caster("cpu").cast(request)
    assert expected.opacity.mean() > 0.05
    assert np.array_equal(found.member, expected.member)
    assert np.array_equal(found.instance, expected.instance)
    for name in ("range", "opacity"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(expected, name), atol=1e-4, err_msg=name
        )
    for name in ("expected", "intensity", "drop"):
        # Weight by opacity: at low opacity the means are dominated by rounding.
        apart = (getattr(found, name) - getattr(expected, name)) * expected.opacity
        assert np.abs(apart).max() < 2e-4
    for name, given in expected.returns.items():
        np.testing.assert_allclose(found.returns[name].range, given.range, atol=2e-3)
        np.testing.assert_allclose(found.returns[name].power, given.power, atol=2e-4)


def test_results_do_not_depend_on_block_and_thread_order() -> None:
    request = sweep(SENSORS["spinning"], returns=1)
    assert digest(on_twin(request)) == digest(on_twin(request, backwards=True))


def test_sweeps_of_different_sizes_are_independent() -> None:
    small, large = sweep(SENSORS["table"]), sweep(SENSORS["spinning"])
    caster = CudaCaster(CastTwinLauncher())
    digests = [digest(caster.cast(request)) for request in (large, small, large)]
    assert digests == [digest(on_twin(request)) for request in (large, small, large)]


def test_an_empty_world_gives_no_return() -> None:
    lidar = Lidar("any", SENSORS["spinning"], min_range=1.0, max_range=40.0)
    echo = on_twin(checked_request([], lidar, np.eye(4)))
    assert not echo.hit.any()
    assert (echo.member == -1).all()


def test_objects_outside_the_range_limits_are_not_hit() -> None:
    instances, _ = scattered()
    lidar = Lidar("any", SENSORS["spinning"], min_range=90.0, max_range=100.0)
    assert not on_twin(checked_request(instances, lidar, np.eye(4))).opacity.any()


def test_structures_match_the_kernel_source() -> None:
    sizes = (ctypes.c_uint32 * 3)()
    cast_twin().sizes(sizes)
    expected = [cuda_cast.MET_BYTES, cuda_cast.BODY.itemsize, cuda_cast.SWEEP.itemsize]
    assert list(sizes) == expected


@pytest.mark.skipif(unmet_nvrtc_need() is None, reason="there is a GPU")
def test_without_a_gpu_the_missing_requirement_is_named() -> None:
    instances, _ = scattered()
    lidar = Lidar("any", SENSORS["spinning"], min_range=1.0, max_range=40.0)
    with pytest.raises(RenderError, match=r"cast backend 'cuda': .+; .+"):
        cast([Instance(instances[0].cloud)], lidar, np.eye(4), backend="cuda")


@pytest.mark.gpu
@pytest.mark.skipif(
    unmet_nvrtc_need() is not None, reason="no GPU that the kernels can be compiled for"
)
def test_gpu_results_match_the_cpu() -> None:
    request = sweep(SENSORS["spinning"])
    on_gpu, on_cpu = CudaCaster().cast(request), select_caster("cpu").cast(request)
    assert (on_gpu.member == on_cpu.member).mean() > 0.999
    np.testing.assert_allclose(on_gpu.opacity, on_cpu.opacity, atol=1e-3)
    assert torch.cuda.is_available()
