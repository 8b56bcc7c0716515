"""Controllers that make the vehicle follow a planned trajectory."""

from __future__ import annotations

from typing import Protocol

from real2sim_proto.episode import EgoSpec

from ..actuators import Command
from ..ego import Motion
from ..reference import Reference
from .ilqr import Ilqr
from .lqr import Lqr
from .perfect import Perfect
from .pursuit import Pursuit

__all__ = ["Ilqr", "Lqr", "Perfect", "Pursuit", "Tracker", "make_tracker"]


class Tracker(Protocol):
    """Follows a reference; knows nothing of the past, so that a copied world goes on alike."""

    @property
    def reference(self) -> Reference:
        """What is followed."""

    def advance(self, motion: Motion, since: float, dt_us: int) -> Motion:
        """The vehicle ``dt_us`` later.

        Args:
            motion: now.
            since: time since the reference began [s].
            dt_us: how far to go [us].
        """

    def command(self, motion: Motion, t: float) -> Command:
        """What to do in a motion, ``t`` seconds after the reference began."""


def make_tracker(reference: Reference, spec: EgoSpec) -> Tracker:
    """The tracker that the spec names."""
    match spec.tracker:
        case "pursuit":
            return Pursuit(reference, spec)
        case "lqr":
            return Lqr(reference, spec)
        case "ilqr":
            return Ilqr(reference, spec)
        case "perfect":
            return Perfect(reference, spec)
