"""Options of what follows from the directions in which training images show Gaussians."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DirectionOptions:
    """What becomes of objects where training images look from one side alone.

    Attributes:
        lobe_prior: variance of the directions at which objects keep half of a colour that depends
            on the direction; 0 leaves colours as they were learnt.
        paint: whether sides of vehicles that images show only edge on have the colours of
            initialisation from ahead; what images show of them stays.
        sides: whether sides of vehicles that images show only edge on are taken from
            initialisation: right for edits, but recorded views lose by it.
        close: whether vehicles that images show from one direction alone become closed bodies:
            what was learnt is laid on the body's surface, the body stands behind it.
        views: that are asked.
    """

    lobe_prior: float = 0.03
    paint: bool = True
    sides: bool = False
    close: bool = True
    views: int = 32
