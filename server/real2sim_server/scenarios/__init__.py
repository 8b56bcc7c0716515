"""Scenarios as people write them: OpenSCENARIO files, and a gallery of corner cases."""


class ScenarioError(ValueError):
    """A file that is no scenario, or asks for something unsupported.

    The message names the file, the line, and what to do.
    """
