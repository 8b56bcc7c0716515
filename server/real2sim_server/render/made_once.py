"""What is made of an immutable object once and kept as long as the object lives."""

from __future__ import annotations

import functools
import weakref
from collections.abc import Callable
from typing import TypeVar

Source = TypeVar("Source")
Made = TypeVar("Made")


def made_once(make: Callable[[Source], Made]) -> Callable[[Source], Made]:
    """``make``, which is called only for what it was not called for before."""
    kept: weakref.WeakKeyDictionary[Source, Made] = weakref.WeakKeyDictionary()

    @functools.wraps(make)
    def get(source: Source) -> Made:
        found = kept.get(source)
        if found is None:
            found = kept[source] = make(source)
        return found

    return get
