"""What cannot be exported."""

from __future__ import annotations


class DatasetError(ValueError):
    """An export that cannot be made; the message says what was given and what is allowed."""
