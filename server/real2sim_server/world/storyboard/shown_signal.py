"""What a traffic signal shows."""

from __future__ import annotations

from typing import NamedTuple


class ShownSignal(NamedTuple):
    """A traffic signal at one instant.

    Attributes:
        signal_id: of it.
        state: what it shows.
        stop_line: x, y [m], heading [rad] where vehicles are to stop, world; None: not known.
    """

    signal_id: str
    state: str
    stop_line: tuple[float, float, float] | None
