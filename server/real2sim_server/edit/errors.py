"""Errors of the edit package."""

from __future__ import annotations

from real2sim_proto import ErrorCode


class EditError(ValueError):
    """An edit, undo or redo that cannot be done; the state is as before.

    Attributes:
        code: UNKNOWN_OBJECT, INVALID_OPERATION, STALE_REVISION, NOTHING_TO_UNDO or
            NOTHING_TO_REDO.
        hint: what to do next, or None.
        index: place of the refused operation in its batch, or None.
    """

    def __init__(
        self, code: ErrorCode, message: str, *, hint: str | None = None, index: int | None = None
    ) -> None:
        super().__init__(message)
        self.code = code
        self.hint = hint
        self.index = index
