"""Results of a simulation (poses, shapes, contacts, energies), and frames for the renderer."""

from __future__ import annotations

import json
from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from real2sim_proto.conventions import semantic_class

from .._files import atomic_folder
from ..geometry import Float, transform_from
from ..physics.errors import PhysicsError
from ..render.types import Instance
from ..scene import GaussianCloud, Scene, Trajectory
from .breakage import Breakage, fragment_cloud, with_underside
from .damage import DamagedVehicle
from .particles import Embedding, deform_cloud, stretched
from .structure import VEHICLES

FORMAT = "real2sim-simulation"
VERSION = 2
ENERGIES = ("kinetic", "elastic", "gravity", "friction_heat", "collider_work", "dissipated")


@dataclass(frozen=True, eq=False)
class ObjectResult:
    """One object over F frames.

    Attributes:
        object_id: id in the scenario.
        mass: [kg].
        spacing: particle spacing [m].
        rest: [N, 3] float32, particles at rest, object frame [m].
        positions, quaternions: [F, 3] float64 [m], [F, 4] wxyz: ``T_world_object``.
        velocities, angular_velocities: [F, 3] at the centre of mass, world frame [m/s], [rad/s].
        modes: [F] uint8, value of ``body.BodyMode``.
        shape_index: [F] int32, row of ``shapes`` at each frame; -1 if undeformed.
        shapes: [S, N, 3] float16, particle displacements, object frame [m].
        wheels: [W, 3] float32 undersides of its wheels, object frame [m]; W is 4 or 0.
        wheel_lifts: [F, W] float32, spring compression of each wheel [m].
    """

    object_id: str
    mass: float
    spacing: float
    rest: NDArray[np.float32]
    positions: Float
    quaternions: Float
    velocities: Float
    angular_velocities: Float
    modes: NDArray[np.uint8]
    shape_index: NDArray[np.int32]
    shapes: NDArray[np.float16]
    wheels: NDArray[np.float32]
    wheel_lifts: NDArray[np.float32]

    def transform(self, frame: int) -> Float:
        """``T_world_object`` [4, 4] at a frame."""
        return transform_from(self.positions[frame], self.quaternions[frame])

    def displacements(self, frame: int) -> NDArray[np.float16] | None:
        """[N, 3] particle displacements at a frame [m]; None if undeformed."""
        row = int(self.shape_index[frame])
        return None if row < 0 else self.shapes[row]


@dataclass(frozen=True)
class ContactRecord:
    """The total effect of another object or a collider on an object.

    Attributes:
        object_id, other: the object, and the other object or collider.
        impulse: [3] impulse on the object [N s].
        delta_v: magnitude of the impulse over the object's mass [m/s].
        impact_delta_v: the same without the impulse that supports the object's weight [m/s]; equals
            ``delta_v`` in results of older versions.
        first_s, last_s: first and last time at which the impulse changed [s].
        heat: energy dissipated by friction [J].
    """

    object_id: str
    other: str
    impulse: tuple[float, float, float]
    delta_v: float
    first_s: float
    last_s: float
    heat: float
    impact_delta_v: float


@dataclass(frozen=True)
class Rebound:
    """A body's requested rebound, and the rebound reached in test impacts.

    Attributes:
        requested: requested coefficient of restitution.
        achieved: restitution in test impacts; for the simulated impacts see Bounce.
        elastic: restitution without added viscosity, the maximum.
        other: name of the collider used for the fit; None for a wall across the body's path, used
            if the body hits nothing.
        speed: speed of the test impacts [m/s].
        viscosity: added viscosity [Pa s].
    """

    requested: float
    achieved: float
    elastic: float
    other: str | None
    speed: float
    viscosity: float

    def figures(self) -> dict[str, Any]:
        """The rebound as JSON values."""
        return {k: round(v, 6) if isinstance(v, float) else v for k, v in asdict(self).items()}


