"""What can be wrong with a scenario file."""

from __future__ import annotations


class ScenarioError(ValueError):
    """A file that is no scenario, or asks for what is not supported; the message names the file,
    the line, and what to do."""
