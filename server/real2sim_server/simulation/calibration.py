"""Calibration of an object's materials and motion from tracked boxes, marked points and images.

Each observation returns its residuals divided by their standard deviation, so observations of
different kinds can be combined.
"""

from __future__ import annotations

import base64
import binascii
import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.jobs import Observations as Requested
from real2sim_proto.jobs import ObservedBox, ObservedImage, ObservedPoint

from ..geometry import Float, apply_transform, quaternion_to_matrix
from ..physics.errors import PhysicsError
from ..physics.fitting import Fit, fit
from ..physics.materials import Foam, Material, Snow
from ..render import render_cameras
from ..scene import Camera, Scene, Trajectory
from .body import DeformableBody
from .particles import Embedding
from .result import ObjectResult, PlacedObject, PlacedObjects, Playback, SimulationResult
from .rollout import SimulateOptions, simulate_bodies, solid_background
from .spawn import spawn_bodies
from .structure import GRID_MIN, ObjectPhysics, preset_of

IMAGE_WIDTH = 96
"""Maximum width at which images are compared [px]."""


@dataclass(frozen=True, eq=False)
class Simulated:
    """A simulation to compare with observations.

    Attributes:
        scene, state: the simulated scene and scenario state.
        subject: the observed object.
        result: simulation result with a frame at every observation time.
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
        """Frame indices of instants [s]."""
        return [int(np.abs(self.result.times_s - t).argmin()) for t in times_s]

    def displacements(self, frame: int) -> Float:
        """[N, 3] particle displacements, object frame [m]."""
        moved = self.own.displacements(frame)
        return np.zeros(self.own.rest.shape) if moved is None else moved.astype(np.float64)


class Observation(Protocol):
    """One kind of observation."""

    @property
    def times_s(self) -> Float:
        """Instants since the start of the simulation [s]."""
        ...

    def differences(self, simulated: Simulated) -> Float:
        """[M] residuals, simulated minus observed, divided by the standard deviation."""
        ...


@dataclass(frozen=True, eq=False)
class BoxTrack:
    """Tracked boxes.

    Attributes:
        times_s: [T] since the start of the simulation [s].
        positions: [T, 3] box centres, world frame [m].
        quaternions: [T, 4] wxyz; None if only positions are known.
        sizes: [T, 3] box sizes [m], which shrink when an object is crushed; None if unchanged.
        position_sigma, heading_sigma, size_sigma: standard deviations [m], [rad], [m].

    Raises:
        PhysicsError: for mismatched shapes, values that are not finite, or invalid times.
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
    """Tracked points on an object, such as stickers or corners of lamps.

    Attributes:
        places: [P, 3] points on the undeformed object, object frame [m].
        times_s: [T] since the start of the simulation [s].
        positions: [T, P, 3] observed positions, world frame [m]; NaN if not observed.
        sigma: standard deviation of positions [m].

    Raises:
        PhysicsError: for mismatched shapes, or if no point was observed.
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
    """Images, compared with small renderings of the simulation.

    Attributes:
        times_s: [T] since the start of the simulation [s].
        cameras: [T] cameras, each with the size of its image.
        T_world_vehicle: [T, 4, 4] poses of the vehicle with the cameras.
        images: [T] images [H, W, 3] uint8.
        sigma: standard deviation of a pixel, as a fraction of white.

    Raises:
        PhysicsError: if an image and its camera differ in size.
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
    """[H, W, 3] a camera's rendering of a frame, at IMAGE_WIDTH or its own width."""
    [made] = render_cameras(
        playback.instances(frame), [camera], T_world_vehicle, sky=playback.scene.sky
    )
    return made.rgb


def small(camera: Camera, image: NDArray[np.uint8]) -> tuple[Camera, NDArray[np.uint8]]:
    """A camera and its image at IMAGE_WIDTH or below.

    Raises:
        PhysicsError: if the aspect ratios of image and camera differ.
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
    """The tracked boxes in (``start_us``, ``end_us``] [us].

    Raises:
        PhysicsError: if the interval has no box.
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


