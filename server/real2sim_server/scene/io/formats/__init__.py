"""Splat file formats, one module each. To add one: write the module, list it in ``FORMATS``."""

from __future__ import annotations

from .inria_ply import InriaPly
from .playcanvas_ply import PlayCanvasPly
from .types import SplatFormat

FORMATS: tuple[SplatFormat, ...] = (PlayCanvasPly(), InriaPly())
"""In the order in which they are asked whether a file is theirs."""

__all__ = ["FORMATS", "InriaPly", "PlayCanvasPly", "SplatFormat"]
