"""Plans: a planner's answers to observations."""

from __future__ import annotations

import operator
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, TypeAdapter, model_validator

from .base import Metres, Microseconds, Model

MAX_PLAN_POSES = 1024


def _as_lists(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


PlanTimes = Annotated[
    list[Microseconds], Field(min_length=1, max_length=MAX_PLAN_POSES), BeforeValidator(_as_lists)
]
PlanPose = tuple[Metres, Metres, Annotated[float, Field(ge=-1e4, le=1e4)]]
PlanPoses = Annotated[
    list[PlanPose], Field(min_length=1, max_length=MAX_PLAN_POSES), BeforeValidator(_as_lists)
]


def check_times(times_us: list[int], poses: int) -> None:
    """Raise ValueError unless each pose has a time and the times increase."""
    if len(times_us) != poses:
        raise ValueError(f"{len(times_us)} times for {poses} poses")
    if any(map(operator.ge, times_us, times_us[1:])):
        raise ValueError("times_us must increase strictly")


class TrajectoryPlan(Model):
    """Target poses of the vehicle, tracked by the worker's controller until the next plan.

    Poses are (x, y, yaw) at ``times_us``, which increase and are later than the observation.
    """

    kind: Literal["trajectory"] = "trajectory"
    times_us: PlanTimes = Field(description="[N] int64 absolute simulation time")
    poses: PlanPoses = Field(description="[N, 3] x [m], y [m], yaw [rad]")
    frame: Literal["vehicle", "world"] = Field(
        default="vehicle",
        description="'vehicle': the ego frame of the observation that the plan answers",
    )

    @model_validator(mode="after")
    def _times_increase(self) -> TrajectoryPlan:
        check_times(self.times_us, len(self.poses))
        return self


Gear = Literal["drive", "reverse"]


class Control(Model):
    """Direct actuation for one step."""

    kind: Literal["control"] = "control"
    acceleration: Annotated[float, Field(ge=-100, le=100)] = Field(
        description=(
            "acceleration in the direction of the gear; negative values brake, at most to a "
            "stop [m/s^2]"
        )
    )
    steering: Annotated[float, Field(ge=-1.6, le=1.6)] = Field(
        description="road-wheel angle [rad], positive to the left in either gear"
    )
    gear: Gear = Field(
        default="drive",
        description=(
            "gear, engaged at rest; a vehicle still rolling the other way brakes by the "
            "magnitude of `acceleration`"
        ),
    )


class PoseCommand(Model):
    """Sets the vehicle's pose at the next step, regardless of its dynamics; on the ground."""

    kind: Literal["pose"] = "pose"
    x: Metres = Field(description="world [m]")
    y: Metres
    yaw: Annotated[float, Field(ge=-1e4, le=1e4)]


Plan = Annotated[TrajectoryPlan | Control | PoseCommand, Field(discriminator="kind")]
PLAN: TypeAdapter[Plan] = TypeAdapter(Plan)
