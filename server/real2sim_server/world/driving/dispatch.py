"""Compiled functions chosen by number."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ..._numba import func


def choice(functions: Sequence[Any]) -> Any:
    """The compiled function ``call(number, *args)``, which calls that one of ``functions``.

    All take the same arguments and return the same types. The number is compared one by one, which
    costs nothing measurable for a handful of them and lets the compiler see into all of them.
    """
    first, *rest = functions
    if not rest:

        @func
        def last(_number, *args):  # type: ignore[no-untyped-def]
            return first(*args)

        return last
    others = choice(rest)

    @func
    def chosen(number, *args):  # type: ignore[no-untyped-def]
        if number == 0:
            return first(*args)
        return others(number - 1, *args)

    return chosen
