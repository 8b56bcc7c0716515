"""The closed loop: the only package in which time passes."""

from .agents import Agents, agent_fields
from .ego.controller import Plan
from .ego.motion import Motion
from .errors import WorldError
from .events import Event
from .observation import Observation, ego_fields
from .path import LoggedPath
from .scoring import Score, metrics_version
from .warm_up import (
    kernels_on_disk,
    planning_on_disk,
    plans_ahead,
    warm_up,
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
    "ego_fields",
    "kernels_on_disk",
    "metrics_version",
    "planning_on_disk",
    "plans_ahead",
    "warm_up",
    "warm_up_planning",
]
