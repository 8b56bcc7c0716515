"""What was seen of an object: boxes of a tracker, marked points, images.

Each compares itself with a simulation by differences over what it is known to, so that all may be
taken together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float, quaternion_to_matrix
from ...geometry.transform import apply_transform
from ...physics.errors import PhysicsError
from ...render import render_cameras
from ...scene import Camera, Scene, Trajectory
from ..embedding import Embedding
from ..playback import PlacedObject, PlacedObjects, Playback
from ..result import ObjectResult, SimulationResult

IMAGE_WIDTH = 96
"""Images are compared at this width or below [px]."""


@dataclass(frozen=True, eq=False)
class Simulated:
    """A simulation as observations see it.

    Attributes:
        scene, state: what was simulated.
        subject: the object that was observed.
        result: with a frame at each instant that anybody observed.
    """

    scene: Scene
    state: PlacedObjects
    subject: PlacedObject
    result: SimulationResult

    @property
    def own(self) -> ObjectResult:
        """The object's part of the result."""
        return self.result.objects[self.subject.object_id]

    def frames(self, times_s: Float) -> list[int]:
        """The frames of instants [s]."""
        return [int(np.abs(self.result.times_s - t).argmin()) for t in times_s]

    def displacements(self, frame: int) -> Float:
        """[N, 3] of particles, object frame [m]."""
        moved = self.own.displacements(frame)
        return np.zeros(self.own.rest.shape) if moved is None else moved.astype(np.float64)


class Observation(Protocol):
    """One kind of what was seen."""

    @property
    def times_s(self) -> Float:
        """Instants since the start of the simulation [s]."""
        ...

    def differences(self, simulated: Simulated) -> Float:
        """[M] simulated less observed, over what each is known to."""
        ...


@dataclass(frozen=True, eq=False)
class BoxTrack:
    """Boxes of a tracker.

    Attributes:
        times_s: [T] since the start of the simulation [s].
        positions: [T, 3] of box centres, world [m].
        quaternions: [T, 4] wxyz; None where only places are known.
        sizes: [T, 3] of the boxes, which shorten when an object is crushed [m]; None: as it was.
        position_sigma, heading_sigma, size_sigma: what they are known to [m], [rad], [m].

    Raises:
        PhysicsError: for shapes that do not fit, values that are not finite or times that are none.
    """

    times_s: Float
    positions: Float
    quaternions: Float | None = None
    sizes: Float | None = None
    position_sigma: float = 0.05
    heading_sigma: float = 0.02
    size_sigma: float = 0.05

    def __post_init__(self) -> None:
        count = _checked_times(self.times_s)
        for name, width in (("positions", 3), ("quaternions", 4), ("sizes", 3)):
            value = getattr(self, name)
            if value is not None:
                _require_shape(name, value, (count, width))
        _require_sigmas(self, "position_sigma", "heading_sigma", "size_sigma")

    def differences(self, simulated: Simulated) -> Float:
        """See :class:`Observation`."""
        parts = []
        rest = simulated.own.rest.astype(np.float64)
        low, high = rest.min(axis=0), rest.max(axis=0)
        for k, frame in enumerate(simulated.frames(self.times_s)):
            pose = simulated.own.transform(frame)
            centre = pose[:3, 3]
            if self.sizes is not None:
                now = rest + simulated.displacements(frame)
                below, above = now.min(axis=0) - low, now.max(axis=0) - high
                size = np.asarray(simulated.subject.scaled_size) + above - below
                parts.append((size - self.sizes[k]) / self.size_sigma)
                centre = centre + pose[:3, :3] @ (above + below) / 2
            parts.append((centre - self.positions[k]) / self.position_sigma)
            if self.quaternions is not None:
                turn = quaternion_to_matrix(self.quaternions[k]).T @ pose[:3, :3]
                axial = np.array([turn[2, 1], turn[0, 2], turn[1, 0]]) - np.array(
                    [turn[1, 2], turn[2, 0], turn[0, 1]]
                )
                parts.append(axial / 2 / self.heading_sigma)
        return np.concatenate(parts)


@dataclass(frozen=True, eq=False)
class MarkedPoints:
    """Points of an object that were followed, as stickers or corners of lamps.

    Attributes:
        places: [P, 3] where they are on the object before anything happens, object frame [m].
        times_s: [T] since the start of the simulation [s].
        positions: [T, P, 3] where they were seen, world [m]; NaN where they were not.
        sigma: what places are known to [m].

    Raises:
        PhysicsError: for shapes that do not fit, or when no point was seen.
    """

    places: Float
    times_s: Float
    positions: Float
    sigma: float = 0.02

    def __post_init__(self) -> None:
        count = _checked_times(self.times_s)
        _require_shape("places", self.places, (len(self.places), 3))
        shape = (count, len(self.places), 3)
        if np.shape(self.positions) != shape:
            raise PhysicsError(f"positions of points must be {shape}, not {self.positions.shape}")
        if not np.isfinite(self.positions).all(axis=2).any():
            raise PhysicsError("no marked point was ever seen; give places for some instants")
        _require_sigmas(self, "sigma")

    def differences(self, simulated: Simulated) -> Float:
        """See :class:`Observation`."""
        rest = simulated.own.rest.astype(np.float64)
        embedding = Embedding(rest, self.places, spacing=simulated.own.spacing)
        parts = []
        for seen, frame in zip(self.positions, simulated.frames(self.times_s), strict=True):
            local = embedding.follow(simulated.displacements(frame)).positions
            found = np.isfinite(seen).all(axis=1)
            there = apply_transform(simulated.own.transform(frame), local[found])
            parts.append(((there - seen[found]) / self.sigma).ravel())
        return np.concatenate(parts)


