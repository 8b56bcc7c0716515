"""Vehicle kernels against independent implementations."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline
from scipy.linalg import solve_continuous_are
from scipy.optimize import minimize

from real2sim_proto.episode import EgoSpec
from real2sim_server.world.driving import (
    GRAVITY,
    ILQR,
    LQR,
    NO_POSE,
    NO_SCHEDULE,
    PURSUIT,
    Command,
    PlanarState,
    advance_vehicle,
    curve_at,
    driver_command,
    plan_curve,
    prepare_schedule,
    vehicle_parameters,
)
from real2sim_server.world.driving.trackers import (
    HEADWAY,
    INPUT_COST,
    STATE_COST,
    STEP,
    STEPS,
    TIME,
)
from real2sim_server.world.driving.vehicle import integrate
from real2sim_server.world.ego_motion import Motion

IDEAL = {"steering_lag": 0.0, "drive_lag": 0.0}
VEHICLE = vehicle_parameters(EgoSpec(actuators=IDEAL))
SLIPPING = vehicle_parameters(EgoSpec(dynamics="dynamic_bicycle"))
SECOND = 1_000_000
NOTHING = np.empty((0, 2))
seeds = st.integers(0, 10_000)
compiling = settings(deadline=None)
"""No deadline: the first example compiles the kernel."""


def state_of(*, speed: float, x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> PlanarState:
    return PlanarState(x, y, yaw, speed, 0.0, 0.0, 0.0, 0.0, 0.0)


def some_plan(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Times [us] and poses of a winding path at about 8 m/s that starts near the origin."""
    times = np.cumsum(rng.integers(50_000, 500_000, count))
    yaws = np.cumsum(rng.normal(scale=0.05, size=count))
    steps = np.diff(times, prepend=0)[:, None] * 8e-6
    places = np.cumsum(steps * np.stack([np.cos(yaws), np.sin(yaws)], axis=1), axis=0)
    return times, np.column_stack([places, yaws])


def planned(state: PlanarState, times: np.ndarray, poses: np.ndarray, vehicle=VEHICLE):
    return plan_curve(tuple(state), 0, (times, poses, NO_POSE), tuple(vehicle))


# --- tyres ------------------------------------------------------------------------------------


def bicycle(_t: float, state: np.ndarray, steering: float, acceleration: float) -> list[float]:
    """Two-axle car on Fiala tyres, after Pacejka (2012), ch. 1 and 3, independent of the kernel."""
    v = SLIPPING
    _, _, yaw, u, w, r = state
    weight = v.mass * GRAVITY
    transfer = v.mass * acceleration * v.height / v.wheelbase
    loads = np.array([weight * v.rear / v.wheelbase, weight * v.front / v.wheelbase])
    loads += [-transfer, transfer]
    stiffness = loads * [v.front_cornering, v.rear_cornering]
    grip = loads * math.sqrt(v.friction**2 - (acceleration / GRAVITY) ** 2)
    slips = np.array([steering - math.atan2(w + v.front * r, u), -math.atan2(w - v.rear * r, u)])
    adhering = np.clip(1 - stiffness * np.abs(np.tan(slips)) / (3 * grip), 0, 1)
    forces = np.sign(slips) * grip * (1 - adhering**3)
    fx = v.mass * acceleration - forces[0] * math.sin(steering)
    fy = forces[0] * math.cos(steering) + forces[1]
    moment = v.front * forces[0] * math.cos(steering) - v.rear * forces[1]
    return [
        u * math.cos(yaw) - w * math.sin(yaw),
        u * math.sin(yaw) + w * math.cos(yaw),
        r,
        fx / v.mass + w * r,
        fy / v.mass - u * r,
        moment / v.inertia,
    ]


@compiling
@given(
    speed=st.floats(5, 40),
    sideways=st.floats(-3, 3),
    turn=st.floats(-1, 1),
    steering=st.floats(-0.5, 0.5),
    acceleration=st.floats(-8, 4),
)
def test_slipping_tyres_match_a_fine_integration(speed, sideways, turn, steering, acceleration):
    state = np.array([3.0, -2.0, 0.4, speed, sideways, turn])
    exact = solve_ivp(
        bicycle, (0, 0.01), state, args=(steering, acceleration), rtol=1e-10, atol=1e-12
    )
    found = integrate(SLIPPING, tuple(state.tolist()), (steering, steering), acceleration, 0.01)

    np.testing.assert_allclose(found, exact.y[:, -1], atol=1e-4)


# --- plans as curves --------------------------------------------------------------------------


