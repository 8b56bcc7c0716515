"""The closed-loop simulation: the only package that advances time."""

from .agents import Agents, Event, agent_fields
from .common import WorldError
from .controller import Plan, plan_in_world
from .ego_motion import Motion
from .observation import Observation, ego_fields
from .path import LoggedPath
from .scoring import Score, metrics_version
from .warm_up import (
    deformation_on_disk,
    kernels_on_disk,
    may_deform,
    planning_on_disk,
    plans_ahead,
    warm_up,
    warm_up_deformation,
    warm_up_planning,
)
from .world import World

__all__ = [
    "Agents",
    "Event",
    "LoggedPath",
    "Motion",
    "Observation",
    "Plan",
    "Score",
    "World",
    "WorldError",
    "agent_fields",
    "deformation_on_disk",
    "ego_fields",
    "kernels_on_disk",
    "may_deform",
    "metrics_version",
    "plan_in_world",
    "planning_on_disk",
    "plans_ahead",
    "warm_up",
    "warm_up_deformation",
    "warm_up_planning",
]
