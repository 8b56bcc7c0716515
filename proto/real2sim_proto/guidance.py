"""Errors for names that are not there, which say what to write instead."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

MOST_SHOWN = 24


class Guided:
    """Base of the objects users hold: the error for an unknown attribute says what to write.

    Subclasses list in ``_instead`` what people try first, and what does it here.
    """

    _instead: ClassVar[Mapping[str, str]] = {}

    # Hidden from type checkers, which would take every attribute for one that is there.
    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            kind = type(self).__name__
            # Libraries probe private names to see what an object can do; nobody reads the error.
            if name.startswith("_"):
                raise AttributeError(f"{kind!r} object has no attribute {name!r}")
            said = advice(name, attributes(self), instead_of(type(self)))
            raise AttributeError(f"{kind} has no {name!r}; {said}")


def instead_of(kind: type) -> Mapping[str, str]:
    """What a class and its bases say to write instead of names that they do not have."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        found |= vars(base).get("_instead", {})
    return found


def attributes(thing: object) -> list[str]:
    """Public names of an object; of a message those of its members alone."""
    members = getattr(type(thing), "model_fields", None)
    return [name for name in members or dir(thing) if not name.startswith("_")]


def advice(
    name: str,
    there: Iterable[str],
    instead: Mapping[str, str] | None = None,
    *,
    otherwise: str = "there are",
) -> str:
    """What to write instead of a name: what is known for it, else what is alike, else all."""
    if instead and name in instead:
        return f"write {instead[name]}"
    if close := difflib.get_close_matches(name, there := list(there), n=2):
        return f"did you mean {' or '.join(close)}?"
    shown = there if len(there) <= MOST_SHOWN else [*there[:MOST_SHOWN], "..."]
    return f"{otherwise} {', '.join(shown) or 'none'}"
