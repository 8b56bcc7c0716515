"""Factors on an object's materials and motion with which a simulation shows what was observed."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...geometry.rotation import Float
from ...physics.errors import PhysicsError
from ...physics.fitting import Fit, fit
from ...physics.materials import Foam, Material, Snow
from ...scene import Scene
from ..body import DeformableBody
from ..playback import PlacedObject, PlacedObjects
from ..presets import GRID_MIN, ObjectPhysics, preset_of
from ..rollout import SimulateOptions, simulate_bodies, solid_background
from ..spawn import spawn_bodies
from .observations import Observation, Simulated

PARAMETERS = ("stiffness", "yield_stress", "viscosity", "friction", "speed")
"""What may be fitted: factors on what the object was given, all positive."""
CRUSH_MOST = 0.9
"""Of critical compression, as a strain."""


@dataclass(frozen=True, eq=False)
class ObjectCalibration:
    """What was found.

    Attributes:
        fit: factors, what they may be wrong by, residuals.
        values: by parameter that is told, the value that the factor makes: Young's modulus and
            yield stress [Pa] and viscosity [Pa s] of one material, friction, speed [m/s].
        cell: of the grid that it was found on [m].
    """

    fit: Fit
    values: dict[str, float]
    cell: float

    def figures(self) -> dict[str, Any]:
        """As JSON values; None for what observations do not tell."""
        found = self.fit

        def finite(values: Mapping[str, float]) -> dict[str, float | None]:
            return {name: None if np.isinf(v) else v for name, v in values.items()}

        return {
            "factors": {n: None if n in found.untold else f for n, f in found.factors.items()},
            "uncertainty": finite(found.uncertainty),
            "observation": finite(found.observation),
            "discretisation": finite(found.discretisation),
            "values": self.values,
            "untold": found.untold,
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
    """Fit factors so that what is simulated looks as what was observed.

    Args:
        scene, state, options: what is simulated, with initial values; its duration follows from
            the observations.
        object_id: of the object whose values are fitted.
        observations: of it; all of them together.
        parameters: names out of PARAMETERS.
        steps: of the search at most.
        on_run: told how many simulations were made, after each.
        cancelled: asked before each step of a simulation.

    Raises:
        PhysicsError: for what cannot be simulated, unknown names, and observations that tell
            nothing.
    """
    unknown = [name for name in parameters if name not in PARAMETERS]
    if unknown or not parameters:
        raise PhysicsError(f"cannot fit {unknown}; allowed are {', '.join(PARAMETERS)}")
    if object_id not in options.objects:
        raise PhysicsError(
            f"{object_id!r} takes no part; taking part: {', '.join(options.objects)}"
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
    """Somebody no longer wants the result."""


class _Trials:
    """Simulations of the same start with other values."""

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
        """Of all observations, one after the other."""
        bodies = [copy.copy(b) for b in self._bodies(coarser)]
        [body] = [b for b in bodies if b.name == self._object_id]
        apply_factors(body, factors)
        result = simulate_bodies(bodies, self._options, cancelled=self.cancelled)
        if result.stopped != "done":
            raise CalibrationCancelled("cancelled")
        seen = Simulated(self._scene, self._state, self._subject(), result)
        return np.concatenate([o.differences(seen) for o in self._observations])

    def body(self) -> DeformableBody:
        """The object at the start, with the values that it was given."""
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
    """Multiply what a body at its start was given."""
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
        # It yields at a strain; the stress there is that times Young's modulus.
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
        if name in initial and name not in found.untold
    }