@compiling
@given(seed=seeds, count=st.integers(3, 12))
def test_plan_tangents_match_second_order_gradients(seed, count):
    times, poses = some_plan(np.random.default_rng(seed), count)
    # Headings opposite to the path are ignored, so the slopes depend on positions only.
    poses[:, 2] += math.pi
    knots, _ = planned(state_of(speed=8.0), times, poses)

    for axis in (0, 1):
        slopes = np.gradient(poses[:, axis], times * 1e-6, edge_order=2)
        np.testing.assert_allclose(knots[1:, 4 + axis], slopes, atol=1e-9)


@compiling
@given(seed=seeds, count=st.integers(1, 12), share=st.floats(0, 0.999))
def test_a_plan_is_a_cubic_hermite_spline(seed, count, share):
    times, poses = some_plan(np.random.default_rng(seed), count)
    state = state_of(speed=7.0, y=0.3, yaw=0.1)
    knots, turn_rate = planned(state, times, poses)
    t = share * knots[-1, 0]
    x, y, vx, vy, _ = curve_at((knots, turn_rate), t)

    spline = CubicHermiteSpline(knots[:, 0], knots[:, 1:3], knots[:, 4:6])
    np.testing.assert_allclose([x, y], spline(t), atol=1e-9)
    np.testing.assert_allclose([vx, vy], spline(t, 1), atol=1e-8)
    np.testing.assert_allclose(knots[0, 1:], [0, 0.3, 0.1, 7 * math.cos(0.1), 7 * math.sin(0.1)])
    np.testing.assert_array_equal(knots[1:, 1:4], poses)


def test_a_plan_continues_its_circle_beyond_the_end():
    radius, times = 25.0, np.arange(1, 11) * 100_000
    angles = 8.0 * times * 1e-6 / radius
    poses = np.column_stack([radius * np.sin(angles), radius * (1 - np.cos(angles)), angles])
    curve = planned(state_of(speed=8.0), times, poses)

    for t in (1.0, 1.5, 3.0):
        x, y, vx, vy, _ = curve_at(curve, t)
        assert math.hypot(x, y - radius) == pytest.approx(radius, abs=0.02)
        assert math.hypot(vx, vy) == pytest.approx(8.0, abs=0.01)


# --- trackers ---------------------------------------------------------------------------------


def straight_plan(speed: float):
    times = np.arange(1, 41) * 100_000
    poses = np.column_stack([speed * times * 1e-6, 0 * times, 0 * times])
    return planned(state_of(speed=speed), times, poses)


def test_lqr_gains_solve_the_riccati_equation():
    speed, off = 12.0, 1e-4
    knots, turn_rate = straight_plan(speed)
    driver = (LQR, knots, turn_rate, 1.0, (0.0, 0.0), NO_SCHEDULE)
    chain, push = np.array([[0.0, 1], [0, 0]]), np.array([[0.0], [1]])

    def gains(scale: float) -> np.ndarray:
        weight = np.diag([1.0, 0.0])
        riccati = solve_continuous_are(chain, push, weight, np.array([[scale**4]]))
        return push.T @ riccati / scale**4

    def response(**change: float) -> np.ndarray:
        at = {"x": speed, "speed": speed}
        moved = state_of(**{**at, **{k: at.get(k, 0.0) + v for k, v in change.items()}})
        acceleration, steering = driver_command(tuple(moved), driver, tuple(VEHICLE))
        return np.array([acceleration, math.tan(steering) / VEHICLE.wheelbase]) / off

    along = gains(TIME)[0]
    across = gains(HEADWAY * speed)[0]
    assert response(x=off)[0] == pytest.approx(-along[0], rel=1e-4)
    assert response(speed=off)[0] == pytest.approx(-along[1], rel=1e-4)
    assert response(y=off)[1] == pytest.approx(-across[0], rel=1e-4)
    assert response(yaw=off)[1] == pytest.approx(-across[1], rel=1e-4)


@compiling
@given(offset=st.floats(-2, 2), ahead=st.floats(0.5, 3))
def test_pursuit_steers_an_arc_through_the_lookahead_point(offset, ahead):
    speed = 12.0
    knots, turn_rate = straight_plan(speed)
    state = state_of(x=speed * ahead, y=offset, speed=speed)
    driver = (PURSUIT, knots, turn_rate, ahead, (0.0, 0.0), NO_SCHEDULE)
    _, steering = driver_command(tuple(state), driver, tuple(VEHICLE))

    curvature = math.tan(steering) / VEHICLE.wheelbase
    aim = 0.4 * speed
    # (aim, -offset) lies on the circle that leaves the rear axle along x with this curvature.
    assert -offset == pytest.approx(curvature * (aim**2 + offset**2) / 2, abs=1e-9)


