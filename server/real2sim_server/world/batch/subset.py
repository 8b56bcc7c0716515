"""Which episodes can be stepped in batches."""

from __future__ import annotations

from real2sim_proto import ErrorCode
from real2sim_proto.episode import AgentsSpec, ResetSpec

from ..common import WorldError
from ..driving import KINDS, PLANNING_AHEAD

TRACKERS = tuple(name for name, kind in KINDS.items() if kind not in PLANNING_AHEAD)
FREE = frozenset({"seed", "start_us", "dt_us", "horizon", "sensors", "privileged", "scoring"})
"""Fields of a reset that may be anything; cameras are drawn by who steps the batch."""
CHECKED = frozenset({"ego", "action", "agents", "contact"})
"""Fields of which only a part is known here."""


def check_batchable(spec: ResetSpec) -> None:
    """Refuse what batches do not know.

    Raises:
        WorldError: INVALID_REQUEST, naming every option that is outside and what is allowed.
    """
    outside = [
        f"{name}={getattr(spec, name)!r}"
        for name, field in type(spec).model_fields.items()
        if name not in FREE | CHECKED
        and getattr(spec, name) != field.get_default(call_default_factory=True)
    ]
    allowed = {
        "action": spec.action in {"control", "trajectory"},
        "ego.tracker": spec.action == "control" or spec.ego.tracker in TRACKERS,
        "ego.actuators.*_delay_us": not (
            spec.ego.actuators.steering_delay_us or spec.ego.actuators.drive_delay_us
        ),
        "agents.default": spec.agents.default in {"log", "idm"},
        "agents (but default)": spec.agents == AgentsSpec(default=spec.agents.default),
        "contact.background": not spec.contact.background,
        "contact.swept": spec.contact.swept,
    }
    outside += [name for name, fine in allowed.items() if not fine]
    if outside:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"worlds in batches do not know {', '.join(outside)}",
            hint="they know actions 'control' and 'trajectory' by the trackers "
            f"{', '.join(TRACKERS)}, commands without delay, objects that repeat the log or drive "
            "by IDM, and episodes that end at the first contact with an object; take single "
            "worlds for the rest",
        )
