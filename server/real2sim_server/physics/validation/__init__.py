"""Cases with known answers; tests and ``real2sim validate`` run the same ones.

Every case is a function of the backend's name and returns checks: measured, expected, tolerance.
"""

from collections.abc import Callable

from .check import Check
from .contact import (
    braking,
    collinear_cars,
    frictionless_slide,
    incline,
    oblique_impact,
    rest,
    restitution,
)
from .elasticity import bar_on_wall, bulk_modulus, cantilever, hertz, two_balls, vibrating_bar
from .gradients import gradients
from .motion import affine_patch, free_fall, invariants, scale_invariance, spin

CASES: dict[str, Callable[[str], list[Check]]] = {
    case.__name__: case
    for case in (
        free_fall,
        affine_patch,
        spin,
        invariants,
        scale_invariance,
        bulk_modulus,
        vibrating_bar,
        bar_on_wall,
        two_balls,
        hertz,
        cantilever,
        rest,
        incline,
        braking,
        oblique_impact,
        frictionless_slide,
        restitution,
        collinear_cars,
        gradients,
    )
}
"""All cases by name, the cheap ones first."""

__all__ = ["CASES", "Check"]
