"""Splat file formats, one module each. To add one: write the module, list it in ``FORMATS``."""

from __future__ import annotations

from .antimatter_splat import AntimatterSplat
from .inria_ply import InriaPly
from .playcanvas_ply import PlayCanvasPly
from .spz import Spz
from .types import SplatFormat, UpAxis

FORMATS: list[SplatFormat] = [PlayCanvasPly(), InriaPly(), Spz(), AntimatterSplat()]
"""In the order in which they are asked whether a file or a name is theirs."""


def register_format(splat_format: SplatFormat) -> None:
    """Add a format from outside of the package; it is asked before those there are.

    Raises:
        ValueError: another format has that name or that suffix.
    """
    for known in FORMATS:
        if splat_format.name == known.name or splat_format.suffix == known.suffix:
            raise ValueError(f"{known.name} ({known.suffix}) is registered already")
    FORMATS.insert(0, splat_format)


def suffixes() -> tuple[str, ...]:
    """Ends of the names of all formats, in the order in which they are compared with a name."""
    return tuple(splat_format.suffix for splat_format in FORMATS)


__all__ = [
    "FORMATS",
    "AntimatterSplat",
    "InriaPly",
    "PlayCanvasPly",
    "SplatFormat",
    "Spz",
    "UpAxis",
    "register_format",
    "suffixes",
]
