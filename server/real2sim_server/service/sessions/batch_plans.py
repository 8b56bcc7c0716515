"""Actions of many worlds, taken apart: the plan of each as it would be sent alone."""

from __future__ import annotations

from typing import Any

from pydantic import ValidationError

from real2sim_proto import ErrorCode
from real2sim_proto.drive_batch import BatchAction, ControlPlans, Plans, TrajectoryPlans
from real2sim_proto.episode import ResetSpec
from real2sim_proto.plans import PLAN, Plan

from ..http.problems import ServiceError
from .messages import bad_message, validation_summary

COLUMNS = {"control": ("acceleration", "steering"), "pose": ("x", "y", "yaw")}


def numbers_of(worlds: list[int] | None, rows: int | None, members: int) -> list[int]:
    """Numbers of the worlds that a message is about; all, where it names none.

    Args:
        worlds: as named.
        rows: of its arrays; None where it has none.
        members: worlds of the batch.

    Raises:
        ServiceError: BAD_MESSAGE.
    """
    found = list(range(members)) if worlds is None else worlds
    if len(set(found)) < len(found) or max(found) >= members:
        raise bad_message(f"worlds are {found}; each of 0 to {members - 1} may be named once")
    if rows is not None and rows != len(found):
        raise bad_message(f"{rows} rows for {len(found)} worlds")
    return found


def plan_rows(plans: Plans) -> list[dict[str, Any]]:
    """The fields of each world's plan, not checked yet."""
    if isinstance(plans, TrajectoryPlans):
        given = zip(plans.times_us.tolist(), plans.poses.tolist(), strict=True)
        return [
            {"kind": plans.kind, "times_us": times_us, "poses": poses, "frame": plans.frame}
            for times_us, poses in given
        ]
    names = COLUMNS[plans.kind]
    rows: list[dict[str, Any]] = [
        {"kind": plans.kind, **dict(zip(names, values, strict=True))}
        for values in plans.values.tolist()
    ]
    if isinstance(plans, ControlPlans) and plans.reverse is not None:
        for row, reverse in zip(rows, plans.reverse.tolist(), strict=True):
            row["gear"] = "reverse" if reverse else "drive"
    return rows


def checked_plan(fields: dict[str, Any]) -> Plan:
    """The plan of one world. Raises ServiceError: BAD_MESSAGE."""
    try:
        return PLAN.validate_python(fields)
    except ValidationError as error:
        raise bad_message(validation_summary(error)) from error


def steps_of(action: BatchAction) -> list[int]:
    """The step that each world is at, as its client says."""
    found: list[int] = action.steps.tolist()
    return found


def check_for_batch(spec: ResetSpec) -> None:
    """Raises ServiceError: INVALID_REQUEST for an episode that runs on a socket of its own only."""
    outside = {
        "sensors": bool(spec.sensors),
        "deadline_ms": spec.deadline_ms is not None,
        "wall_clock_s": spec.wall_clock_s is not None,
        "latency.model 'measured'": spec.latency.model == "measured",
    }
    named = [name for name, given in outside.items() if given]
    if named:
        raise ServiceError(
            ErrorCode.INVALID_REQUEST,
            f"episodes of a batch have no {', '.join(named)}",
            hint="reset without, or drive the session on a socket of its own",
        )
