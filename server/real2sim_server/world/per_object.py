"""What is worked out once for an object that never changes, found again without its hash.

The hash of a specification is that of all its members, and takes 3 us; a step asks several times.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

S = TypeVar("S")
V = TypeVar("V")

MOST = 512
"""Objects that are remembered; then all are forgotten."""


def per_object(fn: Callable[[S], V]) -> Callable[[S], V]:
    """``fn``, called once for an object as long as that is remembered."""
    known: dict[int, tuple[S, V]] = {}

    def remembered(subject: S) -> V:
        found = known.get(id(subject))
        # An object that is remembered is kept alive, so that its id is nobody else's.
        if found is not None and found[0] is subject:
            return found[1]
        value = fn(subject)
        if len(known) >= MOST:
            known.clear()
        known[id(subject)] = (subject, value)
        return value

    remembered.__doc__ = fn.__doc__
    return remembered
