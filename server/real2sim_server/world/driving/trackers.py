"""Compiled trackers: every value of ``EgoSpec.tracker`` except ``perfect``.

A tracker is two compiled functions, see :class:`Tracker`. To add one, write these functions and add
an entry to :data:`TRACKERS`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ..._numba import func
from .curve import MOVING, YAW, X, Y, at, end_of, heading, is_over, planned_at
from .vehicle import (
    GENTLE_BRAKING,
    Command,
    PlanarState,
    VehicleParameters,
    choice,
    clamped,
    leading,
    steady_steering,
    wrapped,
)

# --- Longitudinal and lateral linear-quadratic regulators ----------------------------------------

TIME = 0.6
"""Time scale of the regulator along the plan [s]: (r/q)^(1/4) of its weights."""

HEADWAY, SHORTEST = 0.55, 2.0
"""Length scale of the lateral regulator: distance in this time [s], and its minimum [m]."""

DIFFERENCE = 0.05
"""Time step of the finite differences for the plan's acceleration and curvature [s]."""


NEWTON_STEPS = 8
"""Iterations for the gains; enough for lags of up to ten times the time scale."""


class PlanPoint(NamedTuple):
    """A plan at one time: pose [m], [rad], speed [m/s], acceleration, curvature [1/m]."""

    x: float
    y: float
    yaw: float
    speed: float
    acceleration: float
    curvature: float


@func
def regulate(state, curve, t, vehicle, _schedule):
    """The LQR command, ``t`` seconds after the plan's start.

    Two decoupled regulators with feedforward of the planned acceleration and curvature. The
    longitudinal error obeys e'' = a - a_ref in time, the lateral error e'' = k - k_ref in path
    length, for small heading errors. Both are double integrators, whose Riccati equation for the
    cost q e^2 + r u^2 has the solution u = -(e/l^2 + sqrt(2) e'/l) with l = (r/q)^(1/4) (Anderson &
    Moore 1990, Optimal Control, ch. 3). Known lags are part of both, see :func:`lagging_gains`; the
    feedforward is advanced by the same time.
    """
    if is_over(curve, t):
        last = curve.knots[len(curve.knots) - 1]
        point = PlanPoint(last[X], last[Y], last[YAW], 0.0, 0.0, 0.0)
        return Command(-GENTLE_BRAKING, _steering_onto(point, 0.0, state, vehicle))
    point = point_at(curve, t, state.yaw, vehicle.tracker_version)
    along = (point.x - state.x) * math.cos(point.yaw) + (point.y - state.y) * math.sin(point.yaw)
    speed = state.speed * math.cos(state.yaw - point.yaw)
    by_speed, by_drive = lagging_gains(vehicle.known_drive_lag / TIME)
    acceleration = point.acceleration + along / TIME**2 + by_speed * (point.speed - speed) / TIME
    if vehicle.known_drive_lag > 0.0:
        later = point_at(curve, t + vehicle.known_drive_lag, state.yaw, vehicle.tracker_version)
        acceleration += later.acceleration - point.acceleration
        acceleration -= by_drive * (state.drive - point.acceleration)
    coming = point.curvature
    if vehicle.known_steering_lag > 0.0:
        steered = point_at(
            curve, t + vehicle.known_steering_lag, state.yaw, vehicle.tracker_version
        )
        coming = steered.curvature
    return Command(acceleration, _steering_onto(point, coming, state, vehicle))


@func
def lagging_gains(lag):
    """Regulator gains of a double integrator behind a first-order lag.

    For e'' = a and lag a' = u - a with the cost e^2 + u^2 the optimal u is -(e + b e' + c a). The
    squares z of the closed loop's poles solve lag^2 z^3 = z^2 + 1 (symmetric root locus); its real
    root is w / lag^2 with w^3 = w^2 + lag^4.

    Args:
        lag: time constant in units of the regulator's scale.

    Returns:
        b and c; sqrt(2) and 0 without a lag.
    """
    if lag == 0.0:
        return math.sqrt(2.0), 0.0
    fourth = lag**4
    w = 1.0 + min(fourth, fourth ** (1 / 3))
    for _ in range(NEWTON_STEPS):
        w -= (w * w * (w - 1.0) - fourth) / (w * (3.0 * w - 2.0))
    root = math.sqrt(w)
    # The other two poles are those of s^2 + b s + 1/sqrt(w), and the first is at -sqrt(w)/lag.
    pair = math.sqrt(2.0 / root - (lag / w) ** 2)
    return lag / root + pair * root, lag * pair + root - 1.0


