"""Ray casting of LiDAR sweeps, for given instances or a recorded scene."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from ..._numba import is_on_disk
from ...geometry import (
    Float,
    are_rigid,
    invert_transform,
    quaternion_to_matrix,
    slerp,
    transform_from,
)
from ...scene import Beams, GaussianCloud, Lidar, Scene, Trajectory
from .._cpu.drawing import array_of
from ..types import Instance, RenderError
from .layout import AZIMUTH_BINS, layout_of
from .types import CastBackend, CastRequest, Echo

# Intensity by the angle of incidence

Array = NDArray[np.float32]
_normals: weakref.WeakKeyDictionary[GaussianCloud, Array] = weakref.WeakKeyDictionary()


def facing(cloud: GaussianCloud, beams: Beams, T_cloud_lidar: Float) -> Array:
    """Cosine [N] of the angle between each Gaussian's shortest axis and the ray to its centre.

    Args:
        cloud: Gaussians in their own frame.
        beams: beams of the sensor.
        T_cloud_lidar: [S, 4, 4] pose of the sensor in that frame at each instant of the sweep.
    """
    means = array_of(cloud.means)
    middle = invert_transform(T_cloud_lidar[len(T_cloud_lidar) // 2])[:2].astype(np.float32)
    across = means @ middle[:, :3].T + middle[:, 3]
    azimuth = np.arctan2(across[:, 1], across[:, 0])
    bins = ((azimuth + np.float32(np.pi)) * np.float32(AZIMUTH_BINS / (2 * np.pi))).astype(np.int32)
    slots = layout_of(beams).slot_of[np.clip(bins, 0, AZIMUTH_BINS - 1)]
    away = means - T_cloud_lidar[:, :3, 3].astype(np.float32)[slots]
    across_surface = np.abs(np.einsum("ni,ni->n", away, normals_of(cloud)))
    distance = np.sqrt(np.einsum("ni,ni->n", away, away))
    cosine: Array = across_surface / np.maximum(distance, np.float32(1e-6))
    return cosine


def facing_of_request(request: CastRequest) -> list[Array]:
    """:func:`facing` of the Gaussians of each instance."""
    return [_facing_of(request, index) for index in range(len(request.instances))]


def attributes_towards(request: CastRequest, incidence: float) -> tuple[Array | None, ...]:
    """Attributes of a request with the reflectivity of Gaussians towards its sensor."""
    alike = np.float32(incidence)
    found: list[Array | None] = []
    for index, given in enumerate(request.attributes):
        if given is not None:
            towards = given[:, 0] * (alike + (1 - alike) * _facing_of(request, index))
            found.append(np.stack([towards, given[:, 1]], axis=1))
        else:
            found.append(None)
    return tuple(found)


def _facing_of(request: CastRequest, index: int) -> Array:
    instance, poses = request.instances[index], request.object_poses[index]
    placed = instance.T_world_object if poses is None else poses
    T_cloud_world = np.eye(4) if placed is None else invert_transform(np.asarray(placed))
    return facing(instance.cloud, request.lidar.beams, T_cloud_world @ request.T_world_lidar)


def normals_of(cloud: GaussianCloud) -> Array:
    """Shortest axes [N, 3]; cached for the lifetime of the cloud."""
    known = _normals.get(cloud)
    if known is None:
        shortest = array_of(cloud.scales).argmin(1)
        axes = quaternion_to_matrix(array_of(cloud.quats)).astype(np.float32)
        normals = np.take_along_axis(axes, shortest[:, None, None], axis=2)[:, :, 0]
        known = _normals[cloud] = np.ascontiguousarray(normals)
    return known


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
    """Cast the rays of one sweep; pass the result to :func:`.detect` for measurements.

    The response of a Gaussian to a ray is its maximum along the ray (exact in 3D, after
    Moenne-Loccoz et al. 2024); the position of the maximum is the range of the sample. Samples are
    sorted by the distance of the Gaussians' centres.

    Args:
        instances: instances in the scene.
        lidar: the sensor.
        T_world_lidar: pose of the sensor, [4, 4] if stationary, else [S, 4, 4] at the instants
            ``lidar.beams.slots[0]``.
        object_poses: for each instance ``T_world_object`` [S, 4, 4] at the same instants, or None
            if it is stationary; None if all are stationary.
        attributes: for each instance [N, 2] float32, reflectivity and fraction of lost rays.
        incidence: fraction of the reflectivity that is independent of the angle of incidence, 0 to
            1; the rest is proportional to the cosine of that angle.
        backend: ``cpu``, ``cuda``, ``reference``, or ``auto``, which is ``cpu``.

    Raises:
        RenderError: invalid poses or attributes, or an unknown or unusable backend.
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
    """The validated request of :func:`cast`; raises the same errors."""
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
    """Prepare the ray tables of a sensor for the CPU backend; thread-safe.

    Otherwise the first sweep is delayed, by a second for half a million rays.
    """
    from .layout import layout_of

    layout_of(lidar.beams)


