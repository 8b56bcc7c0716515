"""Which of several drives in a folder is meant."""

from __future__ import annotations

from pathlib import Path

from ..driving_log import LogError

SHOWN = 20


def select_sequence(folder: Path, known: list[str], sequence: str | None) -> str:
    """``sequence``, or the only one that is known.

    Raises:
        LogError: there is none, ``sequence`` is not among them, or it must be named.
    """
    if not known:
        raise LogError(f"{folder}: holds no sequence")
    if sequence is None and len(known) == 1:
        return known[0]
    if sequence is None or sequence not in known:
        asked = "name one with sequence" if sequence is None else f"there is no {sequence!r}"
        more = f" and {len(known) - SHOWN} more" if len(known) > SHOWN else ""
        raise LogError(f"{folder}: holds the sequences {known[:SHOWN]}{more}; {asked}")
    return sequence