@func
def point_at(curve, t, ahead, version):
    """The plan ``t`` seconds after its start, with derivatives.

    Args:
        curve: curve of the plan.
        t: [s].
        ahead: heading of the vehicle [rad].
        version: version of the trackers; from 2 on, a plan against that heading (such as one that
            the vehicle has passed) has a negative speed.
    """
    x, y, vx, vy = planned_at(curve, t, version)
    _, _, wx, wy = planned_at(curve, t + DIFFERENCE, version)
    speed, later = math.hypot(vx, vy), math.hypot(wx, wy)
    if version > 1:
        cos, sin = math.cos(ahead), math.sin(ahead)
        back, back_later = vx * cos + vy * sin < 0.0, wx * cos + wy * sin < 0.0
        if back:
            speed, vx, vy = -speed, -vx, -vy
        if back_later:
            later, wx, wy = -later, -wx, -wy
    acceleration = (later - speed) / DIFFERENCE
    if abs(speed) < MOVING:
        return PlanPoint(x, y, heading(curve, t), speed, acceleration, 0.0)
    yaw = math.atan2(vy, vx)
    turn = wrapped(math.atan2(wy, wx) - yaw) if abs(later) > MOVING else 0.0
    return PlanPoint(x, y, yaw, speed, acceleration, turn / (speed * DIFFERENCE))


@func
def _steering_onto(point, coming, state, vehicle):
    """Road-wheel angle [rad] that brings the vehicle onto the path through ``point``.

    ``coming``: curvature of the path [1/m] at the time when the steering gear has followed.
    """
    dx, dy = state.x - point.x, state.y - point.y
    across = dy * math.cos(point.yaw) - dx * math.sin(point.yaw)
    # With tyre slip, the direction of motion differs from the heading.
    direction = state.yaw + math.atan2(state.lateral_speed, max(state.speed, 1.0))
    off = wrapped(direction - point.yaw)
    scale = max(HEADWAY * state.speed, SHORTEST)
    lag = vehicle.known_steering_lag * state.speed / scale
    by_heading, by_steering = lagging_gains(lag)
    curvature = coming - across / scale**2 - by_heading * off / scale
    steering = _steering_of(curvature, state.speed, vehicle)
    if lag > 0.0:
        steering -= by_steering * (
            state.steering - _steering_of(point.curvature, state.speed, vehicle)
        )
    return steering


@func
def _steering_of(curvature, speed, vehicle):
    """Road-wheel angle [rad] for a curvature [1/m]."""
    rolling = math.atan(vehicle.wheelbase * curvature)
    return steady_steering(vehicle.model, rolling, curvature, speed, vehicle)


# --- Pure pursuit --------------------------------------------------------------------------------

LOOKAHEAD = 0.4
"""Look-ahead time along the plan [s]."""

MIN_AIM = 3.0
"""Minimum look-ahead distance [m]; shorter ones amplify centimetres into steering angles."""

AIM_TRIES = 8
MAX_LAG = 2.0
"""Maximum longitudinal error that the controller corrects [m]."""


@func
def pursue(state, curve, t, vehicle, _schedule):
    """The pure pursuit command, ``t`` seconds after the plan's start.

    Steering follows the arc to a target point on the plan (Coulter 1992, CMU-RI-TR-92-01), which
    includes the plan's curvature. The acceleration brings the vehicle to the planned position after
    the look-ahead time T, from s = v T + a T^2 / 2; with its gains 2 / T^2 and 2 / T the lag behind
    a moving plan decays with damping 0.7. Known lags are treated as dead times: commands are
    computed for the predicted state after the lag.
    """
    if is_over(curve, t):
        last = curve.knots[len(curve.knots) - 1]
        x, y = _straight_on(state, last[X], last[Y], last[YAW])
        return Command(-GENTLE_BRAKING, _steering(state, x, y, vehicle))
    after = t + LOOKAHEAD + vehicle.known_drive_lag
    x, y, vx, vy = at(curve, after)
    there = _coasted(state, vehicle.known_drive_lag)
    acceleration = _acceleration(there, x - there.x, y - there.y, vx, vy)
    if vehicle.known_steering_lag != vehicle.known_drive_lag:
        after = t + LOOKAHEAD + vehicle.known_steering_lag
        x, y, _, _ = at(curve, after)
        there = _coasted(state, vehicle.known_steering_lag)
    if math.hypot(x - there.x, y - there.y) < MIN_AIM:
        x, y = _farther_aim(there, curve, after)
    return Command(acceleration, _steering(there, x, y, vehicle))


