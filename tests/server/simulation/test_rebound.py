"""A requested restitution is reached where the body hits, and the result is reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from real2sim_server.physics.body import Particles
from real2sim_server.physics.colliders import Box, Collider, Plane
from real2sim_server.physics.materials import FixedCorotated
from real2sim_server.simulation import ObjectPhysics, SimulateOptions
from real2sim_server.simulation.body import DeformableBody
from real2sim_server.simulation.rebound import first_touch, fit_rebound
from real2sim_server.simulation.result import Rebound
from real2sim_server.simulation.rigid import rotation_of
from real2sim_server.simulation.rollout import simulate_bodies

SIDE, SPACING, CELL, SPEED = 6, 0.1, 0.2, 2.0
TURNS = [(0, 0, 0), (0, 0.524, 0), (0.3, 0.2, 0.4), (0, 0.785, 0), (0.9, 0, 0.3)]


def block(turn: np.ndarray, *, ahead: float) -> DeformableBody:
    """An elastic cube of 0.6 m that flies against its own third axis, ``ahead`` m from zero."""
    steps = np.stack(np.meshgrid(*[np.arange(SIDE)] * 3, indexing="ij"), -1) - (SIDE - 1) / 2
    positions = steps.reshape(-1, 3) * SPACING
    n, volume = len(positions), SPACING**3
    particles = Particles(positions, np.full(n, volume), np.full(n, 200 * volume), np.full(n, -1))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, turn[:, 2] * (ahead + SIDE * SPACING / 2)
    return DeformableBody(
        "block",
        particles,
        (FixedCorotated(young=2e6, poisson=0.3, density=200.0),),
        np.zeros(n, np.int64),
        friction=0.3,
        cell=CELL,
        T_world_object=pose,
        velocity=-SPEED * turn[:, 2],
        angular_velocity=np.zeros(3),
    )


def wall(kind: str, turn: np.ndarray, phase: float) -> Collider:
    point = turn[:, 2] * phase * CELL
    if kind == "plane":
        return Plane(name="wall", point=point, normal=turn[:, 2])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, point - 0.15 * turn[:, 2]
    return Box(name="wall", T_world_box=pose, size=(4.0, 4.0, 0.3))


def bounced(
    requested: float, phase: float, turn: np.ndarray, kind: str
) -> tuple[Rebound, float, dict]:
    """The fit's result, simulated separation over approach speed, and the reported restitution."""
    body, met = block(turn, ahead=0.5 + phase * CELL), wall(kind, turn, phase)
    body.rebound = fit_rebound(body, requested, [met], np.zeros(3))
    options = SimulateOptions(
        objects={"block": ObjectPhysics()},
        colliders=[met],
        gravity=(0.0, 0.0, 0.0),
        duration=1.0,
        frame_rate=5,
    )
    result = simulate_bodies([body], options)
    told = result.figures["restitution"]["block"]
    (bounce,) = told.pop("bounces")
    assert told == body.rebound.figures()
    return body.rebound, float(body.motion.velocity @ turn[:, 2]) / SPEED, bounce


@pytest.mark.parametrize(("kind", "phase", "turn"), [("plane", 0.35, 1), ("box", 0.7, 0)])
def test_restitution_is_reached_for_any_wall_position_and_orientation(kind, phase, turn):
    fit, seen, bounce = bounced(0.3, phase, rotation_of(np.array(TURNS[turn])), kind)
    assert seen == pytest.approx(0.3, abs=0.03)
    assert fit.achieved == pytest.approx(0.3, abs=0.03)
    assert fit.other == bounce["other"] == "wall"
    assert fit.speed == pytest.approx(SPEED)


def test_restitution_above_the_grids_own_is_added_at_separation():
    fit, seen, bounce = bounced(0.7, 0.35, rotation_of(np.array(TURNS[1])), "plane")
    assert fit.achieved == fit.elastic < 0.6
    assert bounce["grid"] == pytest.approx(fit.elastic, abs=0.05)
    assert bounce["speed"] == pytest.approx(SPEED, rel=0.02)
    assert seen == pytest.approx(0.7, abs=0.05)
    assert bounce["achieved"] == pytest.approx(seen, abs=0.03)


@pytest.mark.parametrize(
    ("gap", "requested", "last", "kept"),
    [(0.15, 0.98, 1.8, 0.9), (0.0, 0.98, 1.8, 0.9), (0.0, None, 1.75, 0.78)],
    ids=["spaced", "touching", "touching, none requested"],
)
def test_newtons_cradle_passes_momentum_on(gap, requested, last, kept):
    """Three blocks in a row; the first flies at the second.

    For touching elastic cubes, finite elements give the last one 1.75 of 2 m/s, with 0.79 of the
    energy still in motion; the 0.2 m grid alone gives 0.9 and 0.37.
    """
    turn = rotation_of(np.array([0.0, np.pi / 2, 0.0]))
    bodies = []
    for k, name in enumerate("cba"):
        body = block(turn, ahead=k * (0.6 + gap) + (0.1 if k == 2 and not gap else 0.0))
        body.name = name
        if k < 2:
            body.motion = replace(body.motion, velocity=np.zeros(3))
        if requested is not None:
            body.rebound = Rebound(requested, requested, requested, None, SPEED, 0.0)
        bodies.append(body)
    options = SimulateOptions(
        objects=dict.fromkeys("abc", ObjectPhysics()),
        gravity=(0.0, 0.0, 0.0),
        duration=0.3,
        frame_rate=10,
    )
    simulate_bodies(bodies, options)
    speeds = np.array([-b.motion.velocity @ turn[:, 2] for b in bodies])
    assert speeds.sum() == pytest.approx(SPEED, rel=1e-3)
    assert speeds[0] > last
    assert (speeds**2).sum() > kept * SPEED**2


@pytest.mark.slow
@pytest.mark.parametrize("requested", [0.1, 0.3, 0.5, 0.7])
@pytest.mark.parametrize("turn", TURNS)
def test_restitution_is_reached_at_any_grid_phase(requested, turn):
    for phase in np.arange(20) / 20:
        _, seen, bounce = bounced(requested, phase, rotation_of(np.array(turn)), "plane")
        assert seen == pytest.approx(requested, abs=0.05)
        assert bounce["achieved"] == pytest.approx(seen, abs=0.03)


def test_a_falling_body_is_followed_to_the_ground():
    body = block(np.eye(3), ahead=1.0)
    floor = Plane(name="floor")
    touch = first_touch(body, [floor, wall("plane", np.eye(3), -50.0)], np.array([0, 0, -9.81]))
    assert touch is not None
    assert touch.collider is floor
    assert touch.speed == pytest.approx((SPEED**2 + 2 * 9.81 * 1.0) ** 0.5, rel=0.05)
    assert touch.point[2] == pytest.approx(0.0, abs=1e-9)


def test_a_body_that_hits_nothing_is_fitted_against_a_wall_across_its_path():
    body = block(np.eye(3), ahead=1.0)
    fit = fit_rebound(body, 0.2, [], np.zeros(3))
    assert fit.other is None
    assert fit.speed == pytest.approx(SPEED)
    assert fit.achieved == pytest.approx(0.2, abs=0.02)
