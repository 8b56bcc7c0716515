"""Other road users: one Protocol, a driver for each way of moving."""

from .driver import AgentDriver, AgentPose, EgoSeen, Surroundings
from .traffic import Traffic, begin_driver

__all__ = ["AgentDriver", "AgentPose", "EgoSeen", "Surroundings", "Traffic", "begin_driver"]