@func
def _coasted(state, seconds):
    """The vehicle some time later, at constant drive acceleration and curvature."""
    if seconds == 0.0:
        return state
    speed = max(state.speed + state.drive * seconds, 0.0)
    way = (state.speed + speed) / 2 * seconds
    turn = state.yaw_rate * way / state.speed if state.speed > MOVING else 0.0
    heading_there = state.yaw + turn / 2
    sideways = state.lateral_speed * seconds
    cos, sin = math.cos(heading_there), math.sin(heading_there)
    return PlanarState(
        state.x + way * cos - sideways * sin,
        state.y + way * sin + sideways * cos,
        state.yaw + turn,
        speed,
        state.acceleration,
        state.steering,
        state.yaw_rate,
        state.lateral_speed,
        state.drive,
    )


@func
def _steering(state, x, y, vehicle):
    """Road-wheel angle [rad] of the arc from the rear axle to (x, y)."""
    dx, dy = x - state.x, y - state.y
    left = math.cos(state.yaw) * dy - math.sin(state.yaw) * dx
    curvature = 2 * left / (dx * dx + dy * dy)
    rolling = math.atan(vehicle.wheelbase * curvature)
    return steady_steering(vehicle.model, rolling, curvature, state.speed, vehicle)


@func
def _farther_aim(state, curve, t):
    """The first point of the plan after ``t`` beyond the minimum distance.

    If the plan stops earlier, a point on the straight line beyond its end.
    """
    x, y = state.x, state.y
    for _ in range(AIM_TRIES):
        t = min(t + LOOKAHEAD, end_of(curve))
        x, y, _, _ = at(curve, t)
        if math.hypot(x - state.x, y - state.y) >= MIN_AIM:
            return x, y
    return _straight_on(state, x, y, heading(curve, t))


@func
def _straight_on(state, x, y, yaw):
    """A target point on the line from (x, y) along ``yaw``."""
    dx, dy = math.cos(yaw), math.sin(yaw)
    along = max((state.x - x) * dx + (state.y - y) * dy, 0.0)
    reach = along + max(MIN_AIM, state.speed * LOOKAHEAD)
    return x + reach * dx, y + reach * dy


@func
def _acceleration(state, dx, dy, vx, vy):
    """Acceleration [m/s^2] that closes a gap [m] to a moving plan in the look-ahead time.

    Gap and plan velocity [m/s] are in the world frame.
    """
    cos, sin = math.cos(state.yaw), math.sin(state.yaw)
    ahead, left = cos * dx + sin * dy, cos * dy - sin * dx
    planned = math.copysign(math.hypot(vx, vy), vx * cos + vy * sin)
    lag = clamped(_arc_length(ahead, left) - planned * LOOKAHEAD, -MAX_LAG, MAX_LAG)
    return 2 * (lag / LOOKAHEAD + planned - state.speed) / LOOKAHEAD


@func
def _arc_length(ahead, left):
    """Length of the arc that starts along x and ends at (ahead, left); negative when behind."""
    if ahead <= 0:
        return ahead
    angle = math.atan2(left, ahead)
    stretch = angle / math.sin(angle) if abs(angle) > 1e-4 else 1.0 + angle * angle / 6
    return math.hypot(ahead, left) * stretch


# --- Iterative LQR -------------------------------------------------------------------------------

# Gauss-Newton (Li & Todorov 2004) with the kinematic bicycle over 1.5 s in steps of 0.1 s. The
# state is (x, y, yaw, speed, road-wheel angle, acceleration), the inputs are (requested
# acceleration, steering rate). Each rollout respects the limits. A schedule has one state a row,
# [STEPS + 1, 6], and one pair of inputs a row, [STEPS, 2].
#
# The acceleration follows its request with the known lag of engine and brakes. The lag of the
# steering gear needs no state: the angle and rate of the wheels determine the request.

STEP = 0.1
STEPS = 15
ITERATIONS = 5
GAINS = (1.0, 0.5, 0.2, 0.05)
"""Fractions of the step in the line search."""

ENOUGH = 1e-4
"""Minimum relative decrease of the cost for another iteration."""

STATE_COST = np.array([4.0, 4.0, 10.0, 1.0, 0.0, 0.0])
"""Costs of squared errors: x, y, yaw, speed, road-wheel angle, acceleration; SI units."""
INPUT_COST = np.array([0.05, 0.5])
"""Cost per squared acceleration [m/s^2] and steering rate [rad/s]."""

NX, NU = 6, 2


