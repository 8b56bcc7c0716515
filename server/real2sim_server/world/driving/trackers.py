"""The family of compiled trackers: what ``EgoSpec.tracker`` names, but ``perfect``.

A tracker is two compiled functions, see :class:`Tracker`; a new one is a module with these and a
line of :data:`TRACKERS`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ..._numba import func
from . import ilqr
from .dispatch import choice
from .lqr import regulate
from .pursuit import pursue


class Tracker(NamedTuple):
    """Makes the vehicle follow a plan; both are made by :func:`real2sim_server._numba.func`.

    Attributes:
        command: ``command(state, curve, t, vehicle, schedule)``, the :class:`.state.Command` of a
            substep, ``t`` seconds after the plan began; ``schedule`` is what was prepared (it may
            be empty) and the seconds since then. State and time are those at which the command
            reaches the wheels; lags that it has to allow for are ``vehicle.known_steering_lag``
            and ``vehicle.known_drive_lag``.
        prepare: ``prepare(state, curve, since, vehicle)``, once a clock step, ``since`` seconds
            after the plan began: a schedule, two float64 arrays of two dimensions. None for
            trackers that do not plan ahead.
    """

    command: Any
    prepare: Any = None


@func
def _no_schedule(_state, _curve, _since, _vehicle):  # type: ignore[no-untyped-def]
    return np.empty((0, 0)), np.empty((0, 0))


TRACKERS: Mapping[str, Tracker] = {
    "pursuit": Tracker(pursue),
    "lqr": Tracker(regulate),
    "ilqr": Tracker(ilqr.follow_schedule, ilqr.prepare),
}
"""By the name of ``EgoSpec.tracker``."""

HOLD = 0
"""Kind of the law that holds one command."""

KINDS: Mapping[str, int] = {name: k for k, name in enumerate(TRACKERS, start=1)}
"""Number of each tracker for compiled code."""

PURSUIT, LQR, ILQR = KINDS["pursuit"], KINDS["lqr"], KINDS["ilqr"]

PLANNING_AHEAD = frozenset(KINDS[name] for name, tracker in TRACKERS.items() if tracker.prepare)
"""Kinds of trackers with a schedule."""

tracker_command = choice([tracker.command for tracker in TRACKERS.values()])
tracker_schedule = choice([tracker.prepare or _no_schedule for tracker in TRACKERS.values()])
