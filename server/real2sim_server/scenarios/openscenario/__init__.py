"""OpenSCENARIO XML, import and export.

``read`` converts a file with its catalogs into a storyboard, with the readers in ``parts``.
``elements`` rejects all elements that were not read.
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
