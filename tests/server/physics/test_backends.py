"""The contract of every backend: the same motion, to its working precision."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from real2sim_server.physics import (
    Box,
    FixedCorotated,
    Foam,
    HeightField,
    Metal,
    NeoHookean,
    Plane,
    Sand,
    Snow,
    SolverError,
)
from real2sim_server.physics.backends import select_backend
from real2sim_server.physics.materials import Structure

from .scenes import SOFT, at, cube, ground, solve

MATERIALS = [
    FixedCorotated(young=2e5, poisson=0.4, viscosity=100),
    NeoHookean(young=2e5),
    Metal(young=2e5, yield_stress=5e3, hardening=1e4),
    Foam(young=2e5, yield_stress=3e3, plastic_viscosity=100),
    Sand(young=2e5, density=200),
    Snow(density=200),
    Structure(young=2e5, density=200, critical_compression=0.01),
]
# Sand separates and closes again at a kink of its constitutive law, where rounding decides.
AGREEMENT = {"Sand": 1e-3}
STATE = ("positions", "velocities", "gradients", "F_elastic", "F_total", "history")


def crash(material, backend, precision="double", **options):
    """One cube on the ground and another thrown at it, in fixed steps."""
    bodies = [
        cube("low", (0.03, 0, 0.16), edge=0.2, material=material, velocity=(1, 0, -2)),
        cube(
            "high",
            (0.08, 0.02, 0.4),
            edge=0.2,
            material=material,
            velocity=(0, 0, -4),
            angular_velocity=(1, 2, 0),
        ),
    ]
    options = {"backend": backend, "precision": precision, "dt_max": 2.5e-4, **options}
    return solve(bodies, [ground()], **options)


@pytest.mark.parametrize("material", MATERIALS, ids=lambda m: type(m).__name__)
def test_cpu_matches_the_reference_through_a_crash(material):
    runs = [crash(material, backend) for backend in ("reference", "cpu")]
    for run in runs:
        run.step(0.03)
    expected, found = (run.particles() for run in runs)
    for name in STATE:
        scale = 1 + np.abs(getattr(expected, name)).max()
        error = np.abs(getattr(found, name) - getattr(expected, name)).max()
        assert error < AGREEMENT.get(type(material).__name__, 1e-7) * scale, name
    assert len(runs[0].contacts) == len(runs[1].contacts) >= 3
    for a, b in zip(runs[0].contacts, runs[1].contacts, strict=True):
        np.testing.assert_allclose(b.impulse, a.impulse, atol=1e-4)
        np.testing.assert_allclose(b.moment, a.moment, atol=1e-4)
        assert b.friction_work == pytest.approx(a.friction_work, abs=1e-4)


def mixed(backend, precision):
    """A cube thrown at the ground whose particles alternate between four laws, as in a car."""
    kinds = (Snow(density=200), MATERIALS[-1], NeoHookean(young=2e5), MATERIALS[0])
    body = cube(
        position=(0.02, 0.01, 0.18),
        material=kinds,
        regions=np.arange(6**3) % len(kinds),
        velocity=(0.5, 0, -4),
        angular_velocity=(1, 2, 0),
    )
    return solve([body], [ground()], backend=backend, precision=precision, dt_max=2.5e-4)


def test_mixed_laws_match_the_reference():
    runs = [mixed(backend, "double") for backend in ("reference", "cpu")]
    for run in runs:
        run.step(0.0175)
    expected, found = (run.particles() for run in runs)
    assert np.abs(expected.history).max() > 1e-3
    for name in STATE:
        scale = 1 + np.abs(getattr(expected, name)).max()
        assert np.abs(getattr(found, name) - getattr(expected, name)).max() < 1e-7 * scale, name


def test_yielding_in_single_precision_stays_close_to_double():
    runs = [mixed("cpu", precision) for precision in ("double", "single")]
    for run in runs:
        run.step(0.03)
    double, single = (run.particles() for run in runs)
    assert np.abs(single.positions - double.positions).max() < 1e-4
    assert np.abs(single.history - double.history).max() < 1e-2


def test_batched_substeps_equal_single_substeps():
    runs = [crash(SOFT, "cpu", "single") for _ in range(2)]
    dt = runs[0].time_step()
    for steps in (7, 5, 1, 11):
        runs[0].simulation.advance(steps, dt, runs[0].colliders)
        for _ in range(steps):
            runs[1].simulation.advance(1, dt, runs[1].colliders)
    together, one_by_one = (run.particles() for run in runs)
    for name in STATE:
        np.testing.assert_array_equal(getattr(together, name), getattr(one_by_one, name))


def test_single_precision_stays_close_to_double():
    runs = [crash(SOFT, "cpu", precision) for precision in ("double", "single")]
    for run in runs:
        run.step(0.03)
    error = np.abs(runs[0].particles().positions - runs[1].particles().positions).max()
    assert error < 1e-4


@pytest.mark.parametrize(
    "collider",
    [
        Plane(name="slope", normal=(0.3, 0, 1), friction=0.2),
        Box(name="box", T_world_box=at(0, 0, -0.2), size=(0.5, 0.5, 0.4), velocity=(0.5, 0, 1)),
        Box(name="spun", T_world_box=at(0, 0, -0.2), size=(1, 1, 0.4), angular_velocity=(0, 1, 3)),
        HeightField(
            name="hills",
            heights=0.1 * np.sin(np.arange(36.0)).reshape(6, 6) - 0.05,
            origin=(-1.03, -1.07),  # so that no node lies on a kink
            spacing=0.4,
        ),
        Plane(name="glue", friction=float("inf"), separable=False),
        Box(name="plate", T_world_box=at(0, 0, -0.01), size=(0.5, 0.5, 0.02), friction=0.3),
        Box(name="post", T_world_box=at(0.03, 0, -0.01), size=(0.03, 2, 0.02), velocity=(1, 0, 1)),
    ],
    ids=lambda c: c.name,
)
def test_cpu_collider_contact_matches_the_reference(collider):
    runs = [
        solve(
            [cube(position=(0.02, 0.01, 0.18), edge=0.2, velocity=(0.5, 0, -3))],
            [collider],
            backend=backend,
            precision="double",
            dt_max=5e-4,
        )
        for backend in ("reference", "cpu")
    ]
    for run in runs:
        run.step(0.05)
    expected, found = (run.particles() for run in runs)
    assert np.abs(found.positions - expected.positions).max() < 1e-9
    assert [c.other for c in runs[1].contacts] == [collider.name]
    np.testing.assert_allclose(runs[1].contacts[0].impulse, runs[0].contacts[0].impulse, atol=1e-7)


FINGERPRINT = """
import hashlib
import numba
from real2sim_server.physics.backends.cpu import backend
from tests.server.physics.test_backends import STATE, mixed

