"""The contract of vehicle models, for all built-in models and a custom one."""

import math

import pytest

from real2sim_proto.episode import EgoSpec
from real2sim_server._numba import func
from real2sim_server.world.driving import (
    VEHICLE_MODELS,
    Command,
    PlanarState,
    VehicleModel,
    vehicle_parameters,
)
from real2sim_server.world.driving.vehicle import choice, rolling_steering, step_rolling

H = 0.01
DRAG = 0.1


@func
def step_dragged(state, command, vehicle, h):
    """A kinematic bicycle with air drag."""
    slowed = command.acceleration - DRAG * state.speed
    return step_rolling(state, Command(slowed, command.steering), vehicle, h)


MEMBERS = {**VEHICLE_MODELS, "with drag": VehicleModel(step_dragged, rolling_steering)}


@pytest.fixture(params=MEMBERS)
def model(request) -> VehicleModel:
    return MEMBERS[request.param]


def parameters(model: VehicleModel):
    name = next((n for n, m in VEHICLE_MODELS.items() if m is model), "kinematic_bicycle")
    return vehicle_parameters(EgoSpec(dynamics=name))


def drive(model: VehicleModel, state: PlanarState, command: Command, steps: int) -> PlanarState:
    vehicle = parameters(model)
    for _ in range(steps):
        state = model.step(state, command, vehicle, H)
    return state


def at_speed(speed: float, steering: float = 0.0) -> PlanarState:
    return PlanarState(0.0, 0.0, 0.0, speed, 0.0, steering, 0.0, 0.0, 0.0)


def test_a_step_returns_a_finite_state(model):
    state = drive(model, at_speed(8.0), Command(1.0, 0.1), 5)

    assert isinstance(state, PlanarState)
    assert all(math.isfinite(v) for v in state)


def test_zero_steering_keeps_the_vehicle_straight(model):
    state = drive(model, at_speed(8.0), Command(0.0, 0.0), 100)

    assert state.x > 5.0
    assert (state.y, state.yaw, state.yaw_rate) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


def test_braking_ends_at_rest(model):
    state = drive(model, at_speed(5.0), Command(-6.0, 0.0), 200)

    assert state.speed == 0.0


def test_left_and_right_are_symmetric(model):
    left = drive(model, at_speed(8.0), Command(0.5, 0.1), 50)
    right = drive(model, at_speed(8.0), Command(0.5, -0.1), 50)

    assert (left.x, left.y, left.yaw) == pytest.approx((right.x, -right.y, -right.yaw), abs=1e-9)


def test_vehicle_limits_hold(model):
    vehicle = parameters(model)
    state = drive(model, at_speed(vehicle.max_speed - 0.01), Command(100.0, 10.0), 10)

    assert state.speed <= vehicle.max_speed
    assert abs(state.steering) <= vehicle.max_steer_rate * 10 * H + 1e-12


def test_steady_steering_keeps_the_requested_curvature(model):
    vehicle, curvature, speed = parameters(model), 0.01, 10.0
    rolling = math.atan(vehicle.wheelbase * curvature)
    steering = model.steady_steering(rolling, curvature, speed, vehicle)
    # The command holds the speed against drag.
    state = at_speed(speed, steering)
    for _ in range(300):
        state = model.step(state, Command(speed - state.speed, steering), vehicle, H)

    assert state.yaw_rate / state.speed == pytest.approx(curvature, rel=0.05)


def test_compiled_code_selects_a_model_by_index():
    step = choice([model.step for model in MEMBERS.values()])
    coast, start = Command(0.0, 0.0), at_speed(10.0)
    vehicle = vehicle_parameters(EgoSpec())
    speeds = [step(k, start, coast, vehicle, H).speed for k in range(len(MEMBERS))]

    assert speeds == pytest.approx([10.0, 10.0, 10.0 * (1 - DRAG * H)])


def test_protocol_dynamics_match_the_registry():
    assert EgoSpec.model_json_schema()["properties"]["dynamics"]["enum"] == list(VEHICLE_MODELS)
