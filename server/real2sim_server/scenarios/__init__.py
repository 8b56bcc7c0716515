"""Scenarios: OpenSCENARIO files, and a gallery of corner cases."""


class ScenarioError(ValueError):
    """An invalid scenario file, or one with unsupported features.

    The message names the file, the line, and a fix.
    """
