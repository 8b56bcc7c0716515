"""Validation cases with known answers, for tests and ``real2sim validate``.

Every case is a function of the backend name and returns checks: measured, expected, tolerance.
"""

from collections.abc import Callable

from .check import Check, ReferenceCurve
from .elasticity import (
    bar_on_wall,
    cantilever,
    confined_compression,
    hertz,
    loaded_beam,
    stiff_discs,
    two_discs,
    vibrating_bar,
)
from .motion import (
    affine_patch,
    braking,
    collinear_bars,
    free_fall,
    frictionless_slide,
    gradients,
    incline,
    invariants,
    oblique_impact,
    reproducibility,
    rest,
    restitution,
    rolling_ball,
    scale_invariance,
    spin,
)

Case = Callable[[str], list[Check]]
"""Function of a backend's name."""
CASES: dict[str, Case] = {
    case.__name__: case
    for case in (
        free_fall,
        affine_patch,
        spin,
        invariants,
        scale_invariance,
        reproducibility,
        vibrating_bar,
        bar_on_wall,
        confined_compression,
        two_discs,
        stiff_discs,
        hertz,
        cantilever,
        loaded_beam,
        rest,
        incline,
        braking,
        oblique_impact,
        rolling_ball,
        frictionless_slide,
        restitution,
        collinear_bars,
        gradients,
    )
}
"""All cases by name, fastest first."""

__all__ = ["CASES", "Case", "Check", "ReferenceCurve"]
