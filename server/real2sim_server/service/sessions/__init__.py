"""Closed-loop sessions: the same world by plain requests and by the drive socket."""

from .registry import SessionLimits, Sessions
from .session import Session

__all__ = ["Session", "SessionLimits", "Sessions"]