class Model(NamedTuple):
    """The vehicle model used for planning.

    Attributes:
        vehicle: vehicle constants.
        kept: fraction of the acceleration before a step that remains after it.
        held: mean of that fraction over the step.
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
    """The command of the schedule; that of the LQR if the schedule is empty."""
    states, inputs, elapsed = schedule
    if len(states) == 0:
        return regulate(state, curve, t, vehicle, schedule)
    k = min(int(elapsed / STEP + 1e-9), STEPS - 1)
    fraction = elapsed / STEP - k
    steering = (1 - fraction) * states[k, 4] + fraction * states[k + 1, 4]
    # The commanded mean must lead to the angle at the end of the substep.
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
    """Reference states [STEPS + 1, 6]; yaws continuous from the vehicle's."""
    wanted = np.zeros((STEPS + 1, NX))
    yaw = state.yaw
    for k in range(STEPS + 1):
        # The plan is extrapolated beyond its end; the vehicle brakes once it gets there.
        point = point_at(curve, since + k * STEP, state.yaw, version)
        yaw += wrapped(point.yaw - yaw)
        wanted[k, 0], wanted[k, 1], wanted[k, 2], wanted[k, 3] = point.x, point.y, yaw, point.speed
    return wanted


@func
def _rollout(tried, schedule, change, model):
    """Roll out a fraction of the input change, within limits; writes the schedule to ``tried``."""
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
    """Clamp a row of inputs to the limits and write the resulting state."""
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
    """Write the derivatives of the next state.

    ``A``: by state [6, 6], above the diagonal; ``B``: by input [6, 2]. All other entries are 0.
    """
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
    # An input acts over the whole step: its mean effect on speed and angle is half of it. The same
    # applies to the held part of the previous acceleration.
    for i in range(3):
        A[i, 5] = A[i, 3] * STEP / 2 * model.held
        B[i, 0], B[i, 1] = A[i, 3] * STEP / 2 * (1 - model.held), A[i, 4] * STEP / 2
    A[3, 5], A[5, 5] = STEP * model.held, model.kept
    B[3, 0], B[4, 1], B[5, 0] = STEP * (1 - model.held), STEP, 1 - model.kept


@func
def _product(result, M, N):
    """Write M N."""
    for i in range(M.shape[0]):
        for j in range(N.shape[1]):
            total = 0.0
            for k in range(NX):
                total += M[i, k] * N[k, j]
            result[i, j] = total


@func
def _transposed(result, M, N):
    """Write M^T N."""
    for i in range(M.shape[1]):
        for j in range(N.shape[1]):
            total = 0.0
            for k in range(NX):
                total += M[k, i] * N[k, j]
            result[i, j] = total


class Tracker(NamedTuple):
    """A tracker; create both functions with :func:`real2sim_server._numba.func`.

    Attributes:
        command: ``command(state, curve, t, vehicle, schedule)``, returns the
            :class:`.vehicle.Command` of a substep, ``t`` seconds after the start of the plan.
            ``schedule`` is the prepared schedule (possibly empty) and the seconds since then. State
            and time are predicted for the arrival of the command at the wheels; the command must
            compensate for the lags ``vehicle.known_steering_lag`` and ``vehicle.known_drive_lag``.
        prepare: ``prepare(state, curve, since, vehicle)``, called once per clock step, ``since``
            seconds after the start of the plan; returns a schedule, two 2-D float64 arrays. None
            for trackers that do not plan ahead.
    """

    command: Any
    prepare: Any = None


@func
def _no_schedule(_state, _curve, _since, _vehicle):
    return np.empty((0, 0)), np.empty((0, 0))


TRACKERS: Mapping[str, Tracker] = {
    "pursuit": Tracker(pursue),
    "lqr": Tracker(regulate),
    "ilqr": Tracker(follow_schedule, prepare),
}
"""Trackers by the name in ``EgoSpec.tracker``."""

HOLD = 0
"""Kind of the law that holds one command."""

KINDS: Mapping[str, int] = {name: k for k, name in enumerate(TRACKERS, start=1)}
"""Number of each tracker in compiled code."""

PURSUIT, LQR, ILQR = KINDS["pursuit"], KINDS["lqr"], KINDS["ilqr"]

PLANNING_AHEAD = frozenset(KINDS[name] for name, tracker in TRACKERS.items() if tracker.prepare)
"""Kinds of trackers with a schedule."""

tracker_command = choice([tracker.command for tracker in TRACKERS.values()])
tracker_schedule = choice([tracker.prepare or _no_schedule for tracker in TRACKERS.values()])