@dataclass(frozen=True, eq=False)
class ObservedImages:
    """Pictures, compared with what the renderer makes of the simulation at small size.

    Attributes:
        times_s: [T] since the start of the simulation [s].
        cameras: [T] each of the size of its image.
        T_world_vehicle: [T, 4, 4] what the cameras are on.
        images: [T] of [H, W, 3] uint8.
        sigma: what a pixel is known to, as a fraction of white.

    Raises:
        PhysicsError: for images that are not as large as their cameras.
    """

    times_s: Float
    cameras: Sequence[Camera]
    T_world_vehicle: Float
    images: Sequence[NDArray[np.uint8]]
    sigma: float = 0.05

    def __post_init__(self) -> None:
        count = _checked_times(self.times_s)
        if not count == len(self.cameras) == len(self.images) == len(self.T_world_vehicle):
            raise PhysicsError(
                "images, their cameras, poses and times must be as many as each other"
            )
        for camera, image in zip(self.cameras, self.images, strict=True):
            if image.shape != (camera.height, camera.width, 3):
                raise PhysicsError(
                    f"an image of camera {camera.name!r} must be {camera.height} x {camera.width} "
                    f"x 3, not {image.shape}"
                )
        _require_sigmas(self, "sigma")

    def differences(self, simulated: Simulated) -> Float:
        """See :class:`Observation`."""
        playback = Playback(simulated.scene, simulated.state, simulated.result)
        parts = []
        for k, frame in enumerate(simulated.frames(self.times_s)):
            image = drawn(playback, frame, self.cameras[k], self.T_world_vehicle[k])
            off = image.astype(np.float64) - self.images[k]
            parts.append(off.ravel() / (255 * self.sigma))
        return np.concatenate(parts)


def drawn(
    playback: Playback, frame: int, camera: Camera, T_world_vehicle: Float
) -> NDArray[np.uint8]:
    """[H, W, 3] what a camera sees of a frame, at IMAGE_WIDTH or its own width."""
    [made] = render_cameras(
        playback.instances(frame), [camera], T_world_vehicle, sky=playback.scene.sky
    )
    return made.rgb


def small(camera: Camera, image: NDArray[np.uint8]) -> tuple[Camera, NDArray[np.uint8]]:
    """A camera and its image at IMAGE_WIDTH or below.

    Raises:
        PhysicsError: for an image of other proportions than the camera's.
    """
    import cv2

    height, width = image.shape[:2]
    if abs(height / width - camera.height / camera.width) > 0.02:
        raise PhysicsError(
            f"the image is {width} x {height}, camera {camera.name!r} has {camera.width} x "
            f"{camera.height}: give the whole image, at any size"
        )
    camera = camera.resized(min(width, IMAGE_WIDTH))
    size = (camera.width, camera.height)
    return camera, np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def recorded_track(trajectory: Trajectory, start_us: int, end_us: int) -> BoxTrack:
    """The boxes that were tracked after ``start_us`` and up to ``end_us`` [us].

    Raises:
        PhysicsError: when there is none in that time.
    """
    times = np.asarray(trajectory.times_us)
    own = np.flatnonzero((times > start_us) & (times <= end_us))
    if not len(own):
        raise PhysicsError(
            f"the object was tracked from {times[0]} to {times[-1]} us, never between {start_us} "
            f"and {end_us} us; choose another time, or give observations"
        )
    return BoxTrack(
        np.asarray((times[own] - start_us) * 1e-6, dtype=np.float64),
        np.asarray(trajectory.positions, dtype=np.float64)[own],
        np.asarray(trajectory.quaternions, dtype=np.float64)[own],
    )


def _checked_times(times_s: Float) -> int:
    times = np.asarray(times_s)
    if times.ndim != 1 or not len(times) or not np.isfinite(times).all() or times.min() < 0:
        raise PhysicsError(
            f"times of observations must be seconds from the start on, at least one: {times_s!r}"
        )
    return len(times)


def _require_shape(name: str, value: Float, shape: tuple[int, ...]) -> None:
    if np.shape(value) != shape or not np.isfinite(value).all():
        raise PhysicsError(f"{name} must be {shape} finite numbers, not {np.shape(value)}")


def _require_sigmas(observation: object, *names: str) -> None:
    for name in names:
        value = getattr(observation, name)
        if not (np.isfinite(value) and value > 0):
            raise PhysicsError(f"{name} must be positive, not {value!r}")
