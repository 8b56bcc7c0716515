"""Other road users: one Protocol, a driver for each way of moving, see :mod:`.drivers`."""

from .driver import AgentDriver, AgentPose, ObservedEgo, Surroundings
from .drivers import DRIVERS, begin_driver
from .traffic import Traffic

__all__ = [
    "DRIVERS",
    "AgentDriver",
    "AgentPose",
    "ObservedEgo",
    "Surroundings",
    "Traffic",
    "begin_driver",
]
