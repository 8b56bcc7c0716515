"""Iterative LQR: the commands that follow the plan best over the next seconds, within limits.

Gauss-Newton (Li & Todorov 2004) with the kinematic bicycle over 1.5 s in steps of 0.1 s, on the
state (x, y, yaw, speed, road-wheel angle, acceleration) and the inputs (acceleration asked for,
steering rate). Limits are held in the rollout of each iteration. A schedule is one state a row,
[STEPS + 1, 6], and one pair of inputs a row, [STEPS, 2].

The acceleration follows what is asked for with the lag that is known of engine and brakes. The lag
of the steering gear needs no state: angle and rate of the wheels say what to ask of it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..._numba import func
from .actuators import leading
from .curve import is_over
from .lqr import point_at, regulate
from .state import Command, clamped, wrapped
from .vehicle import VehicleParameters
from .vehicle_models import steady_steering

STEP = 0.1
STEPS = 15
ITERATIONS = 5
GAINS = (1.0, 0.5, 0.2, 0.05)
"""Fractions of the step that the line search tries."""

ENOUGH = 1e-4
"""Iterations end where one gains less than this fraction of the cost."""

STATE_COST = np.array([4.0, 4.0, 10.0, 1.0, 0.0, 0.0])
"""Per squared error of x, y [m], yaw [rad], speed [m/s], road-wheel angle [rad], acceleration."""
INPUT_COST = np.array([0.05, 0.5])
"""Per squared acceleration [m/s^2] and steering rate [rad/s]."""

NX, NU = 6, 2


class Model(NamedTuple):
    """The vehicle as it is planned with.

    Attributes:
        vehicle: its constants.
        kept: share of the acceleration before a step that is left after it.
        held: share of it in the mean over the step.
    """

    vehicle: VehicleParameters
    kept: float
    held: float


@func
def prepare(state, curve, since, vehicle):
    """The schedule of a vehicle that is ``since`` seconds into its plan; empty after its end."""
    if is_over(curve, since):
        return np.empty((0, 0)), np.empty((0, 0))
    return solve_schedule(state, curve, since, vehicle)


@func
def follow_schedule(state, curve, t, vehicle, schedule):
    """What the schedule says for now; what the plain LQR would where it is empty."""
    states, inputs, elapsed = schedule
    if len(states) == 0:
        return regulate(state, curve, t, vehicle, schedule)
    k = min(int(elapsed / STEP + 1e-9), STEPS - 1)
    fraction = elapsed / STEP - k
    steering = (1 - fraction) * states[k, 4] + fraction * states[k + 1, 4]
    # The angle at the end of the substep is what its mean must lead to.
    rolling = steering + 0.01 * inputs[k, 1]
    curvature = math.tan(rolling) / vehicle.wheelbase
    ahead = steady_steering(vehicle.model, rolling, curvature, state.speed, vehicle)
    if vehicle.known_steering_lag > 0.0:
        most = vehicle.max_steer_rate * 0.01
        ahead = state.steering + clamped(ahead - state.steering, -most, most)
        ahead = leading(state.steering, ahead, 0.01, vehicle.known_steering_lag)
    return Command(inputs[k, 0], ahead)


@func
def solve_schedule(state, curve, since, vehicle):
    """The schedule of a vehicle that is ``since`` seconds into its plan."""
    wanted = _reference_states(state, curve, since, vehicle.tracker_version)
    model = _model_of(vehicle)
    states, inputs = np.empty((STEPS + 1, NX)), np.empty((STEPS, NU))
    tried = np.empty((STEPS + 1, NX)), np.empty((STEPS, NU))
    for first in (states[0], tried[0][0]):
        first[0], first[1], first[2] = state.x, state.y, state.yaw
        first[3], first[4], first[5] = state.speed, state.steering, state.drive
    for k in range(STEPS):
        inputs[k, 0], inputs[k, 1] = (wanted[k + 1, 3] - wanted[k, 3]) / STEP, 0.0
        _step(states, inputs, k, model)
    cost = _cost((states, inputs), wanted)
    for _ in range(ITERATIONS):
        forward, feedback = _backward(states, inputs, wanted, model)
        gained = -1.0
        for gain in GAINS:
            _rollout(tried, (states, inputs), (gain, forward, feedback), model)
            gained = cost - _cost(tried, wanted)
            if gained > 0.0:
                break
        if gained <= 0.0:
            break
        cost -= gained
        (states, inputs), tried = tried, (states, inputs)
        if gained < ENOUGH * cost:
            break
    return states, inputs


@func
def _model_of(vehicle):
    lag = vehicle.known_drive_lag
    if lag == 0.0:
        return Model(vehicle, 0.0, 0.0)
    kept = math.exp(-STEP / lag)
    return Model(vehicle, kept, lag / STEP * (1 - kept))


@func
def _reference_states(state, curve, since, version):
    """Wanted states [STEPS + 1, 6]; yaws continuous from the vehicle's."""
    wanted = np.zeros((STEPS + 1, NX))
    yaw = state.yaw
    for k in range(STEPS + 1):
        # After its end the plan is taken to go on; the vehicle brakes once it gets there.
        point = point_at(curve, since + k * STEP, state.yaw, version)
        yaw += wrapped(point.yaw - yaw)
        wanted[k, 0], wanted[k, 1], wanted[k, 2], wanted[k, 3] = point.x, point.y, yaw, point.speed
    return wanted


