"""OpenSCENARIO XML, import and export.

``read`` turns a file with its catalogs into a storyboard, by ``read_actions``, ``read_conditions``
and ``read_positions``; ``elements`` rejects everything that none of them has read.
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
