"""How values go over from one to another: forms of transitions, their integrals and durations."""

from __future__ import annotations

import math

from real2sim_proto.storyboard_actions import Dynamics, Shape

STEEPEST = {"linear": 1.0, "cubic": 1.5, "sinusoidal": math.pi / 2, "quintic": 1.875}
"""Highest slope of each form f(u), u from 0 to 1."""

CURVIEST = {"cubic": 6.0, "sinusoidal": math.pi**2 / 2, "quintic": 10.0 / math.sqrt(3.0)}
"""Highest second derivative of each form; a linear one has none that is finite."""


def progress(shape: Shape, u: float) -> float:
    """f(u): 0 to 1 while u goes from 0 to 1, see :class:`Dynamics`."""
    if shape == "step" or u >= 1.0:
        return 1.0
    u = max(u, 0.0)
    if shape == "linear":
        return u
    if shape == "cubic":
        return u * u * (3.0 - 2.0 * u)
    if shape == "sinusoidal":
        return (1.0 - math.cos(math.pi * u)) / 2.0
    return u * u * u * (10.0 - 15.0 * u + 6.0 * u * u)


def integral(shape: Shape, u: float) -> float:
    """F(u), the integral of f from 0 to u; beyond 1 that of the constant 1."""
    if shape == "step":
        return u
    if u >= 1.0:
        return 0.5 + (u - 1.0)
    u = max(u, 0.0)
    if shape == "linear":
        return u * u / 2.0
    if shape == "cubic":
        return u**3 - u**4 / 2.0
    if shape == "sinusoidal":
        return u / 2.0 - math.sin(math.pi * u) / (2.0 * math.pi)
    return 2.5 * u**4 - 3.0 * u**5 + u**6


def duration(dynamics: Dynamics, change: float) -> float:
    """How long a change takes by time or rate [s]; 0 at once. Not for the dimension 'distance'."""
    value = float(dynamics.value)
    if dynamics.shape == "step" or change == 0.0:
        return 0.0
    if dynamics.dimension == "time":
        return value
    return STEEPEST[dynamics.shape] * abs(change) / value if value > 0 else 0.0


def gentle_duration(shape: Shape, change: float, acceleration: float | None) -> float:
    """How long a change takes whose second derivative is not to be higher [s]; 0 at once."""
    if shape == "step" or acceleration is None or change == 0.0:
        return 0.0
    return math.sqrt(CURVIEST[shape] * abs(change) / max(acceleration, 1e-6))