@dataclass(frozen=True, eq=False)
class SimulationResult:
    """The result of a rollout.

    Attributes:
        objects: simulated objects by id.
        times_s: [F] time since the start [s].
        start_us: scene time of the start [us].
        energies: [F, 6] [J], columns ENERGIES.
        contacts: contacts at the end.
        impulses: [F, C, 3] accumulated impulse of each contact at each frame [N s].
        stopped: ``done`` or ``cancelled``; a cancelled result has the frames up to then.
        figures: preset, gravity, cells, steps and rollbacks; ``restitution`` with the fields of a
            Rebound and its ``bounces`` for each object with a requested restitution; and with
            ``background`` the boxes of the background (JSON values only).
        breakages: broken vehicle parts; None if they were not computed (``paper`` preset and
            results of older versions). Bodies are then drawn smooth.
    """

    objects: Mapping[str, ObjectResult]
    times_s: Float
    start_us: int
    energies: Float
    contacts: tuple[ContactRecord, ...]
    impulses: Float
    stopped: str = "done"
    figures: Mapping[str, Any] = field(default_factory=dict)
    breakages: tuple[Breakage, ...] | None = None

    @property
    def frames(self) -> int:
        """Number of frames F."""
        return len(self.times_s)

    def save(self, path: Path) -> None:
        """Write a folder of two files: ``simulation.json`` and ``frames.safetensors``."""
        tensors: dict[str, NDArray[Any]] = {
            "times_s": self.times_s,
            "energies": self.energies,
            "impulses": self.impulses,
        }
        for object_id, o in self.objects.items():
            for name in ARRAYS:
                tensors[f"{object_id}/{name}"] = np.ascontiguousarray(getattr(o, name))
        document = {
            "format": FORMAT,
            "version": VERSION,
            "start_us": self.start_us,
            "stopped": self.stopped,
            "figures": dict(self.figures),
            "objects": {k: {"mass": o.mass, "spacing": o.spacing} for k, o in self.objects.items()},
            "contacts": [vars(c) for c in self.contacts],
        }
        if self.breakages is not None:
            document["breakages"] = [b.record() for b in self.breakages]
        with atomic_folder(path) as folder:
            (folder / "simulation.json").write_text(json.dumps(document, indent=1))
            save_file(tensors, folder / "frames.safetensors")

    @classmethod
    def load(cls, path: Path) -> SimulationResult:
        """Read a folder written by :meth:`save`.

        Raises:
            PhysicsError: missing folder, or no simulation of this version.
        """
        try:
            document = json.loads((path / "simulation.json").read_text())
            tensors = load_file(path / "frames.safetensors")
        except (OSError, ValueError, SafetensorError) as error:
            raise PhysicsError(f"{path}: no readable simulation: {error}") from error
        if document.get("format") != FORMAT or document.get("version") != VERSION:
            raise PhysicsError(
                f"{path}: is {document.get('format')!r} version {document.get('version')!r}, "
                f"not {FORMAT!r} version {VERSION}"
            )
        try:
            objects = {
                k: ObjectResult(
                    k, o["mass"], o["spacing"], **{name: tensors[f"{k}/{name}"] for name in ARRAYS}
                )
                for k, o in document["objects"].items()
            }
            contacts = tuple(
                ContactRecord(
                    **{"impact_delta_v": c["delta_v"], **c, "impulse": tuple(c["impulse"])}
                )
                for c in document["contacts"]
            )
            broken = document.get("breakages")
            return cls(
                objects,
                tensors["times_s"],
                document["start_us"],
                tensors["energies"],
                contacts,
                tensors["impulses"],
                document["stopped"],
                document["figures"],
                None if broken is None else tuple(Breakage.of_record(b) for b in broken),
            )
        except (KeyError, TypeError) as error:
            raise PhysicsError(f"{path}: the simulation lacks {error}; save it again") from error


ARRAYS = (
    "rest",
    "positions",
    "quaternions",
    "velocities",
    "angular_velocities",
    "modes",
    "shape_index",
    "shapes",
    "wheels",
    "wheel_lifts",
)


# --- Frames for the renderer ----------------------------------------------------------------------

WHEEL_RADIUS, WHEEL_HALF_WIDTH = 0.36, 0.2
"""Region of a vehicle's Gaussians that are a wheel: radius around the axle and half width [m]."""

TURNED_OVER = 0.3
"""Cosine between the vehicle's and the world's up axis below which the underside is visible."""

HANGING = 2.0
"""Time after which a loose bumper no longer moves [s]."""


class PlacedObject(Protocol):
    """The properties of a scenario's object that playback reads."""

    @property
    def object_id(self) -> str: ...  # noqa: D102
    @property
    def source_id(self) -> str: ...  # noqa: D102
    @property
    def category(self) -> str: ...  # noqa: D102
    @property
    def scaled_size(self) -> tuple[float, float, float]: ...  # noqa: D102
    @property
    def scale(self) -> tuple[float, float, float]: ...  # noqa: D102
    @property
    def trajectory(self) -> Trajectory: ...  # noqa: D102
    @property
    def instance_id(self) -> int: ...  # noqa: D102


