"""Iterative LQR: the commands that follow the plan best over the next seconds, within limits."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from real2sim_proto.episode import EgoSpec

from ..actuators import Command
from ..ego import Motion, drive
from ..path import Float
from ..reference import Reference
from ..vehicle import vehicle_of
from .lqr import Lqr, point_at

STEP = 0.1
STEPS = 15
ITERATIONS = 5
GAINS = (1.0, 0.5, 0.2, 0.05)
"""Shares of the step that the line search tries."""

STATE_COST = np.array([4.0, 4.0, 10.0, 1.0, 0.0])
"""Per squared error of x, y [m], yaw [rad], speed [m/s], road-wheel angle [rad]."""
INPUT_COST = np.array([0.05, 0.5])
"""Per squared acceleration [m/s^2] and steering rate [rad/s]."""


@dataclass(frozen=True, eq=False)
class Ilqr:
    """Plans once a step of the clock with the kinematic bicycle, then plays its commands.

    Gauss-Newton iterative LQR (Li & Todorov 2004) over 1.5 s in steps of 0.1 s, on the state
    (x, y, yaw, speed, road-wheel angle) and the inputs (acceleration, steering rate), begun with
    what the plain LQR would do. Limits are held in the rollout of each iteration.

    Attributes:
        reference: what is followed.
        spec: of the vehicle.
    """

    reference: Reference
    spec: EgoSpec

    def advance(self, motion: Motion, since: float, dt_us: int) -> Motion:
        """The vehicle ``dt_us`` later."""
        if since >= self.reference.end:
            lqr = Lqr(self.reference, self.spec)
            return drive(motion, lambda m, t: lqr.command(m, since + t), self.spec, dt_us)
        wanted = _wanted(self.reference, motion, since)
        inputs, states = _solve(motion, wanted, self.spec)

        def driver(now: Motion, t: float) -> Command:
            k = min(int(t / STEP + 1e-9), STEPS - 1)
            share = t / STEP - k
            steering = (1 - share) * states[k][4] + share * states[k + 1][4]
            # The angle at the end of the substep is what its mean must lead to.
            ahead = steering + 0.01 * inputs[k][1]
            return Command(inputs[k][0], self._tyres(ahead, now.speed))

        return drive(motion, driver, self.spec, dt_us)

    def command(self, motion: Motion, t: float) -> Command:
        """What the plain LQR would do; for vehicles that slide."""
        return Lqr(self.reference, self.spec).command(motion, t)

    def _tyres(self, steering: float, speed: float) -> float:
        if self.spec.dynamics == "kinematic_bicycle":
            return steering
        curvature = math.tan(steering) / self.spec.wheelbase
        return steering + vehicle_of(self.spec).understeer * speed**2 * curvature


State = tuple[float, float, float, float, float]


def _wanted(reference: Reference, motion: Motion, since: float) -> Float:
    """Wanted states [STEPS + 1, 5]; yaws continuous from the vehicle's."""
    wanted = np.zeros((STEPS + 1, 5))
    yaw = motion.yaw
    for k in range(STEPS + 1):
        # After its end the plan is taken to go on; the vehicle brakes once it gets there.
        point = point_at(reference, since + k * STEP)
        yaw += math.remainder(point.yaw - yaw, math.tau)
        wanted[k] = point.x, point.y, yaw, point.speed, 0.0
    return wanted


def _solve(motion: Motion, wanted: Float, spec: EgoSpec) -> tuple[list[list[float]], list[State]]:
    first: State = (motion.x, motion.y, motion.yaw, motion.speed, motion.steering)
    inputs = np.zeros((STEPS, 2))
    inputs[:, 0] = np.diff(wanted[:, 3]) / STEP
    states, inputs = _rollout(first, inputs, np.zeros((STEPS, 2, 5)), None, spec)
    cost = _cost(states, inputs, wanted)
    for _ in range(ITERATIONS):
        forward, feedback = _backward(states, inputs, wanted, spec.wheelbase)
        for gain in GAINS:
            tried = _rollout(first, inputs + gain * forward, feedback, states, spec)
            tried_cost = _cost(*tried, wanted)
            if tried_cost < cost:
                break
        else:
            break
        gained, cost = cost - tried_cost, tried_cost
        states, inputs = tried
        if gained < 1e-4 * cost:
            break
    return inputs.tolist(), [tuple(s) for s in states.tolist()]