backend.PARTICLES_PER_THREAD = 1
run = mixed("cpu", "single")
run.step(0.03)
state = b"".join(getattr(run.particles(), name).tobytes() for name in STATE)
print(numba.get_num_threads(), hashlib.sha256(state).hexdigest())
"""


def test_results_do_not_depend_on_the_number_of_threads():
    root = Path(__file__).parents[3]
    runs = [
        subprocess.Popen(
            [sys.executable, "-c", FINGERPRINT],
            env={**os.environ, "NUMBA_NUM_THREADS": str(threads), "PYTHONPATH": str(root)},
            stdout=subprocess.PIPE,
            text=True,
        )
        for threads in (1, 5)
    ]
    said = [run.communicate()[0].split() for run in runs]
    assert [threads for threads, _ in said] == ["1", "5"]
    assert len({digest for _, digest in said}) == 1


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_restored_snapshot_continues_identically(backend):
    run = crash(SOFT, backend)
    run.step(0.01)
    kept = run.snapshot()
    run.step(0.01)
    first = run.particles()
    run.restore(kept)
    run.step(0.01)
    for name in STATE:
        assert getattr(run.particles(), name).tobytes() == getattr(first, name).tobytes()


def test_unknown_backends_are_reported_by_name():
    with pytest.raises(SolverError, match="allowed are 'auto'"):
        select_backend("gpu")


def test_bodies_crossing_blocks_match_the_reference():
    runs = [
        solve(
            [cube(edge=0.2, velocity=(30, -20, 10), angular_velocity=(0, 30, 60))],
            backend=backend,
            precision="double",
            gravity=(0, 0, 0),
            dt_max=5e-4,
        )
        for backend in ("reference", "cpu")
    ]
    for run in runs:
        run.step(0.05)
    expected, found = (run.particles() for run in runs)
    assert np.abs(expected.positions - runs[0].bodies[0].particles.positions).max() > 1.5
    assert np.abs(found.positions - expected.positions).max() < 1e-9