# Observations from requests and files, checked against a scene.

MAX_OBSERVED_TIME = 30.0
"""Maximum time of an observation after the start of a simulation [s]."""


def observations_of(
    given: Requested, scene: Scene, subject: PlacedObject, start_us: int, end_us: int
) -> list[Observation]:
    """Convert requested observations, with times in seconds from the start.

    Args:
        given: observations of a request.
        scene: scene with the cameras of the images.
        subject: the observed object.
        start_us, end_us: start and end of the simulation [us]; recorded boxes are used up to the
            end.

    Raises:
        PhysicsError: for times before the start or far beyond it, and unreadable images.
    """
    found: list[Observation] = []
    if given.recorded:
        found.append(recorded_track(subject.trajectory, start_us, end_us))
    for turned in (False, True):
        for sized in (False, True):
            boxes = [
                b
                for b in given.boxes
                if (b.quaternion is not None) == turned and (b.size is not None) == sized
            ]
            if boxes:
                found.append(_boxes(given, boxes, start_us))
    if given.points:
        found.append(_points(given, given.points, start_us))
    if given.images:
        found.append(_images(given, given.images, scene, start_us))
    return found


def _times(times_us: Sequence[int], start_us: int) -> Float:
    times: Float = (np.array(times_us, dtype=np.float64) - start_us) * 1e-6
    if times.min() < 0 or times.max() > MAX_OBSERVED_TIME:
        raise PhysicsError(
            f"observations are from {min(times_us)} to {max(times_us)} us; the simulation begins "
            f"at {start_us} us: give observations after that, over {MAX_OBSERVED_TIME:g} s at "
            "most"
        )
    return times


def _boxes(given: Requested, boxes: Sequence[ObservedBox], start_us: int) -> BoxTrack:
    return BoxTrack(
        _times([b.t_us for b in boxes], start_us),
        np.array([b.position for b in boxes]),
        None if boxes[0].quaternion is None else np.array([b.quaternion for b in boxes]),
        None if boxes[0].size is None else np.array([b.size for b in boxes]),
        position_sigma=given.position_sigma,
        heading_sigma=given.heading_sigma,
        size_sigma=given.size_sigma,
    )


def _points(given: Requested, points: Sequence[ObservedPoint], start_us: int) -> MarkedPoints:
    times_us = sorted({s.t_us for p in points for s in p.seen})
    positions = np.full((len(times_us), len(points), 3), np.nan)
    for k, point in enumerate(points):
        for seen in point.seen:
            positions[times_us.index(seen.t_us), k] = seen.position
    places = np.array([p.place for p in points])
    return MarkedPoints(places, _times(times_us, start_us), positions, given.point_sigma)


def _images(
    given: Requested, images: Sequence[ObservedImage], scene: Scene, start_us: int
) -> ObservedImages:
    cameras = {c.name: c for c in scene.rig.cameras}
    taken = []
    for k, seen in enumerate(images):
        if seen.camera not in cameras:
            raise PhysicsError(
                f"image {k} is of camera {seen.camera!r}; the scene has {', '.join(cameras)}"
            )
        taken.append(small(cameras[seen.camera], _decoded(seen, k)))
    return ObservedImages(
        _times([i.t_us for i in images], start_us),
        [camera for camera, _ in taken],
        np.stack([scene.ego.transform(i.t_us) for i in images]),
        [image for _, image in taken],
        given.image_sigma,
    )


def _decoded(seen: ObservedImage, k: int) -> NDArray[np.uint8]:
    import cv2

    try:
        data = base64.b64decode(seen.image, validate=True)
    except (binascii.Error, ValueError) as problem:
        raise PhysicsError(f"image {k} is not base64: {problem}") from problem
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if image is None:
        raise PhysicsError(f"image {k} is neither PNG nor JPEG, or is damaged")
    return np.asarray(image[:, :, ::-1], dtype=np.uint8)


