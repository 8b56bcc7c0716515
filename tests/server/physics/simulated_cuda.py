"""The CUDA backend in Numba's simulator, on scenes of a few particles: a program of its own.

The simulator must be chosen before Numba is imported. Prints how far each scene is from the
reference, and the lines of cheap validation cases, as JSON; of the scenes and cases named.
"""

from __future__ import annotations

import contextlib
import functools
import json
import math
import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from types import SimpleNamespace
from typing import Any
from unittest import mock

os.environ["NUMBA_ENABLE_CUDASIM"] = "1"

import numpy as np
from numba.cuda.simulator.kernelapi import FakeCUDAShared
from numba.np.numpy_support import as_dtype

from real2sim_server.physics import (
    Body,
    Box,
    FixedCorotated,
    Foam,
    HeightField,
    Metal,
    NeoHookean,
    Plane,
    Sand,
    Snow,
    Solver,
    SolverOptions,
    box_particles,
)
from real2sim_server.physics.constitutive import stress
from real2sim_server.physics.contact import collider_distance, node, surface
from real2sim_server.physics.numerics import matrices
from real2sim_server.physics.validation import motion

from .scenes import at

# The simulator's host thread polls; with long slices it would keep the device's threads waiting.
sys.setswitchinterval(2e-5)

_allocating = threading.Lock()


def shared_array(shared: FakeCUDAShared, shape: tuple[int, ...], dtype: Any) -> Any:
    """What ``cuda.shared.array`` stands for: one array for all threads of a block.

    The simulator's own looks for it and makes it in two steps, so that of two threads that come at
    once each may get an array of its own, and their sums are lost to each other.
    """
    caller = sys._getframe(1)
    where = caller.f_code.co_filename, caller.f_lineno
    with _allocating:
        if where not in shared._allocations:
            shared._allocations[where] = np.empty(shape, as_dtype(dtype))
        return shared._allocations[where]


FakeCUDAShared.array = shared_array

STATE = ("positions", "velocities", "gradients", "F_elastic", "F_total", "history")
DT = 5e-4
MATERIALS = (
    FixedCorotated(young=2e5, poisson=0.4, viscosity=100),
    NeoHookean(young=2e5),
    Metal(young=2e5, yield_stress=5e3, hardening=1e4),
    Foam(young=2e5, yield_stress=3e3, plastic_viscosity=100),
    Sand(young=2e5, density=200),
    Snow(density=200),
)
COLLIDERS = (
    Plane(name="slope", point=(0.2, 0.2, 0.17), normal=(0.3, 0, 1), friction=0.2),
    Box(
        name="moving box",
        T_world_box=at(0.2, 0.2, 0.07),
        size=(0.5, 0.5, 0.2),
        velocity=(0.5, 0, 1),
        angular_velocity=(0, 1, 3),
    ),
    HeightField(
        name="height field",
        heights=0.16 + 0.01 * np.sin(np.arange(36.0)).reshape(6, 6),
        origin=(-1.03, -1.07),
        spacing=0.4,
    ),
    Plane(name="glue", point=(0, 0, 0.17), friction=float("inf"), separable=False),
    Box(name="post", T_world_box=at(0.203, 0.2, 0.134), size=(0.02, 1, 0.05), velocity=(0.5, 0, 1)),
)


def keeping_type(function: Callable[..., float]) -> Callable[..., Any]:
    """A function of ``math`` as devices know it: of the precision of its argument.

    Python's gives a float, which NumPy takes for less precise than the kernels' single constants.
    """

    def typed(x: Any, *more: Any) -> Any:
        kind = type(x) if isinstance(x, np.floating) else np.float64
        return kind(function(x, *more))

    return typed


DEVICE_MATH = SimpleNamespace(
    **{name: keeping_type(getattr(math, name)) for name in ("sqrt", "log", "exp", "copysign")},
    floor=math.floor,
)


@contextlib.contextmanager
def device_math() -> Iterator[None]:
    """Kernel functions run by Python compute as compiled; nothing may be compiled meanwhile."""
    with contextlib.ExitStack() as stack:
        for module in (collider_distance, matrices, node, stress, surface):
            if hasattr(module, "math"):
                stack.enter_context(mock.patch.object(module, "math", DEVICE_MATH))
        yield


def cube(name: str, position: tuple[float, float, float], material: Any, **options: Any) -> Body:
    """Eight particles."""
    particles = box_particles([0.1] * 3, spacing=0.05, density=200).moved(at(*position))
    return Body(name=name, particles=particles, material=material, **options)


