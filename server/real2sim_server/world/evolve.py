"""The next version of a record whose members never change."""

from __future__ import annotations

from typing import Any, TypeVar

R = TypeVar("R")


def evolved(record: R, **changes: Any) -> R:
    """``dataclasses.replace`` for records that check nothing when they are made, and
    ``copy.copy`` of one without changes: a third of their time, which counts where every step makes
    several."""
    found = object.__new__(type(record))
    found.__dict__.update(record.__dict__, **changes)
    return found