# The fit.

PARAMETERS = ("stiffness", "yield_stress", "viscosity", "friction", "speed")
"""Parameters that can be fitted: positive factors on the initial values of the object."""
CRUSH_MOST = 0.9
"""Maximum strain at which a crushable material yields, as a fraction of its critical compression.
"""


@dataclass(frozen=True, eq=False)
class ObjectCalibration:
    """The result of a calibration.

    Attributes:
        fit: factors, their uncertainties and residuals.
        values: fitted values of the determined parameters: Young's modulus and yield stress [Pa],
            viscosity [Pa s] of a single material, friction, speed [m/s].
        cell: cell size of the grid [m].
    """

    fit: Fit
    values: dict[str, float]
    cell: float

    def figures(self) -> dict[str, Any]:
        """The result as JSON values; None for factors that the observations do not determine."""
        found = self.fit

        def finite(values: Mapping[str, float]) -> dict[str, float | None]:
            return {name: None if np.isinf(v) else v for name, v in values.items()}

        return {
            "factors": {
                n: None if n in found.undetermined else f for n, f in found.factors.items()
            },
            "uncertainty": finite(found.uncertainty),
            "observation": finite(found.observation),
            "discretisation": finite(found.discretisation),
            "values": self.values,
            "untold": found.undetermined,
            "residual": list(found.residual),
            "runs": found.runs,
            "cell": self.cell,
        }


