"""The closed loop: the only room in which time passes."""

from .agents import Agents, agent_fields
from .ego import Motion
from .errors import WorldError
from .events import Event
from .ground import LoggedGround
from .observation import Observation
from .path import LoggedPath
from .world import METRICS, Plan, World

__all__ = [
    "METRICS",
    "Agents",
    "Event",
    "LoggedGround",
    "LoggedPath",
    "Motion",
    "Observation",
    "Plan",
    "World",
    "WorldError",
    "agent_fields",
]
