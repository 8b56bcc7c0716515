"""Simulation results: poses, shapes, contacts and energies, with a compact file format."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from .._files import atomic_folder
from ..geometry.transform import Float, transform_from
from ..physics.errors import PhysicsError
from .breakage import Breakage

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
        velocities, angular_velocities: [F, 3] of the centre of mass, world frame [m/s], [rad/s].
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
        other: name of the collider used for the fit; None if the body hits nothing, so that a wall
            across its path was used.
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
        """As JSON values."""
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
            results of older versions), in which case bodies are drawn smooth.
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