@func
def _rollout(tried, schedule, change, model):
    """Writes to ``tried`` the schedule that a fraction of the change of the inputs leads to, within
    limits."""
    (tried_states, tried_inputs), (states, inputs) = tried, schedule
    gain, forward, feedback = change
    for k in range(STEPS):
        for i in range(NU):
            command = inputs[k, i] + gain * forward[k, i]
            for j in range(NX):
                command += feedback[k, i, j] * (tried_states[k, j] - states[k, j])
            tried_inputs[k, i] = command
        _step(tried_states, tried_inputs, k, model)


@func
def _step(states, inputs, k, model):
    """Holds the limits of a row of inputs and writes the state that it leads to."""
    before, after, vehicle = states[k], states[k + 1], model.vehicle
    x, y, yaw, speed, steering = before[0], before[1], before[2], before[3], before[4]
    a = clamped(inputs[k, 0], -vehicle.max_braking, vehicle.max_acceleration)
    rate = clamped(inputs[k, 1], -vehicle.max_steer_rate, vehicle.max_steer_rate)
    end = clamped(steering + rate * STEP, -vehicle.max_steer, vehicle.max_steer)
    later = max(speed + (a + model.held * (before[5] - a)) * STEP, 0.0)
    way = (speed + later) / 2 * STEP
    turn = way * math.tan((steering + end) / 2) / vehicle.wheelbase
    middle = yaw + turn / 2
    after[0], after[1] = x + way * math.cos(middle), y + way * math.sin(middle)
    after[2], after[3], after[4] = yaw + turn, later, end
    after[5] = a + model.kept * (before[5] - a)
    inputs[k, 0], inputs[k, 1] = a, (end - steering) / STEP


@func
def _cost(schedule, wanted):
    states, inputs = schedule
    cost = 0.0
    for k in range(STEPS + 1):
        for i in range(NX):
            cost += STATE_COST[i] * (states[k, i] - wanted[k, i]) ** 2
    for k in range(STEPS):
        for i in range(NU):
            cost += INPUT_COST[i] * inputs[k, i] ** 2
    return cost


