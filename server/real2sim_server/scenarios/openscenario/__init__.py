"""OpenSCENARIO XML, in and out.

``read`` turns a file with its catalogs into a storyboard, by ``read_actions``, ``read_conditions``
and ``read_positions``; ``elements`` refuses what none of them has asked for.
"""

from .read import ReadOptions, ScenarioFile, read_openscenario, read_openscenario_text
from .write import write_openscenario

__all__ = [
    "ReadOptions",
    "ScenarioFile",
    "read_openscenario",
    "read_openscenario_text",
    "write_openscenario",
]
