"""Splat file formats, one module each. To add one: write the module, list it in ``FORMATS``."""

from __future__ import annotations

from .antimatter_splat import AntimatterSplat
from .inria_ply import InriaPly
from .playcanvas_ply import PlayCanvasPly
from .spz import Spz
from .types import SplatFormat

FORMATS: tuple[SplatFormat, ...] = (PlayCanvasPly(), InriaPly(), Spz(), AntimatterSplat())
"""In the order in which they are asked whether a file or a name is theirs."""

__all__ = ["FORMATS", "AntimatterSplat", "InriaPly", "PlayCanvasPly", "SplatFormat", "Spz"]
