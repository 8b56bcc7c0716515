"""One failure as it is reported."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ...world.recording.recording import Recording
from .evaluation import Evaluation
from .scenario_file import WrittenScenario
from .shrink import Boundary


@dataclass(frozen=True, eq=False)
class Failure:
    """An avoidable collision that was the planner's fault.

    Attributes:
        name: of its files.
        found: the evaluation.
        recording: of the planner's episode.
        replays: whether the recording comes out the same, bit for bit.
        avoidable_until: seconds before the impact from which on the reference, taking over from the
            planner, still avoids it; None where it cannot, or plans are not trajectories.
        boundaries: nearest first.
        film: file, or None.
        scenario: its file; None where the case is no storyboard.
    """

    name: str
    found: Evaluation
    recording: Recording
    replays: bool
    avoidable_until: float | None
    boundaries: Sequence[Boundary]
    film: str | None
    scenario: WrittenScenario | None = None

    def fields(self) -> dict[str, Any]:
        """For JSON."""
        found = self.found
        return {
            "name": self.name,
            "cell": list(found.cell or ()),
            "values": dict(found.values),
            "reset": dict(found.drive.reset),
            "operations": [dict(o) for o in found.drive.operations],
            "score": found.score,
            "criticality": found.criticality,
            "implausibility": found.implausibility,
            "impact": dict(found.impact),
            "avoidable_until": self.avoidable_until,
            "boundaries": [dataclasses.asdict(b) for b in self.boundaries],
            "case": f"cases/{self.name}.json",
            "recording": f"recordings/{self.name}.r2e",
            "replays": self.replays,
            "film": self.film,
            "scenario": dataclasses.asdict(self.scenario) if self.scenario else None,
        }