@cache
def select_caster(name: str = "auto") -> CastBackend:
    """Return the backend with a name, created on first use.

    Raises:
        RenderError: unknown backend, or missing requirements.
    """
    chosen = "cpu" if name == "auto" else name
    if chosen not in CASTERS:
        raise RenderError(f"unknown cast backend {name!r}; allowed are 'auto' and {list(CASTERS)}")
    return CASTERS[chosen]()


def _cpu() -> CastBackend:
    from .cpu import CpuCaster

    return CpuCaster()


def _reference() -> CastBackend:
    from .reference import ReferenceCaster

    return ReferenceCaster()


def _cuda() -> CastBackend:
    from .._cuda.needs import unmet_nvrtc_need

    need = unmet_nvrtc_need()
    if need is not None:
        raise RenderError(f"cast backend 'cuda': {need.found}; {need.remedy}")
    from .cuda import CudaCaster

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
        raise RenderError(f"{what}: {bad} of {count} poses are not rigid transforms")
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


# Recorded scenes: objects move along their trajectories.

Attributes = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class SweepScene:
    """Ray targets: one entry per instance, as for :func:`~.call.cast`, and their ``incidence``."""

    instances: tuple[Instance, ...]
    poses: tuple[Float | None, ...]
    attributes: tuple[Attributes | None, ...]
    incidence: float = 1.0

    def request(self, lidar: Lidar, T_world_lidar: ArrayLike) -> CastRequest:
        """A request for a sweep. Raises RenderError like :func:`~.call.cast`."""
        return checked_request(
            self.instances,
            lidar,
            T_world_lidar,
            object_poses=self.poses,
            attributes=self.attributes,
            incidence=self.incidence,
        )


def recorded_sweep(scene: Scene, lidar: Lidar, t_us: int, *, backend: str = "auto") -> Echo:
    """Cast the sweep of ``lidar`` on the recording vehicle around ``t_us`` [us].

    Uses the scene's LiDAR Gaussians (``scene.lidar``) if it has them.
    """
    met = recorded_scene(scene, lidar, t_us)
    request = met.request(lidar, sensor_poses(scene.ego, lidar, t_us))
    return select_caster(backend).cast(request)


def recorded_scene(scene: Scene, lidar: Lidar, t_us: int) -> SweepScene:
    """The background and the objects present at ``t_us``, with their motion over the sweep."""
    times = t_us + lidar.beams.slots[0]
    cloud, attributes = lidar_target(scene, None)
    instances, known = [Instance(cloud)], [attributes]
    moved: list[Float | None] = [None]
    for index, (object_id, item) in enumerate(scene.objects.items()):
        if not item.trajectory.covers(t_us):
            continue
        cloud, attributes = lidar_target(scene, object_id)
        if item.figure is not None:
            cloud, attributes = item.posed_at(t_us, item.trajectory), None
        pose = item.trajectory.transform(t_us)
        instances.append(Instance(cloud, pose, instance_id=index + 1))
        moved.append(transforms_at(item.trajectory, times))
        known.append(attributes)
    return SweepScene(tuple(instances), tuple(moved), tuple(known), incidence_of(scene))