def strained(material: Any) -> tuple[list[Body], list[Any]]:
    """A cube bent so much that it flows, on the ground."""
    F = np.array([[1.08, 0.06, 0.0], [0.02, 0.97, -0.05], [0.03, 0.0, 0.92]])
    body = cube(
        "cube", (0.21, 0.2, 0.2), material, velocity=(1, 0, -3), deformation=np.tile(F, (8, 1, 1))
    )
    return [body], [Plane(name="ground", point=(0, 0, 0.17))]


def on(collider: Any) -> tuple[list[Body], list[Any]]:
    """A cube thrown at a collider."""
    soft = FixedCorotated(young=2e5, poisson=0.4)
    return [cube("cube", (0.21, 0.2, 0.2), soft, velocity=(0.5, 0.2, -3))], [collider]


def meeting() -> tuple[list[Body], list[Any]]:
    """Two cubes that collide and rub."""
    soft = FixedCorotated(young=2e5, poisson=0.4)
    return [
        cube("left", (0.15, 0.2, 0.2), soft, velocity=(3, 0.5, 0), friction=0.3),
        cube("right", (0.253, 0.21, 0.2), soft, velocity=(-3, 0, 0), friction=0.3),
    ], []


def leaving() -> tuple[list[Body], list[Any]]:
    """A cube so fast that it must be sorted into other blocks on its way."""
    return [cube("cube", (0.3, 0.2, 0.2), FixedCorotated(young=2e5), velocity=(120, 0, 30))], []


SCENES: dict[str, Callable[[], tuple[list[Body], list[Any]]]] = {
    **{type(m).__name__: (lambda m=m: strained(m)) for m in MATERIALS},
    **{c.name: (lambda c=c: on(c)) for c in COLLIDERS},
    "two bodies": meeting,
    "leaving": leaving,
}
MATERIAL_NAMES = tuple(type(m).__name__ for m in MATERIALS)
CASES: dict[str, Callable[[], list[Any]]] = {
    "free_fall": lambda: motion.free_fall("cuda", edge=0.1, steps=8),
    "affine_patch": lambda: motion.affine_patch("cuda", edge=0.1),
    "spin": lambda: motion.spin("cuda", edge=0.12, turns=0.02),
    "invariants": lambda: motion.invariants("cuda", edge=0.1, parts=2),
}


@functools.cache
def run(scene: str, backend: str, precision: str = "double", steps: int = 3) -> Solver:
    """A scene after a few substeps of fixed length."""
    bodies, colliders = SCENES[scene]()
    options = SolverOptions(dx=0.1, backend=backend, precision=precision, dt_max=DT)
    with device_math() if backend == "cuda" else contextlib.nullcontext():
        solver = Solver(bodies, colliders, options)
        solver.step(steps * DT)
    return solver


def difference(scene: str, other: str, precision: str = "double") -> dict[str, float]:
    """Largest difference from another backend, relative to one and the largest number."""
    expected, found = (run(scene, name, precision) for name in (other, "cuda"))
    a, b = expected.particles(), found.particles()
    off = {
        name: float(
            np.abs(getattr(b, name) - getattr(a, name)).max() / (1 + np.abs(getattr(a, name)).max())
        )
        for name in STATE
    }
    touched = [c.impulse for c in expected.contacts]
    off["contacts"] = float(len(touched))
    same = [c.impulse for c in found.contacts]
    off["impulses"] = float(np.abs(np.array(same) - np.array(touched)).max(initial=0.0))
    return off


def restored() -> float:
    """How far a run goes astray that is taken back on its way."""
    straight = run("Metal", "cuda", steps=2).particles()
    solver = run("Metal", "cuda", steps=1)
    kept = solver.snapshot()
    with device_math():
        solver.step(DT)
        solver.restore(kept)
        solver.step(DT)
    return float(np.abs(solver.particles().positions - straight.positions).max())


def lines(cases: Iterable[str]) -> Iterator[dict[str, Any]]:
    """Every line of the validation cases named."""
    for case in cases:
        for check in CASES[case]():
            yield {"case": case, "name": check.name, "measured": check.measured} | {
                "passed": check.passed
            }


if __name__ == "__main__":
    wanted = set(sys.argv[1:])
    report = {
        "reference": {n: difference(n, "reference") for n in SCENES if n in wanted},
        "cpu": {n: difference(n, "cpu") for n in MATERIAL_NAMES if n in wanted},
        "lines": list(lines(n for n in CASES if n in wanted)),
    }
    if "Metal" in wanted:
        report["single"] = difference("Metal", "reference", "single")
        report["restored"] = restored()
    json.dump(report, sys.stdout)