def _rollout(
    first: State, inputs: Float, feedback: Float, around: Float | None, spec: EgoSpec
) -> tuple[Float, Float]:
    """States [STEPS + 1, 5] and the inputs within limits [STEPS, 2] that lead to them."""
    states, used = np.empty((STEPS + 1, 5)), np.empty((STEPS, 2))
    states[0] = state = first
    for k in range(STEPS):
        asked = inputs[k] if around is None else inputs[k] + feedback[k] @ (states[k] - around[k])
        a, rate = asked.tolist()
        a = min(max(a, -spec.max_braking), spec.max_acceleration)
        rate = min(max(rate, -spec.max_steer_rate), spec.max_steer_rate)
        state, rate = _next(state, a, rate, spec)
        used[k], states[k + 1] = (a, rate), state
    return states, used


def _next(state: State, a: float, rate: float, spec: EgoSpec) -> tuple[State, float]:
    x, y, yaw, speed, steering = state
    end = min(max(steering + rate * STEP, -spec.max_steer), spec.max_steer)
    later = max(speed + a * STEP, 0.0)
    way = (speed + later) / 2 * STEP
    turn = way * math.tan((steering + end) / 2) / spec.wheelbase
    heading = yaw + turn / 2
    moved = (x + way * math.cos(heading), y + way * math.sin(heading), yaw + turn, later, end)
    return moved, (end - steering) / STEP


def _cost(states: Float, inputs: Float, wanted: Float) -> float:
    errors = states - wanted
    return float((errors * errors * STATE_COST).sum() + (inputs * inputs * INPUT_COST).sum())


def _backward(states: Float, inputs: Float, wanted: Float, wheelbase: float) -> tuple[Float, Float]:
    """Changes of the inputs [STEPS, 2] and feedback gains [STEPS, 2, 5]."""
    A, B = _linearised(states[:-1], states[1:], wheelbase)
    Q, R = np.diag(STATE_COST), np.diag(INPUT_COST)
    V, v = Q, STATE_COST * (states[-1] - wanted[-1])
    forward, feedback = np.empty((STEPS, 2)), np.empty((STEPS, 2, 5))
    for k in range(STEPS - 1, -1, -1):
        VA, VB = V @ A[k], V @ B[k]
        Hxx, Hux, Huu = Q + A[k].T @ VA, B[k].T @ VA, R + B[k].T @ VB
        hx = STATE_COST * (states[k] - wanted[k]) + A[k].T @ v
        hu = INPUT_COST * inputs[k] + B[k].T @ v
        (p, q), (_, s) = Huu.tolist()
        inverse = np.array([[s, -q], [-q, p]]) / (p * s - q * q)
        forward[k], feedback[k] = -inverse @ hu, -inverse @ Hux
        V = Hxx + Hux.T @ feedback[k]
        V = (V + V.T) / 2
        v = hx + Hux.T @ forward[k]
    return forward, feedback


def _linearised(states: Float, after: Float, wheelbase: float) -> tuple[Float, Float]:
    """Derivatives of the next state by state [STEPS, 5, 5] and by input [STEPS, 5, 2]."""
    speed, steering = (states[:, 3] + after[:, 3]) / 2, (states[:, 4] + after[:, 4]) / 2
    heading = (states[:, 2] + after[:, 2]) / 2
    cos, sin, tan = np.cos(heading), np.sin(heading), np.tan(steering)
    by_steering = speed * STEP * (1 + tan * tan) / wheelbase
    by_speed = STEP * tan / wheelbase
    A = np.tile(np.eye(5), (len(states), 1, 1))
    A[:, 0, 2], A[:, 1, 2] = -speed * STEP * sin, speed * STEP * cos
    A[:, 0, 3] = STEP * cos - speed * STEP * sin * by_speed / 2
    A[:, 1, 3] = STEP * sin + speed * STEP * cos * by_speed / 2
    A[:, 2, 3] = by_speed
    A[:, 0, 4] = -speed * STEP * sin * by_steering / 2
    A[:, 1, 4] = speed * STEP * cos * by_steering / 2
    A[:, 2, 4] = by_steering
    B = np.zeros((len(states), 5, 2))
    # An input acts over the step: on average it has changed speed and angle by half of itself.
    B[:, :3, 0] = A[:, :3, 3] * STEP / 2
    B[:, 3, 0] = STEP
    B[:, :3, 1] = A[:, :3, 4] * STEP / 2
    B[:, 4, 1] = STEP
    return A, B
