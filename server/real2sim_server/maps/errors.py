"""What goes wrong with maps."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class MapError(ValueError):
    """A map that cannot be read or does not fit; the message names the file, what is wrong and
    what is expected."""


@contextmanager
def damage_named(where: str) -> Iterator[None]:
    """Any error of the block as one of a damaged map, as far as a reader did not say it better.

    Raises:
        MapError: with ``where`` and the error.
    """
    try:
        yield
    except MapError:
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {str(error)[:300]}"
        raise MapError(f"{where}: is damaged, or not as its format asks ({reason})") from error
