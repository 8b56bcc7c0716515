"""REST models of scenes and scenarios, and their Gaussians as files for external renderers."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

from torch import Tensor

from real2sim_proto.base import Track
from real2sim_proto.scenes import CameraInfo, ObjectInfo, SceneInfo, SceneState
from real2sim_proto.sensors import OpticsSpec

from ...edit import ObjectState
from ...geometry import invert_transform
from ...scene import Camera, GaussianCloud, Trajectory
from ...scene.io import SceneSummary
from ...scene.io.splat_format import UpAxis
from ...scene.io.splats import upright
from ...scene.io.spz import Spz
from ...scene.lens import lens_values
from .scenes import Listing


def scene_info(
    listing: Listing, state: SceneState, *, summary: SceneSummary | None, tracks: bool
) -> SceneInfo:
    """The info of a scene.

    Args:
        listing: listing of the scene folder.
        state: its loading state.
        summary: its content; None if it is broken.
        tracks: whether to include the ego path and trajectories.
    """
    if summary is None:
        return SceneInfo(scene=listing.name, state=state, reason=listing.reason)
    low, high = summary.bounds or (None, None)
    return SceneInfo(
        scene=listing.name,
        state=state,
        content_hash=summary.content_hash,
        gaussians=summary.gaussian_count,
        bytes=summary.nbytes,
        start_us=summary.start_us,
        end_us=summary.end_us,
        frame_times_us=summary.frame_times_us.tolist(),
        cameras=[camera_info(c) for c in summary.rig],
        objects=scene_objects(summary, tracks=tracks),
        extent_min=low,
        extent_max=high,
        ego=track(summary.ego) if tracks else None,
        provenance=dict(summary.provenance),
        has_uncertainties=summary.has_uncertainties,
        lane_count=summary.lane_count,
    )


def scene_objects(summary: SceneSummary, *, tracks: bool) -> list[ObjectInfo]:
    """The objects of an unedited scene, with the renderer's instance ids."""
    return [
        ObjectInfo(
            object_id=o.object_id,
            category=o.category,
            size=o.size,
            instance_id=1 + index,
            gaussians=o.gaussians,
            start_us=o.trajectory.start_us,
            end_us=o.trajectory.end_us,
            trajectory=track(o.trajectory) if tracks else None,
        )
        for index, o in enumerate(summary.objects)
    ]


def edited_objects(
    objects: Iterable[ObjectState], summary: SceneSummary, *, tracks: bool
) -> list[ObjectInfo]:
    """The objects of a scenario."""
    gaussians = {o.object_id: o.gaussians for o in summary.objects}
    return [
        ObjectInfo(
            object_id=o.object_id,
            category=o.category,
            size=o.scaled_size,
            instance_id=o.instance_id,
            gaussians=o.asset.gaussians if o.asset else gaussians[o.source_id],
            start_us=o.trajectory.start_us,
            end_us=o.trajectory.end_us,
            trajectory=track(o.trajectory) if tracks else None,
            recorded_id=None if o.asset else o.source_id,
            asset_id=o.asset.asset_id if o.asset else None,
            physics=o.physics,
            velocity=o.velocity,
            gait=o.gait,
        )
        for o in objects
    ]


def camera_info(camera: Camera) -> CameraInfo:
    """A camera as a protocol model."""
    return CameraInfo(
        name=camera.name,
        width=camera.width,
        height=camera.height,
        K=camera.K.tolist(),
        T_vehicle_camera=camera.T_vehicle_camera.tolist(),
        recorded=recorded_optics(camera),
    )


def recorded_optics(camera: Camera) -> OpticsSpec | None:
    """The real optics of a camera, as a protocol model; None if unknown."""
    known = camera.recorded
    if known is None:
        return None
    shutter = {"direction": known.shutter.direction, "readout_us": known.shutter.readout_us}
    lens = lens_values(known.lens) or {"model": "pinhole"}
    return OpticsSpec.model_validate({"K": known.K.tolist(), "lens": lens, "shutter": shutter})


def camera_infos(cameras: Sequence[Camera]) -> list[CameraInfo]:
    """Cameras in order."""
    return [camera_info(camera) for camera in cameras]


def track(trajectory: Trajectory) -> Track:
    """A trajectory as a protocol model."""
    # Skip validation: the trajectory is valid, and validating thousands of poses would block the
    # event loop.
    return Track.model_construct(
        times_us=trajectory.times_us.tolist(),
        positions=[tuple(p) for p in trajectory.positions.tolist()],
        quaternions=[tuple(q) for q in trajectory.quaternions.tolist()],
    )


# Gaussians as files: sorted and packed once.

GZIP_LEVEL = 1
"""Six times as fast as level 9, for 3 % more bytes."""

MAX_BYTES = 64 << 20

Kept = TypeVar("Kept", bytes, Tensor)


def spz_of(cloud: GaussianCloud, up_axis: UpAxis) -> bytes:
    """An spz file of ``cloud`` (z up), with ``up_axis`` up."""
    if up_axis != "z":
        cloud = cloud.moved(invert_transform(upright(up_axis, 0.0)))
    return Spz(gzip_level=GZIP_LEVEL).encode(cloud)


class SplatFiles:
    """Parts of clouds as spz files, sorted by decreasing coverage, with a least-recently-used
    cache.

    Thread-safe. Work is serialized, because concurrent requests would sort the same cloud twice.

    Args:
        most_bytes: size limit of the cache of orders and files.
    """

    def __init__(self, *, most_bytes: int = MAX_BYTES) -> None:
        self._most_bytes = most_bytes
        self._kept: OrderedDict[tuple[object, ...], bytes | Tensor] = OrderedDict()
        self._bytes = 0
        self._turn = threading.Lock()

    @property
    def held_bytes(self) -> int:
        """Size of the cache [bytes]."""
        return self._bytes

    def part(
        self,
        cloud: GaussianCloud,
        known: tuple[str, ...],
        first: int,
        count: int,
        *,
        up_axis: UpAxis = "y",
    ) -> bytes:
        """An spz file of at most ``count`` Gaussians after the ``first`` ones.

        Args:
            cloud: all Gaussians.
            known: cache key of the content of ``cloud``.
            first: number of Gaussians to skip.
            count: maximum number.
            up_axis: axis that points up in the file.
        """
        with self._turn:
            return self._remembered(
                (*known, first, count, up_axis),
                lambda: spz_of(
                    cloud.select(self._order(cloud, known)[first : first + count].long()), up_axis
                ),
            )

    def _order(self, cloud: GaussianCloud, known: tuple[str, ...]) -> Tensor:
        return self._remembered((*known, "order"), lambda: cloud.by_importance().int())

    def _remembered(self, key: tuple[object, ...], make: Callable[[], Kept]) -> Kept:
        value = self._kept.pop(key, None)
        if value is None:
            value = make()
            self._bytes += _size(value)
        self._kept[key] = value
        while self._bytes > self._most_bytes and len(self._kept) > 1:
            self._bytes -= _size(self._kept.popitem(last=False)[1])
        return value  # type: ignore[return-value]


def _size(value: bytes | Tensor) -> int:
    return len(value) if isinstance(value, bytes) else value.nbytes
