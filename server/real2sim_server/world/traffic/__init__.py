"""Other road users and their drivers, which implement one Protocol (:mod:`.driver`)."""

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