def costs_of(inputs: np.ndarray, start: PlanarState, wanted: np.ndarray) -> np.ndarray:
    """iLQR cost [N] of inputs [N, 2 * STEPS], by rollouts of the kinematic bicycle."""
    commands = inputs.reshape(-1, STEPS, 2)
    first = [start.x, start.y, start.yaw, start.speed, start.steering, 0.0]
    x, y, yaw, speed, steering, none = np.repeat(np.array(first)[:, None], len(commands), axis=1)
    costs = ((np.array(first) - wanted[0]) ** 2 @ STATE_COST) + (commands**2 @ INPUT_COST).sum(1)
    for (a, rate), aim in zip(commands.transpose(1, 2, 0), wanted[1:], strict=True):
        end, later = steering + rate * STEP, speed + a * STEP
        way = (speed + later) / 2 * STEP
        turn = way * np.tan((steering + end) / 2) / VEHICLE.wheelbase
        x, y = x + way * np.cos(yaw + turn / 2), y + way * np.sin(yaw + turn / 2)
        yaw, speed, steering = yaw + turn, later, end
        costs += (np.stack([x, y, yaw, speed, steering, none], axis=1) - aim) ** 2 @ STATE_COST
    return costs


def cost_and_slope(inputs: np.ndarray, *about: Any) -> tuple[float, np.ndarray]:
    """Cost and its gradient by central differences, in one rollout."""
    step = 1e-6 * np.eye(len(inputs))
    cost, *moved = costs_of(np.vstack([inputs, inputs + step, inputs - step]), *about)
    ahead, behind = np.split(np.array(moved), 2)
    return cost, (ahead - behind) / 2e-6


@pytest.mark.parametrize(("y", "speed"), [(0.3, 10.0), (-0.6, 9.0), (0.0, 11.0)])
def test_ilqr_matches_a_general_optimiser(y, speed):
    start = state_of(x=3.0, y=y, speed=speed)
    knots, turn_rate = straight_plan(10.0)
    driver = (ILQR, knots, turn_rate, 0.3, (0.0, 0.0), NO_SCHEDULE)
    vehicle = tuple(VEHICLE)
    states, inputs, *_ = prepare_schedule(tuple(start), NOTHING, driver, vehicle, 100_000)
    wanted = np.zeros((STEPS + 1, 6))
    wanted[:, 0], wanted[:, 3] = 10.0 * (0.3 + STEP * np.arange(STEPS + 1)), 10.0

    best = minimize(
        cost_and_slope,
        np.zeros(2 * STEPS),
        args=(start, wanted),
        jac=True,
        method="L-BFGS-B",
        bounds=[(-8.0, 4.0), (-0.8, 0.8)] * STEPS,
    )
    assert costs_of(inputs.ravel(), start, wanted).item() <= best.fun * 1.01
    assert np.abs(inputs[:, 1]).max() <= VEHICLE.max_steer_rate + 1e-9
    assert states[0, :2].tolist() == [3.0, y]


# --- compiled and plain Python ----------------------------------------------------------------


def some_drives() -> list[list[float]]:
    """Final states of both vehicle models, with and without delays, for every tracker."""
    rng = np.random.default_rng(0)
    delays = {"steering_delay_us": 120_000, "steering_lag": 0.1, "drive_delay_us": 50_000}
    found = []
    for kind in (PURSUIT, LQR, ILQR):
        for dynamics in ("kinematic_bicycle", "dynamic_bicycle"):
            for actuators in ({}, delays, {**delays, "foreseen": False}):
                spec = EgoSpec(dynamics=dynamics, actuators=actuators)
                vehicle = tuple(vehicle_parameters(spec))
                state, pending = tuple(state_of(speed=8.0, y=0.5)), NOTHING
                curve = plan_curve(state, 0, (*some_plan(rng, 10), NO_POSE), vehicle)
                for k in range(2):
                    driver = (kind, *curve, 0.1 * k, (0.0, 0.0), NO_SCHEDULE)
                    driver = (
                        *driver[:-1],
                        prepare_schedule(state, pending, driver, vehicle, 100_000),
                    )
                    state, pending = advance_vehicle(state, pending, driver, vehicle, 100_000)
                found.append([*state, *pending.ravel().tolist()])
    return found


def test_compiled_kernels_match_plain_python():
    code = (
        f"import sys; sys.path.insert(0, {os.path.dirname(__file__)!r}); import test_driving, json"
    )
    plain = subprocess.run(
        [sys.executable, "-c", f"{code}; print(json.dumps(test_driving.some_drives()))"],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=True,
    )

    for found, expected in zip(some_drives(), json.loads(plain.stdout), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_motion_starts_with_the_fields_of_planar_state():
    assert Motion._fields[: len(PlanarState._fields)] == PlanarState._fields
    assert Motion(1, 2, 3).numbers == tuple(PlanarState(1, 2, 3, 0, 0, 0, 0, 0, 0))
    assert Command._fields == ("acceleration", "steering")