def calibrate_object(
    scene: Scene,
    state: PlacedObjects,
    options: SimulateOptions,
    object_id: str,
    observations: Sequence[Observation],
    *,
    parameters: Sequence[str],
    steps: int = 12,
    on_run: Callable[[int], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> ObjectCalibration:
    """Fit factors on initial values that make the simulation match the observations.

    Args:
        scene, state, options: simulation with initial values; its duration follows from the
            observations.
        object_id: id of the object to calibrate.
        observations: observations of it, used together.
        parameters: names from PARAMETERS.
        steps: maximum number of search steps.
        on_run: called with the number of simulations after each one.
        cancelled: polled before each simulation step.

    Raises:
        PhysicsError: for invalid simulations, unknown names, and observations without information.
    """
    unknown = [name for name in parameters if name not in PARAMETERS]
    if unknown or not parameters:
        raise PhysicsError(f"cannot fit {unknown}; allowed are {', '.join(PARAMETERS)}")
    if object_id not in options.objects:
        raise PhysicsError(
            f"{object_id!r} is not simulated; simulated objects: {', '.join(options.objects)}"
        )
    if not observations:
        raise PhysicsError("nothing was observed; give boxes, points or images")
    trials = _Trials(scene, state, options, object_id, observations)
    trials.cancelled = cancelled
    runs = 0

    def residuals(factors: Mapping[str, float], coarser: float) -> Float:
        nonlocal runs
        off = trials.differences(factors, coarser)
        runs += 1
        if on_run is not None:
            on_run(runs)
        return off

    found = fit(residuals, parameters, steps=steps)
    body = trials.body()
    return ObjectCalibration(found, _values(body, found), body.cell)


class CalibrationCancelled(Exception):
    """The calibration was cancelled."""


class _Trials:
    """Simulations from the same start with different values."""

    def __init__(
        self,
        scene: Scene,
        state: PlacedObjects,
        options: SimulateOptions,
        object_id: str,
        observations: Sequence[Observation],
    ) -> None:
        self._scene, self._state = scene, state
        if options.background:
            solid = solid_background(scene, state, options)
            options = replace(options, colliders=[*options.colliders, *solid])
        self._object_id, self._observations = object_id, observations
        times = np.unique(np.concatenate([np.asarray(o.times_s) for o in observations]))
        self._options = replace(options, times_s=tuple(times[times > 0].tolist()))
        if not self._options.times_s:
            raise PhysicsError("all observations are of the start, when nothing has happened yet")
        self._spawned: dict[float, list[DeformableBody]] = {}
        self.cancelled: Callable[[], bool] | None = None

    def differences(self, factors: Mapping[str, float], coarser: float) -> Float:
        """Residuals of all observations, concatenated."""
        bodies = [copy.copy(b) for b in self._bodies(coarser)]
        [body] = [b for b in bodies if b.name == self._object_id]
        apply_factors(body, factors)
        result = simulate_bodies(bodies, self._options, cancelled=self.cancelled)
        if result.stopped != "done":
            raise CalibrationCancelled("cancelled")
        seen = Simulated(self._scene, self._state, self._subject(), result)
        return np.concatenate([o.differences(seen) for o in self._observations])

    def body(self) -> DeformableBody:
        """The object at the start, with its initial values."""
        [body] = [b for b in self._bodies(1.0) if b.name == self._object_id]
        return body

    def _subject(self) -> PlacedObject:
        [subject] = [o for o in self._state.visible if o.object_id == self._object_id]
        return subject

    def _bodies(self, coarser: float) -> list[DeformableBody]:
        if coarser not in self._spawned:
            options, preset = self._options, preset_of(self._options.preset)
            self._spawned[coarser] = spawn_bodies(
                self._scene,
                self._state,
                {name: _coarser(o, coarser) for name, o in options.objects.items()},
                preset=replace(
                    preset,
                    spacing=coarser * preset.spacing,
                    vehicle_spacing=coarser * preset.vehicle_spacing,
                ),
                start_us=options.start_us,
                colliders=options.colliders,
                road=options.road,
                gravity=np.array(options.gravity, dtype=np.float64),
                max_particles=max(int(options.max_particles / coarser**3), 100),
            )
        return self._spawned[coarser]


def _coarser(physics: ObjectPhysics, coarser: float) -> ObjectPhysics:
    if physics.grid is None:
        return physics
    return replace(physics, grid=max(round(physics.grid / coarser), GRID_MIN))


def apply_factors(body: DeformableBody, factors: Mapping[str, float]) -> None:
    """Multiply a body's initial values."""
    body.materials = tuple(_scaled(m, factors) for m in body.materials)
    body.friction *= factors.get("friction", 1.0)
    speed = factors.get("speed", 1.0)
    body.motion = replace(
        body.motion,
        velocity=speed * body.motion.velocity,
        angular_velocity=speed * body.motion.angular_velocity,
    )


def _scaled(material: Material, factors: Mapping[str, float]) -> Material:
    stiffness, viscosity = factors.get("stiffness", 1.0), factors.get("viscosity", 1.0)
    strength = factors.get("yield_stress", 1.0)
    changed: dict[str, float] = {
        "young": stiffness * material.young,
        "viscosity": viscosity * material.viscosity,
    }
    if isinstance(material, Snow):
        # The material yields at a given strain; the yield stress is strain times Young's modulus.
        strain = material.critical_compression * strength / stiffness
        changed["critical_compression"] = min(strain, CRUSH_MOST)
    elif "yield_stress" in material.__dataclass_fields__:
        changed["yield_stress"] = strength * material.strength
    if isinstance(material, Foam):
        changed["plastic_viscosity"] = viscosity * material.plastic_viscosity
    return replace(material, **changed)


def _values(body: DeformableBody, found: Fit) -> dict[str, float]:
    initial: dict[str, float] = {
        "friction": body.friction,
        "speed": float(np.linalg.norm(body.motion.velocity)),
    }
    if len(body.materials) == 1:
        [material] = body.materials
        initial |= {"stiffness": material.young, "viscosity": material.viscosity}
        if np.isfinite(material.strength):
            initial["yield_stress"] = material.strength
    return {
        name: initial[name] * factor
        for name, factor in found.factors.items()
        if name in initial and name not in found.undetermined
    }
