"""``real2sim bench soak``."""

from __future__ import annotations

from pathlib import Path

from ..benchmarks import soak
from ..console import write_json


class SoakFailedError(RuntimeError):
    """The worker did not do what it should, or its memory grew."""


def run(*, sessions: int, minutes: float, rate: float, json_path: Path | None) -> None:
    """Soak a worker over loopback and write the figures.

    Raises:
        SoakFailedError: something was not answered as the protocol says, or memory grew.
    """
    figures = soak.run(soak.Effort(sessions=sessions, minutes=minutes, rate_hz=rate))
    write_json(json_path, figures)
    if figures["failures"]:
        raise SoakFailedError(f"{len(figures['failures'])} planners were let down; see above")
    if figures["grows"]:
        raise SoakFailedError("the worker's memory grew; see above")
