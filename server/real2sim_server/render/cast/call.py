"""The one call: a sweep of a LiDAR through Gaussians."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...geometry.rotation import Float
from ...geometry.transform import are_rigid
from ...scene import Lidar
from ..types import Instance, RenderError
from .incidence import attributes_towards
from .types import CastBackend, CastRequest, Echo


def cast(
    instances: Sequence[Instance],
    lidar: Lidar,
    T_world_lidar: ArrayLike,
    *,
    object_poses: Sequence[ArrayLike | None] | None = None,
    attributes: Sequence[NDArray[np.float32] | None] | None = None,
    incidence: float = 1.0,
    backend: str = "auto",
) -> Echo:
    """What every ray of one sweep meets; :func:`.detect` makes measurements of it.

    Each Gaussian answers a ray by its value at the point of the ray where it is largest (exact in
    3D, after Moenne-Loccoz et al. 2024), which is also the range of its sample. Samples are taken
    from near to far by the distance of their centres.

    Args:
        instances: what the light meets.
        lidar: the sensor.
        T_world_lidar: pose of the sensor, [4, 4] when it stands still, else [S, 4, 4] at the
            instants ``lidar.beams.slots[0]``.
        object_poses: for each instance ``T_world_object`` [S, 4, 4] at the same instants, or None
            where it stands at its own; None for all that stand still.
        attributes: for each instance [N, 2] float32, reflectivity and share of lost rays.
        incidence: share of the reflectivity that does not mind how squarely the light meets a
            surface, 0 to 1; the rest goes with the cosine to its normal.
        backend: ``cpu``, ``cuda``, ``reference``, or ``auto``, which is ``cpu``.

    Raises:
        RenderError: poses or attributes of other shapes or values, a backend that is unknown or
            lacks what it needs.
    """
    request = checked_request(
        instances,
        lidar,
        T_world_lidar,
        object_poses=object_poses,
        attributes=attributes,
        incidence=incidence,
    )
    return select_caster(backend).cast(request)


def checked_request(
    instances: Sequence[Instance],
    lidar: Lidar,
    T_world_lidar: ArrayLike,
    *,
    object_poses: Sequence[ArrayLike | None] | None = None,
    attributes: Sequence[NDArray[np.float32] | None] | None = None,
    incidence: float = 1.0,
) -> CastRequest:
    """The request of :func:`cast`. Raises like it."""
    if not 0 <= incidence <= 1:
        raise RenderError(f"incidence must be from 0 to 1, not {incidence!r}")
    request = CastRequest(
        instances=tuple(instances),
        lidar=lidar,
        T_world_lidar=_poses(T_world_lidar, lidar, "T_world_lidar"),
        object_poses=_object_poses(object_poses, instances, lidar),
        attributes=_attributes(attributes, instances),
    )
    if incidence == 1:
        return request
    return replace(request, attributes=attributes_towards(request, incidence))


def prepare_rays(lidar: Lidar) -> None:
    """Make what casting on the CPU keeps of a sensor's rays, on any thread: half a million of them
    take a second at their first sweep otherwise."""
    from .cpu.layout import layout_of

    layout_of(lidar.beams)


@cache
def select_caster(name: str = "auto") -> CastBackend:
    """The backend of that name, made on first use.

    Raises:
        RenderError: unknown, or something that it needs is not here.
    """
    chosen = "cpu" if name == "auto" else name
    if chosen not in CASTERS:
        raise RenderError(f"unknown cast backend {name!r}; allowed are 'auto' and {list(CASTERS)}")
    return CASTERS[chosen]()


def _cpu() -> CastBackend:
    from .cpu.backend import CpuCaster

    return CpuCaster()


def _reference() -> CastBackend:
    from .reference import ReferenceCaster

    return ReferenceCaster()


def _cuda() -> CastBackend:
    from ..backends.nvrtc.needs import unmet_need

    need = unmet_need()
    if need is not None:
        raise RenderError(f"cast backend 'cuda': {need.found}; {need.remedy}")
    from .cuda.backend import CudaCaster

    return CudaCaster()


CASTERS: Mapping[str, Callable[[], CastBackend]] = {
    "cpu": _cpu,
    "cuda": _cuda,
    "reference": _reference,
}


def _poses(given: ArrayLike, lidar: Lidar, what: str) -> Float:
    count = len(lidar.beams.slots[0])
    poses = np.asarray(given, dtype=np.float64)
    if poses.shape == (4, 4):
        poses = np.broadcast_to(poses, (count, 4, 4))
    if poses.shape != (count, 4, 4):
        raise RenderError(
            f"{what} must be [4, 4] or [{count}, 4, 4], a pose for each instant of the sweep of "
            f"{lidar.name!r}, not {list(poses.shape)}"
        )
    bad = int((~are_rigid(poses)).sum())
    if bad:
        raise RenderError(f"{what}: {bad} of {count} poses are no rigid transforms")
    return poses


def _object_poses(
    given: Sequence[ArrayLike | None] | None, instances: Sequence[Instance], lidar: Lidar
) -> tuple[Float | None, ...]:
    if given is None:
        return (None,) * len(instances)
    if len(given) != len(instances):
        raise RenderError(f"object_poses: {len(given)} entries for {len(instances)} instances")
    return tuple(
        None if poses is None else _poses(poses, lidar, f"object_poses[{index}]")
        for index, poses in enumerate(given)
    )


def _attributes(
    given: Sequence[NDArray[np.float32] | None] | None, instances: Sequence[Instance]
) -> tuple[NDArray[np.float32] | None, ...]:
    if given is None:
        return (None,) * len(instances)
    if len(given) != len(instances):
        raise RenderError(f"attributes: {len(given)} entries for {len(instances)} instances")
    checked: list[NDArray[np.float32] | None] = []
    for index, (values, instance) in enumerate(zip(given, instances, strict=True)):
        if values is None:
            checked.append(None)
            continue
        array = np.ascontiguousarray(values, dtype=np.float32)
        if array.shape != (len(instance.cloud), 2) or not np.isfinite(array).all():
            raise RenderError(
                f"attributes[{index}] must be [{len(instance.cloud)}, 2] finite numbers, not "
                f"{list(array.shape)}"
            )
        checked.append(array)
    return tuple(checked)
