"""One HTML page that compares planners; it holds everything and loads nothing."""

from __future__ import annotations

import base64
import statistics
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import Any

from ..world.recording.recording import load_recording
from ..world.scoring import METRICS, metric_versions
from .episodes import EpisodeResult
from .plots import plot_curves, plot_paths

# --- Summary -------------------------------------------------------------------------------------

# Mean and standard deviation of each score, by planner and case.


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


STYLE = """
body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:1250px;padding:0 1rem;
color:#1a1d21;background:#fff}
h1{font-size:1.5rem;margin-bottom:.2rem}h2{font-size:1.15rem;margin-top:2.2rem}
h3{font-size:1rem;margin:1.2rem 0 .3rem}p{margin:.3rem 0 .8rem;color:#4a525c;max-width:60rem}
table{border-collapse:collapse;margin:.6rem 0;font-size:.86rem}
th,td{padding:.25rem .5rem;text-align:right;border-bottom:1px solid #dfe3e8;}
td{white-space:nowrap}th:first-child,td:first-child{text-align:left}th{font-weight:600;background:#f4f6f8}
th small{font-weight:400;color:#6a737d;display:block}
td{font-variant-numeric:tabular-nums}td small{color:#6a737d}.bad{color:#c0303f;font-weight:600}
.strip{display:grid;grid-auto-flow:column;grid-auto-columns:minmax(0,210px);gap:5px}
.strip figure{margin:0}img{width:100%;display:block;border-radius:3px}
figcaption{font-size:.72rem;color:#4a525c}.scroll{overflow-x:auto}
"""

SCORE_NOTES = {
    "kinematic_infeasibility": "0 is good",
    "delta_v": "m/s, 0 is good",
    "neuroncap": "of 5",
    "carla_ds": "of 100",
}


def render_page(results: Sequence[EpisodeResult], *, title: str) -> str:
    """The page for at least one episode."""
    policies = list(dict.fromkeys(one.policy for one in results))
    cases = list(dict.fromkeys(one.case for one in results))
    groups = group_scores(results)
    parts = [_head(results, title, policies, cases)]
    parts += ["<h2>All cases</h2>", _table([g for g in groups if g.case is None])]
    for case in cases:
        mine = [one for one in results if one.case == case]
        shown = [one for one in mine if one.seed == min(m.seed for m in mine)]
        parts += [
            f"<h2>{escape(case)}</h2>",
            _table([g for g in groups if g.case == case]),
            *(_blind_spots(one) for one in shown),
            _image(plot_curves(mine, policies), "png", "speed, time to collision, error, progress"),
            _image(plot_paths(shown, policies), "png", "driven paths from above"),
            *(_strip(one) for one in shown if one.stills),
        ]
    parts += ["<h2>Episodes</h2>", _episodes(results)]
    body = "\n".join(parts)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}'
        f"</title><style>{STYLE}</style></head><body>\n{body}\n</body></html>\n"
    )


def _head(
    results: Sequence[EpisodeResult], title: str, policies: list[str], cases: list[str]
) -> str:
    seeds = sorted({one.seed for one in results})
    return (
        f"<h1>{escape(title)}</h1><p>{len(policies)} planners, {len(cases)} cases, seeds "
        f"{', '.join(map(str, seeds))}: {len(results)} episodes. Scores are the mean over "
        "episodes, with the standard deviation where there are several, computed from the "
        "recordings; <code>real2sim replay FILE</code> "
        "computes them again. Curves show the first seed strong and the others faint, a cross a "
        "collision; maps and pictures show the first seed.</p>"
    )


def _blind_spots(one: EpisodeResult) -> str:
    """What the scores of an episode cannot see, to unfold."""
    if one.error is not None:
        return ""
    items = "".join(
        f"<li><b>{escape(name)}</b>: {escape(score['cannot_see'])}</li>"
        for name, score in one.scores().items()
        if score["cannot_see"]
    )
    summary = f"what the scores of {escape(one.policy)} cannot see, seed {one.seed}"
    return f"<details><summary>{summary}</summary><ul>{items}</ul></details>"


def _table(groups: Sequence[ScoreGroup]) -> str:
    names = "".join(
        f"<th>{name.replace('_', ' ')}<small>v{version} {SCORE_NOTES.get(name, '')}</small></th>"
        for name, version in metric_versions().items()
    )
    rows = [
        f"<th>planner</th>{names}<th>collisions<small>at fault</small></th><th>ended by</th>",
        *(_row(group) for group in groups),
    ]
    return f'<div class="scroll"><table>{"".join(f"<tr>{row}</tr>" for row in rows)}</table></div>'


def _row(group: ScoreGroup) -> str:
    cells = "".join(f"<td>{_score(group.scores[name])}</td>" for name in METRICS)
    hits = f"{group.collisions} <small>{group.at_fault}</small>" if not group.failed else "–"
    if group.at_fault:
        hits = f'<span class="bad">{hits}</span>'
    ended = ", ".join(f"{escape(reason)} {n}" for reason, n in group.reasons.items())
    return f"<td>{escape(group.policy)}</td>{cells}<td>{hits}</td><td>{ended}</td>"


def _score(statistics: ScoreStatistics | None) -> str:
    if statistics is None:
        return "–"
    if statistics.deviation is None:
        return f"{statistics.mean:.3g}"
    return f"{statistics.mean:.3g} <small>±{statistics.deviation:.2g}</small>"


def _strip(one: EpisodeResult) -> str:
    figures = "".join(
        f"<figure>{_image(data, 'jpeg', f'{seconds:.1f} s')}<figcaption>{seconds:.1f} s"
        "</figcaption></figure>"
        for seconds, data in one.stills
    )
    return f'<h3>{escape(one.policy)}, {escape(one.reason)}</h3><div class="strip">{figures}</div>'


def _episodes(results: Sequence[EpisodeResult]) -> str:
    heads = ("case", "planner", "seed", "ended by", "seconds", "metres", "least TTC", "plan ms")
    rows = ["".join(f"<th>{head}</th>" for head in (*heads, "recording"))]
    for one in results:
        found = one.figures
        cells = (
            escape(one.case),
            escape(one.policy),
            str(one.seed),
            escape(one.error or one.reason),
            f"{found['seconds']:.1f}",
            f"{found['distance']:.1f}",
            "–" if found["min_ttc"] is None else f"{found['min_ttc']:.1f}",
            "–" if found["plan_ms_p50"] is None else f"{found['plan_ms_p50']:.1f}",
            _link("/".join(one.file.parts[-4:])),
        )
        rows.append("".join(f"<td>{cell}</td>" for cell in cells))
    return f'<div class="scroll"><table>{"".join(f"<tr>{row}</tr>" for row in rows)}</table></div>'


def _link(path: str) -> str:
    return f'<a href="{escape(path)}">{escape(path.rsplit("/", 1)[-1])}</a>'


def _image(data: bytes, kind: str, alt: str) -> str:
    text = base64.b64encode(data).decode()
    return f'<img alt="{escape(alt)}" src="data:image/{kind};base64,{text}">'
