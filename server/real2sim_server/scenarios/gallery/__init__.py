"""Ready corner cases: storyboards with parameters, for any scene with a road ahead.

All are relative to where the ego begins and to its lane, so that they fit every scene; speeds are
in m/s. Families and figures follow Euro NCAP's test protocols of 2023 (AEB car-to-car, AEB/LSS
vulnerable road user, lane support), rounded.
"""

# Each module of cases adds its own to the gallery, in this order.
from . import ahead, lanes, oncoming, crossing  # noqa: I001
from .case import GALLERY, CornerCase, corner_case

FAMILIES = tuple(m.__name__.rpartition(".")[2] for m in (ahead, lanes, oncoming, crossing))
"""Kinds of cases."""

__all__ = ["FAMILIES", "GALLERY", "CornerCase", "corner_case"]
