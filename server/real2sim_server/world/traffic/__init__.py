"""Other road users: one Protocol, a driver for each way of moving, see :mod:`.drivers`."""

from .driver import AgentDriver, AgentPose, ObservedEgo, Surroundings
from .traffic import DRIVERS, Traffic, begin_driver

__all__ = [
    "DRIVERS",
    "AgentDriver",
    "AgentPose",
    "ObservedEgo",
    "Surroundings",
    "Traffic",
    "begin_driver",
]
