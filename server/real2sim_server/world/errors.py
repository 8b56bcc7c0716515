"""Errors of the world package."""

from __future__ import annotations

from real2sim_proto import ErrorCode


class WorldError(ValueError):
    """An episode that cannot run as asked, or an action it refuses; the world is as before.

    Attributes:
        code: TIME_OUT_OF_RANGE, UNKNOWN_CAMERA or INVALID_REQUEST of a reset; INVALID_ACTION or
            EPISODE_OVER of a step.
        hint: what to do next, or None.
    """

    def __init__(self, code: ErrorCode, message: str, *, hint: str | None = None) -> None:
        super().__init__(message)
        self.code = code
        self.hint = hint
