"""Closed-loop sessions: the same world over REST and the drive socket."""

from .registry import SessionLimits, Sessions
from .session import Session

__all__ = ["Session", "SessionLimits", "Sessions"]
