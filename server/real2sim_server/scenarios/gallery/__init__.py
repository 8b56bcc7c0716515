"""Ready corner cases: storyboards with parameters, for any scene with a road ahead.

All are relative to the ego's start and its lane, so that they fit every scene; speeds are in m/s.
Families and figures follow Euro NCAP's test protocols of 2023 (AEB car-to-car, AEB/LSS vulnerable
road user, lane support), rounded.
"""

from . import cases as cases  # registers all cases
from .case import GALLERY, CornerCase, corner_case, shipped_picture

__all__ = ["GALLERY", "CornerCase", "corner_case", "shipped_picture"]