class PlacedObjects(Protocol):
    """The properties of a scenario's state that playback reads."""

    @property
    def visible(self) -> tuple[PlacedObject, ...]: ...  # noqa: D102


class Playback:
    """Playback of a simulation result in its scene.

    Args:
        scene: scene with the Gaussians.
        state: scenario state that was simulated.
        result: result of ``simulate`` on both.

    Raises:
        PhysicsError: if the result has objects that the state lacks.
    """

    def __init__(self, scene: Scene, state: PlacedObjects, result: SimulationResult) -> None:
        self.scene, self.state, self.result = scene, state, result
        missing = set(result.objects) - {o.object_id for o in state.visible}
        if missing:
            raise PhysicsError(f"the simulation holds {sorted(missing)}, the scenario does not")
        self._breakages: dict[str, list[Breakage]] = {}
        for breakage in result.breakages or ():
            self._breakages.setdefault(breakage.object_id, []).append(breakage)
        self._clouds: dict[str, GaussianCloud] = {}
        self._embeddings: dict[str, Embedding] = {}
        self._deformed: dict[str, tuple[tuple[Hashable, bytes], GaussianCloud]] = {}
        self._wheels: dict[str, NDArray[np.bool_]] = {}
        self._damaged: dict[str, _Damaged] = {}

    def instances(self, frame: int, *, without: Collection[str] = ()) -> list[Instance]:
        """The background, simulated objects at ``frame``, and other objects as recorded.

        Args:
            frame: frame of the result.
            without: ids of objects to omit.

        Raises:
            PhysicsError: for a frame out of range.
        """
        if not 0 <= frame < self.result.frames:
            raise PhysicsError(f"frame {frame}; there are 0 to {self.result.frames - 1}")
        t_us = self.time_us(frame)
        instances = [Instance(self.scene.background)]
        for subject in self.state.visible:
            if subject.object_id in without:
                continue
            if subject.object_id in self.result.objects:
                instances.append(self._simulated(subject, frame))
            elif subject.trajectory.covers(t_us):
                source = self.scene.object(subject.source_id)
                cloud = source.posed_at(t_us, subject.trajectory)
                cloud = cloud if source.colour is None else source.colour.at(cloud, t_us)
                pose = subject.trajectory.transform(t_us)
                instances.append(_placed(cloud, pose, subject, subject.scale))
        return instances + self._fragments(frame, without)

    def _fragments(self, frame: int, without: Collection[str]) -> list[Instance]:
        """Fragments of vehicles at that time, with the ids of the vehicles."""
        time_s, found = float(self.result.times_s[frame]), []
        for subject in self.state.visible:
            broken = self._breakages.get(subject.object_id)
            if not broken or subject.object_id in without:
                continue
            cloud = fragment_cloud(broken, time_s, self.scene.ground.height_at)
            if cloud is not None:
                here = cloud.to(self.scene.background.device)
                found.append(_placed(here, None, subject))
        return found

    def time_us(self, frame: int) -> int:
        """Scene time of a frame [us]."""
        return self.result.start_us + round(float(self.result.times_s[frame]) * 1e6)

    def _simulated(self, subject: PlacedObject, frame: int) -> Instance:
        own = self.result.objects[subject.object_id]
        pose, row = own.transform(frame), int(own.shape_index[frame])
        lifts = own.wheel_lifts[frame]
        if row < 0 and not lifts.any():
            return _placed(self._cloud(subject), pose, subject)
        damaged = self._damage(subject)
        time_s = float(self.result.times_s[frame])
        state: Hashable = row if damaged is None else damaged.state(row, time_s)
        key = (state, lifts.tobytes())
        kept = self._deformed.get(subject.object_id)
        if kept is None or kept[0] != key:
            cloud = self._cloud(subject)
            if damaged is not None and row >= 0:
                cloud = damaged.cloud(row, time_s)
            elif row >= 0:
                deformed = self._embedding(subject).follow(own.shapes[row].astype(np.float64))
                cloud = deform_cloud(cloud, deformed)
            if lifts.any():
                cloud = self._lifted(subject, cloud, lifts)
            kept = (key, cloud)
            self._deformed[subject.object_id] = kept
        return _placed(kept[1], pose, subject)

    def _damage(self, subject: PlacedObject) -> _Damaged | None:
        """Visible damage of a vehicle; None if breakages were not recorded."""
        if self.result.breakages is None or subject.category not in VEHICLES:
            return None
        key = subject.object_id
        if key not in self._damaged:
            own = self.result.objects[key]
            vehicle = DamagedVehicle(
                self._cloud(subject),
                own.rest.astype(np.float64),
                spacing=own.spacing,
                category=subject.category,
                size=subject.scaled_size,
                object_id=key,
            )
            self._damaged[key] = _Damaged(own, vehicle, self._breakages.get(key, []))
        return self._damaged[key]

    def _lifted(
        self, subject: PlacedObject, cloud: GaussianCloud, lifts: NDArray[np.float32]
    ) -> GaussianCloud:
        """Keep the wheels on the road when the body compresses its springs."""
        key = subject.object_id
        if key not in self._wheels:
            rest = self._cloud(subject).means.detach().cpu().numpy()
            self._wheels[key] = _in_wheels(rest, self.result.objects[key].wheels)
        shift = torch.zeros_like(cloud.means)
        wheels = self._wheels[key]
        shift[: len(wheels), 2] = torch.from_numpy(wheels @ lifts).to(shift)
        return replace(cloud, means=cloud.means + shift)

    def _cloud(self, subject: PlacedObject) -> GaussianCloud:
        """Gaussians at rest, in the colours at the start."""
        key = subject.object_id
        if key not in self._clouds:
            source = self.scene.object(subject.source_id)
            cloud = stretched(source.cloud_at(self.result.start_us), subject.scale)
            if self._turns_over(subject):
                cloud = with_underside(cloud, subject.scaled_size)
            self._clouds[key] = cloud
        return self._clouds[key]

    def _turns_over(self, subject: PlacedObject) -> bool:
        """Whether a vehicle shows its underside at any time."""
        if self.result.breakages is None or subject.category not in VEHICLES:
            return False
        x, y = self.result.objects[subject.object_id].quaternions[:, 1:3].T
        return bool((1 - 2 * (x * x + y * y) < TURNED_OVER).any())

    def _embedding(self, subject: PlacedObject) -> Embedding:
        key = subject.object_id
        if key not in self._embeddings:
            own = self.result.objects[key]
            means = self._cloud(subject).means.detach().cpu().numpy().astype(np.float64)
            self._embeddings[key] = Embedding(
                own.rest.astype(np.float64), means, spacing=own.spacing
            )
        return self._embeddings[key]


