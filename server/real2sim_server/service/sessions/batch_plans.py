"""Actions of many worlds, taken apart: the plan of each as it would be sent alone."""

from __future__ import annotations

import asyncio
from typing import Any, NamedTuple

from pydantic import ValidationError

from real2sim_proto import ErrorCode
from real2sim_proto.drive_batch import BatchAction, ControlPlans, Plans, TrajectoryPlans
from real2sim_proto.episode import ResetSpec
from real2sim_proto.plans import PLAN, Plan

from ...world.recording.replay import plan_payload
from ..http.problems import ServiceError
from .messages import bad_message, validation_summary

FEW_POSES = 256
"""Plans of so many poses in sum are checked on the event loop, within half a millisecond."""

COLUMNS = {"control": ("acceleration", "steering"), "pose": ("x", "y", "yaw")}


class ReadPlan(NamedTuple):
    """A plan of one world.

    Attributes:
        plan: checked.
        payload: its canonical bytes.
    """

    plan: Plan
    payload: bytes


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


async def read_plans(plans: Plans) -> list[ReadPlan | ServiceError]:
    """The plan of each world, or what is wrong with it; of many poses beside the event loop."""
    poses = plans.times_us.size if isinstance(plans, TrajectoryPlans) else len(plans.values)
    if poses <= FEW_POSES:
        return _read_plans(plans)
    return await asyncio.to_thread(_read_plans, plans)


def _read_plans(plans: Plans) -> list[ReadPlan | ServiceError]:
    return [_read_plan(fields) for fields in plan_rows(plans)]


def _read_plan(fields: dict[str, Any]) -> ReadPlan | ServiceError:
    try:
        plan = PLAN.validate_python(fields)
    except ValidationError as error:
        return bad_message(validation_summary(error))
    return ReadPlan(plan, plan_payload(plan))


def steps_of(action: BatchAction) -> list[int]:
    """The step that each world is at, as its client says."""
    found: list[int] = action.steps.tolist()
    return found


def check_for_batch(spec: ResetSpec) -> None:
    """Raises ServiceError: INVALID_REQUEST for an episode that runs on a socket of its own only."""
    outside = (
        ("deadline_ms", spec.deadline_ms is not None),
        ("wall_clock_s", spec.wall_clock_s is not None),
        ("lidars", bool(spec.lidars)),
        ("radars", bool(spec.radars)),
        ("latency.model 'measured'", spec.latency.model == "measured"),
    )
    named = [name for name, given in outside if given]
    if named:
        raise ServiceError(
            ErrorCode.INVALID_REQUEST,
            f"episodes of a batch have no {', '.join(named)}",
            hint="reset without, or drive the session on a socket of its own",
        )
