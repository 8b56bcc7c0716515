"""Scores of many episodes: mean and standard deviation of each, by planner and case."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..world.recording.recording import load_recording
from ..world.scoring import METRICS, metric_versions
from .episodes import EpisodeResult


@dataclass(frozen=True)
class ScoreStatistics:
    """Mean over ``count`` episodes, and standard deviation (of the population) over several."""

    mean: float
    deviation: float | None
    count: int

    @classmethod
    def of(cls, values: Sequence[float]) -> ScoreStatistics | None:
        """Of some values; None without any."""
        if not values:
            return None
        deviation = statistics.pstdev(values) if len(values) > 1 else None
        return cls(statistics.fmean(values), deviation, len(values))


@dataclass(frozen=True)
class ScoreGroup:
    """Episodes of one planner: of one case, or of all where ``case`` is None.

    Attributes:
        scores: by name; None where it is undefined in every episode, or where a planner failed in
            any: a mean over what is left would flatter it.
        collisions, at_fault: summed.
        reasons: of ending, counted.
        failed: episodes in which the planner raised or sent what no vehicle can do.
    """

    policy: str
    case: str | None
    episodes: int
    scores: dict[str, ScoreStatistics | None]
    collisions: int
    at_fault: int
    reasons: dict[str, int]
    failed: int

    @classmethod
    def of(cls, policy: str, case: str | None, results: Sequence[EpisodeResult]) -> ScoreGroup:
        """Of at least one episode."""
        failed = sum(one.error is not None for one in results)
        found = [one.scores() for one in results]
        scores: dict[str, ScoreStatistics | None] = {}
        for name in METRICS:
            values = [s[name]["value"] for s in found if name in s]
            defined = [v for v in values if v is not None]
            scores[name] = None if failed else ScoreStatistics.of(defined)
        return cls(
            policy=policy,
            case=case,
            episodes=len(results),
            scores=scores,
            collisions=sum(one.figures["collisions"] for one in results),
            at_fault=sum(one.figures["at_fault"] for one in results),
            reasons=dict(Counter(one.reason for one in results)),
            failed=failed,
        )


def group_scores(results: Sequence[EpisodeResult]) -> list[ScoreGroup]:
    """Every planner over all cases, then every planner in every case; in their order."""
    policies, cases = _unique(d.policy for d in results), _unique(d.case for d in results)
    groups = []
    for case in (None, *cases):
        for policy in policies:
            mine = [d for d in results if d.policy == policy and case in (None, d.case)]
            groups.append(ScoreGroup.of(policy, case, mine))
    return groups


def report_figures(results: Sequence[EpisodeResult], folder: Path) -> dict[str, Any]:
    """Everything for JSON; files relative to ``folder``."""
    return {
        "metrics": metric_versions(),
        "groups": [asdict(group) for group in group_scores(results)],
        "episodes": [
            {
                "policy": one.policy,
                "case": one.case,
                "seed": one.seed,
                "scene": one.recording.scene,
                "scene_hash": one.recording.scene_hash,
                "recording": one.file.relative_to(folder).as_posix(),
                "reason": one.reason,
                "error": one.error,
                **one.figures,
                "scores": list(one.scores().values()),
            }
            for one in results
        ],
    }


def unconfirmed_scores(figures: dict[str, Any], folder: Path) -> list[str]:
    """Episodes of a report whose scores differ from those of their recordings; none if all agree.

    Args:
        figures: as ``report_figures`` made them.
        folder: that their files are relative to.
    """
    differing = []
    for episode in figures["episodes"]:
        again = [s.fields() for s in load_recording(folder / episode["recording"]).rescore()]
        if episode["error"] is None and again != episode["scores"]:
            differing.append(episode["recording"])
    return differing


def _unique(names: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(names))