class _Damaged:
    """A vehicle through the frames of a result; folds are permanent."""

    def __init__(
        self, own: ObjectResult, vehicle: DamagedVehicle, broken: Sequence[Breakage]
    ) -> None:
        self._own, self._vehicle, self._broken = own, vehicle, broken
        self._upto = 0
        self._most: Float | None = None

    def state(self, row: int, time_s: float) -> Hashable:
        """A key that determines the appearance; changes while a loose bumper moves."""
        ages = [time_s - b.time_s for b in self._broken if b.time_s <= time_s]
        loose = [round(min(age, HANGING), 6) for age in ages]
        return row, tuple(loose)

    def cloud(self, shown: int, time_s: float) -> GaussianCloud:
        """The vehicle's Gaussians in the shape ``shown``, ``time_s`` [s] after the start."""
        if self._most is None or self._upto > shown:
            self._upto, self._most = 0, None
        for row in range(self._upto, shown + 1):
            moved = self._own.shapes[row].astype(np.float64)
            now = self._vehicle.shortening(moved)
            self._most = now if self._most is None else np.maximum(self._most, now)
        self._upto = shown
        assert self._most is not None
        ages = {b.part: min(time_s - b.time_s, HANGING) for b in self._broken if b.time_s <= time_s}
        return self._vehicle.cloud(moved, self._most, ages)


def _placed(
    cloud: GaussianCloud,
    pose: NDArray[np.float64] | None,
    subject: PlacedObject,
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> Instance:
    semantic = semantic_class(subject.category)
    return Instance(cloud, pose, subject.instance_id, scale, semantic=semantic)


def _in_wheels(means: NDArray[np.float32], wheels: NDArray[np.float32]) -> NDArray[np.bool_]:
    """[G, W] whether Gaussians belong to each wheel; undersides [W, 3], same frame."""
    offset = means[:, None] - (wheels + np.array([0, 0, WHEEL_RADIUS], dtype=np.float32))
    in_disc = np.hypot(offset[..., 0], offset[..., 2]) < WHEEL_RADIUS + 0.02
    inside: NDArray[np.bool_] = in_disc & (np.abs(offset[..., 1]) < WHEEL_HALF_WIDTH)
    return inside