def lidar_target(scene: Scene, object_id: str | None) -> tuple[GaussianCloud, Attributes | None]:
    """LiDAR Gaussians of an object (None for the background), and their attributes."""
    if scene.lidar is not None:
        held = scene.lidar.background if object_id is None else scene.lidar.objects.get(object_id)
        if held is not None:
            return held.cloud, held.attributes.cpu().numpy()
    return (scene.background if object_id is None else scene.object(object_id).cloud), None


def incidence_of(scene: Scene) -> float:
    """Fraction of a scene's reflectivity that is independent of the angle of incidence."""
    return 1.0 if scene.lidar is None else scene.lidar.incidence


def sensor_poses(ego: Trajectory, lidar: Lidar, t_us: int) -> Float:
    """``T_world_lidar`` [S, 4, 4] on a vehicle with trajectory ``ego`` (``T_world_vehicle``)."""
    return transforms_at(ego, t_us + lidar.beams.slots[0]) @ lidar.T_vehicle_lidar


def transforms_at(trajectory: Trajectory, times_us: Float) -> Float:
    """``T_fixed_moving`` [S, 4, 4] at any times [us].

    Beyond its ends, the trajectory is extrapolated at constant velocity, for the parts of a sweep
    before the first and after the last box.
    """
    known = trajectory.times_us.astype(np.float64)
    if len(known) == 1:
        pose = transform_from(trajectory.positions[0], trajectory.quaternions[0])
        return np.broadcast_to(pose, (len(times_us), 4, 4))
    after = np.clip(np.searchsorted(known, times_us), 1, len(known) - 1)
    part = (times_us - known[after - 1]) / (known[after] - known[after - 1])
    first, last = trajectory.positions[after - 1], trajectory.positions[after]
    positions = first + part[:, None] * (last - first)
    quaternions = slerp(
        trajectory.quaternions[after - 1], trajectory.quaternions[after], np.clip(part, 0.0, 1.0)
    )
    return transform_from(positions, quaternions)


# Warm-up


def kernels_of_casting_on_disk() -> bool:
    """Whether the disk cache has the kernels of :func:`warm_up_casting`."""
    from .blend import follow_rays  # Imported lazily, because it is rarely needed.

    return is_on_disk(follow_rays)


def warm_up_casting() -> None:
    """Compile or load everything that a first sweep needs; takes 20 s the first time."""
    cloud = GaussianCloud(
        means=torch.tensor([[3.0, 0.0, 0.0], [0.4, 0.1, 0.2]]),
        quats=torch.tensor([[1.0, 0, 0, 0]] * 2),
        scales=torch.full((2, 3), 0.3),
        opacities=torch.full((2,), 0.9),
        sh=torch.zeros(2, 1, 3),
    )
    covars = torch.eye(3).repeat(2, 1, 1) * 0.09
    turning = Beams.spinning(np.array([0.0, 0.1]), columns=32)
    table = Beams(np.zeros(8), np.linspace(-0.1, 0.1, 8), np.zeros(8))
    for beams in (turning, table):
        for returns in (1, 3):
            lidar = Lidar("warm-up", beams, returns=returns, divergence=(1e-3, 1e-3))
            moving = np.tile(np.eye(4), (len(beams.slots[0]), 1, 1))
            moving[:, 0, 3] = np.linspace(0.0, 0.1, len(moving))
            cast(
                [Instance(cloud), Instance(cloud, np.eye(4), 1, covars=covars)],
                lidar,
                moving,
                object_poses=[None, moving],
                attributes=[np.full((2, 2), 0.5, np.float32), None],
            )
