"""Pictures of the corner cases, which ``python -m real2sim_server.scenarios.picture`` has made."""

from pathlib import Path

from ..case import corner_case

FOLDER = Path(__file__).parent


def shipped(name: str) -> bytes:
    """The picture of a case, an SVG document.

    Raises:
        ValueError: the gallery has no such case.
    """
    return (FOLDER / f"{corner_case(name).name}.svg").read_bytes()
