"""Other road users: one Protocol, a driver for each way of moving."""

from .driver import AgentDriver, AgentPose, ObservedEgo, Surroundings
from .traffic import Traffic, begin_driver

__all__ = ["AgentDriver", "AgentPose", "ObservedEgo", "Surroundings", "Traffic", "begin_driver"]