@func
def _backward(states, inputs, wanted, model):
    """Changes of the inputs [STEPS, 2] and feedback gains [STEPS, 2, 6]."""
    forward, feedback = np.empty((STEPS, NU)), np.empty((STEPS, NU, NX))
    A, B, V, v = np.zeros((NX, NX)), np.zeros((NX, NU)), np.zeros((NX, NX)), np.empty(NX)
    VA, VB = np.empty((NX, NX)), np.empty((NX, NU))
    Hxx, Hux, Huu = np.empty((NX, NX)), np.empty((NU, NX)), np.empty((NU, NU))
    hx, hu = np.empty(NX), np.empty(NU)
    for i in range(NX):
        V[i, i] = STATE_COST[i]
        v[i] = STATE_COST[i] * (states[STEPS, i] - wanted[STEPS, i])
    for k in range(STEPS - 1, -1, -1):
        _linearise(A, B, (states[k], states[k + 1]), model)
        _product(VA, V, A)
        _product(VB, V, B)
        _transposed(Hxx, A, VA)
        _transposed(Hux, B, VA)
        _transposed(Huu, B, VB)
        for i in range(NX):
            Hxx[i, i] += STATE_COST[i]
            hx[i] = STATE_COST[i] * (states[k, i] - wanted[k, i])
            for j in range(NX):
                hx[i] += A[j, i] * v[j]
        for i in range(NU):
            Huu[i, i] += INPUT_COST[i]
            hu[i] = INPUT_COST[i] * inputs[k, i]
            for j in range(NX):
                hu[i] += B[j, i] * v[j]
        p, q, s = Huu[0, 0], Huu[0, 1], Huu[1, 1]
        determinant = p * s - q * q
        forward[k, 0] = (q * hu[1] - s * hu[0]) / determinant
        forward[k, 1] = (q * hu[0] - p * hu[1]) / determinant
        for j in range(NX):
            feedback[k, 0, j] = (q * Hux[1, j] - s * Hux[0, j]) / determinant
            feedback[k, 1, j] = (q * Hux[0, j] - p * Hux[1, j]) / determinant
        for i in range(NX):
            v[i] = hx[i] + Hux[0, i] * forward[k, 0] + Hux[1, i] * forward[k, 1]
            for j in range(NX):
                V[i, j] = Hxx[i, j] + Hux[0, i] * feedback[k, 0, j] + Hux[1, i] * feedback[k, 1, j]
        for i in range(NX):
            for j in range(i):
                V[i, j] = V[j, i] = (V[i, j] + V[j, i]) / 2
    return forward, feedback


@func
def _linearise(A, B, along, model):
    """Writes the derivatives of the next state by state [6, 6], above its diagonal, and by input
    [6, 2]; what they leave out is 0."""
    state, after = along
    way = (state[3] + after[3]) / 2 * STEP
    middle = (state[2] + after[2]) / 2
    cos, sin, tan = math.cos(middle), math.sin(middle), math.tan((state[4] + after[4]) / 2)
    by_steering = way * (1 + tan * tan) / model.vehicle.wheelbase
    by_speed = STEP * tan / model.vehicle.wheelbase
    for i in range(5):
        A[i, i] = 1.0
    A[0, 2], A[1, 2] = -way * sin, way * cos
    A[0, 3] = STEP * cos - way * sin * by_speed / 2
    A[1, 3] = STEP * sin + way * cos * by_speed / 2
    A[2, 3] = by_speed
    A[0, 4] = -way * sin * by_steering / 2
    A[1, 4] = way * cos * by_steering / 2
    A[2, 4] = by_steering
    # An input acts over the step: on average it has changed speed and angle by half of itself. So
    # has the acceleration before it, as far as that is held.
    for i in range(3):
        A[i, 5] = A[i, 3] * STEP / 2 * model.held
        B[i, 0], B[i, 1] = A[i, 3] * STEP / 2 * (1 - model.held), A[i, 4] * STEP / 2
    A[3, 5], A[5, 5] = STEP * model.held, model.kept
    B[3, 0], B[4, 1], B[5, 0] = STEP * (1 - model.held), STEP, 1 - model.kept


@func
def _product(result, M, N):
    """Writes M N."""
    for i in range(M.shape[0]):
        for j in range(N.shape[1]):
            total = 0.0
            for k in range(NX):
                total += M[i, k] * N[k, j]
            result[i, j] = total


@func
def _transposed(result, M, N):
    """Writes M^T N."""
    for i in range(M.shape[1]):
        for j in range(N.shape[1]):
            total = 0.0
            for k in range(NX):
                total += M[k, i] * N[k, j]
            result[i, j] = total
