"""The spec of an episode as a log holds it, also one that an earlier version has written."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from real2sim_proto.episode import ResetSpec
from real2sim_proto.storyboard import stored_storyboard

BEFORE: Mapping[str, Any] = {
    "ego": {
        "actuators": {"steering_lag": 0.0, "drive_lag": 0.0, "foreseen": False},
        "suspension": None,
        "max_reverse_speed": 0.0,
        "tracker_version": 1,
    },
    "contact": {
        "swept": False,
        "pulse": False,
        "residual_crush": False,
        "distributed": False,
        "progressive": False,
        "breakage": False,
        "weighed_by_height": False,
    },
}
"""How episodes ran before members had their present defaults, or before there were such members.

Logs hold specs in full, so a member that is absent is one that its writer did not know. Whoever
adds a member whose default changes an episode names here what keeps its bits.
"""


def stored_spec(fields: Mapping[str, Any]) -> ResetSpec:
    """The spec of a log, with the meaning that it had when it was written.

    Raises:
        ValueError: it is no spec.
    """
    completed = _completed(fields, BEFORE)
    if isinstance(board := completed.get("storyboard"), Mapping):
        completed["storyboard"] = stored_storyboard(board)
    spec = ResetSpec.model_validate(completed)
    if fields.get("horizon") is None:
        # To the end of the log, also where the episode could have gone on.
        return spec.model_copy(update={"horizon": None})
    return spec


def _completed(fields: Mapping[str, Any], absent: Mapping[str, Any]) -> dict[str, Any]:
    """``fields`` with members of ``absent`` where it has none."""
    found = dict(fields)
    for name, value in absent.items():
        if isinstance(value, Mapping):
            inner = found.get(name, {})
            if isinstance(inner, Mapping):
                found[name] = _completed(inner, value)
        else:
            found.setdefault(name, value)
    return found
