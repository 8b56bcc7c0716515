"""Failures of a search: reports, shrinking and scenario files."""

from __future__ import annotations

import dataclasses
import json
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from real2sim.planners import load_planner
from real2sim_proto.episode import ResetSpec

from ..policies.page import STYLE
from ..world.recording import Recording
from .episode import Drive, Driven, drive_episode
from .evaluation import Evaluation, Evaluator, impact_of
from .parameters import Value, drawn_parameters, values_at
from .spec import read_scenario, run_options, write_scenario_file

# --- Shrinking -----------------------------------------------------------------------------------

# Bisects each parameter between the failure and a safe end.

HALVINGS = 5
"""Number of bisections: a boundary is accurate to 1/32 of the distance from failure to safe end."""


@dataclass(frozen=True)
class Boundary:
    """Boundary of a failure along one parameter.

    Attributes:
        parameter: name.
        failing: the value of the failure.
        last_fail, first_pass: the values on either side of the boundary.
        share: distance to ``first_pass``, as a share of the range.
    """

    parameter: str
    failing: Value
    last_fail: Value
    first_pass: Value
    share: float


def boundaries(evaluate: Evaluator, failure: Evaluation) -> list[Boundary]:
    """The nearest boundary of each parameter that alone can avoid the failure, sorted by distance.

    Both ends of a parameter are tried; if one is safe, the interval is bisected.
    """
    names = list(drawn_parameters(evaluate.spaces[failure.space].parameters))
    found = []
    for k, name in enumerate(names):
        sides = [_towards(evaluate, failure, (k, name), end) for end in (0.0, 1.0)]
        safe = [b for b in sides if b is not None]
        if safe:
            found.append(min(safe, key=lambda b: b.share))
    return sorted(found, key=lambda b: b.share)


def _towards(
    evaluate: Evaluator, failure: Evaluation, parameter: tuple[int, str], end: float
) -> Boundary | None:
    """The boundary towards an end; None if the end fails as well."""
    k, name = parameter

    def fails(u: float) -> bool:
        return evaluate(failure.space, _moved(failure, k, u)).at_fault

    if abs(end - failure.point[k]) < 1e-6 or fails(end):
        return None
    bad, good = failure.point[k], end
    for _ in range(HALVINGS):
        middle = (bad + good) / 2
        if fails(middle):
            bad = middle
        else:
            good = middle
    parameters = evaluate.spaces[failure.space].parameters

    def value(u: float) -> Value:
        return values_at(parameters, _moved(failure, k, u))[name]

    share = abs(good - failure.point[k])
    return Boundary(name, failure.values[name], value(bad), value(good), share)


def _moved(failure: Evaluation, k: int, u: float) -> list[float]:
    point = np.array(failure.point)
    point[k] = u
    moved: list[float] = point.tolist()
    return moved


# --- Scenario files ------------------------------------------------------------------------------

NAMING = ("name", "author", "date")
"""Keys of a storyboard without effect on the episode."""


@dataclass(frozen=True)
class WrittenScenario:
    """The scenario file of a failure.

    Attributes:
        file: path relative to the folder of the search; OpenSCENARIO, or a storyboard in JSON if
            OpenSCENARIO cannot express it.
        command: command that drives it.
        same: whether it ends in the same collision, bitwise.
    """

    file: str
    command: str
    same: bool


def write_scenario(
    path: Path, evaluate: Evaluator, found: Evaluation, driven: Driven, *, scene: str
) -> WrittenScenario | None:
    """Write a failure's storyboard and its road network, read it, and drive it.

    Args:
        path: path in the folder of the search, without a suffix.
        evaluate: evaluator of the search.
        found: the failure.
        driven: its episode.
        scene: name or path of the scene, for display.

    Returns:
        None if the case is not a storyboard, or has options that ``real2sim run`` lacks.
    """
    space = evaluate.spaces[found.space].storyboard
    if space is None:
        return None
    folder = path.parent
    folder.mkdir(parents=True, exist_ok=True)
    source = write_scenario_file(folder, path.name, space.read(found.values), space.source)
    seconds = ResetSpec.model_validate(found.drive.reset).horizon or 0
    seed = int(found.drive.reset.get("seed", 0))
    board = space.laid_out(read_scenario(source, folder, {}).board)
    options = run_options(board, seed=seed, seconds=seconds / 10)
    if found.drive.operations or not _same_options(options, found.drive.reset):
        (folder / source.file).unlink()
        return None
    planner = found.drive.planner
    again = drive_episode(evaluate.scene, Drive(planner, options), load_planner(planner))
    file = f"{folder.name}/{source.file}"
    command = ["real2sim", "run", file, scene, "--planner", planner]
    command += ["--seconds", f"{seconds / 10:g}", "--seed", str(seed)]
    command += ["--ego", space.source.ego] if space.source.ego else []
    command += ["--as-it-is"] if space.source.as_it_is else []
    return WrittenScenario(file, shlex.join(command), _same(again, driven))


def _same_options(mine: Mapping[str, Any], theirs: Mapping[str, Any]) -> bool:
    """Whether two sets of reset options define the same episode."""
    return _plain(mine) == _plain(theirs)


def _plain(options: Mapping[str, Any]) -> str:
    fields = ResetSpec.model_validate(options).model_dump(mode="json")
    board = fields["storyboard"] or {}
    for key in NAMING:
        board.pop(key, None)
    # The road network file next to the scenario has a different name.
    if (board.get("roads") or {}).get("kind") == "map":
        board["roads"].pop("file", None)
    return json.dumps(fields, sort_keys=True)


def _same(one: Driven, other: Driven) -> bool:
    """Whether two episodes end in the same collision, with all objects at the same positions."""
    a, b = one.world, other.world
    if a is None or b is None or (a.steps, a.motion) != (b.steps, b.motion):
        return False
    return (
        a.instant.others.ids == b.instant.others.ids
        and np.array_equal(a.instant.others.centres, b.instant.others.centres)
        and one.at_fault
        and other.at_fault
        and impact_of(one) == impact_of(other)
    )


@dataclass(frozen=True, eq=False)
class Failure:
    """An avoidable collision that was the planner's fault.

    Attributes:
        name: name of its files.
        found: the evaluation.
        recording: recording of the planner's episode.
        replays: whether the recording replays bitwise.
        avoidable_until: latest take-over by the reference that avoids the impact, in seconds before
            it; None if no take-over does, or if plans are not trajectories.
        boundaries: boundaries, nearest first.
        film: film file, or None.
        scenario: its scenario file; None if the case is not a storyboard.
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
        """The failure as JSON values."""
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


# --- Page -----------------------------------------------------------------------------------------

MAP_M, MAP_PX = 44.0, 300
CARDS = """
.cards{display:grid;grid-template-columns:repeat(auto-fill,minmax(300px,1fr));gap:1.2rem}
.card{border:1px solid #dfe3e8;border-radius:6px;padding:.7rem .8rem}
.card h3{margin:.1rem 0 .4rem}.card p{margin:.25rem 0;font-size:.86rem}
svg{background:#f4f6f8;border-radius:4px;width:100%;height:auto;display:block}
.big{font-size:1.05rem;color:#1a1d21}.bar{background:#3b6fb6;height:.7rem;display:inline-block}
video{width:100%;border-radius:4px;margin-top:.4rem}
"""


def render_page(report: Mapping[str, Any], failures: Sequence[Failure]) -> str:
    """The HTML page of failures.json."""
    title = f"Failures of {report['planner']}"
    cards = "".join(_card(f) for f in failures)
    body = "\n".join(
        [
            f"<h1>{escape(title)}</h1>",
            _summary(report),
            f'<div class="cards">{cards}</div>' if failures else "",
            "<h2>What decides</h2>",
            *(_space(s) for s in report["spaces"]),
        ]
    )
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}'
        f"</title><style>{STYLE}{CARDS}</style></head><body>\n{body}\n</body></html>\n"
    )


def _summary(report: Mapping[str, Any]) -> str:
    found, episodes = report["failures"], report["episodes"]
    spaces = ", ".join(escape(s["name"]) for s in report["spaces"])
    if not found:
        return (
            f'<p class="big">No avoidable failure in {episodes} episodes of {spaces}. That does '
            "not prove that there is none.</p>"
        )
    return (
        f'<p class="big">{report["avoidable"]} avoidable collisions of {report["at_fault"]} that '
        f"were the planner's fault, in {episodes} episodes of {spaces}; the first was episode "
        f"{report['first_failure']}. They are of {report['cells']} kinds; the worst of each kind "
        "is shown. A reference driver that knows what comes survives each of them.</p>"
    )


def _card(failure: Failure) -> str:
    found, impact = failure.found, failure.found.impact
    where, _, kind = found.cell or ("", "", "")
    speed = impact.get("speed")
    lines = [
        f"<h3>{escape(where)}, {0.0 if speed is None else speed:.1f} m/s: {escape(kind)}</h3>",
        _top_view(failure),
        f"<p>{impact.get('time', 0.0):.1f} s after the start. {_avoidable(failure)}</p>",
        f"<p>{_values(found.values)}</p>",
    ]
    for edge in failure.boundaries[:2]:
        lines.append(
            f"<p>No failure with <b>{escape(edge.parameter)}</b> {_number(edge.first_pass)} "
            f"instead of {_number(edge.failing)}.</p>"
        )
    if failure.film:
        lines.append(f'<video controls preload="none" src="{escape(failure.film)}"></video>')
    same = "same bits again" if failure.replays else "comes out differently"
    lines.append(
        f'<p><a href="recordings/{failure.name}.r2e">recording</a> ({same}), '
        f'<a href="cases/{failure.name}.json">case</a></p>'
    )
    if failure.scenario is not None:
        file = escape(failure.scenario.file)
        lines.append(
            f'<p><a href="{file}">scenario</a>: <code>{escape(failure.scenario.command)}</code></p>'
        )
    return f'<div class="card">{"".join(lines)}</div>'


def _avoidable(failure: Failure) -> str:
    if failure.avoidable_until is None:
        return "Avoided by the reference from the start."
    return f"Still avoidable {failure.avoidable_until:g} s before."


def _values(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{escape(k)} {_number(v)}" for k, v in values.items())


def _number(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else escape(str(value))


def _top_view(failure: Failure) -> str:
    """Top view of the last seconds, with the ego's direction upwards."""
    instants = failure.recording.instants
    last, context = instants[-1], failure.recording.context
    cos, sin = math.cos(last.ego.yaw), math.sin(last.ego.yaw)
    scale = MAP_PX / MAP_M

    def placed(x: float, y: float) -> tuple[float, float]:
        dx, dy = x - last.ego.x, y - last.ego.y
        ahead, left = cos * dx + sin * dy, cos * dy - sin * dx
        return MAP_PX / 2 - left * scale, MAP_PX * 0.62 - ahead * scale

    def box(x: float, y: float, yaw: float, size: Sequence[float], style: str) -> str:
        c, s = math.cos(yaw), math.sin(yaw)
        length, width = size[0] / 2, size[1] / 2
        corners = [
            placed(x + u * length * c - v * width * s, y + u * length * s + v * width * c)
            for u, v in ((1, 1), (1, -1), (-1, -1), (-1, 1))
        ]
        points = " ".join(f"{px:.1f},{py:.1f}" for px, py in corners)
        return f'<polygon points="{points}" {style}/>'

    hit = failure.found.impact.get("object")
    parts = []
    shown = instants[-31::5] if len(instants) > 1 else instants
    for instant in [*shown, last]:
        faint = "" if instant is last else ' opacity="0.25"'
        ego, others = instant.ego, instant.others
        ahead = context.centre_ahead
        x, y = ego.x + ahead * math.cos(ego.yaw), ego.y + ahead * math.sin(ego.yaw)
        for k, name in enumerate(others.ids):
            if name != hit and instant is not last:
                continue
            colour = "#d9622b" if name == hit else "#9aa3ad"
            style = f'fill="{colour}"{faint}'
            cx, cy = others.centres[k, :2].tolist()
            parts.append(box(cx, cy, float(others.yaws[k]), others.sizes[k].tolist(), style))
        parts.append(box(x, y, ego.yaw, context.ego_size, f'fill="#3a9a4a"{faint}'))
    return (
        f'<svg viewBox="0 0 {MAP_PX} {MAP_PX}" role="img" aria-label="from above">'
        f"{''.join(parts)}</svg>"
    )


def _space(space: Mapping[str, Any]) -> str:
    rows = "".join(
        f"<tr><td>{escape(name)}</td><td>{100 * index['first']:.0f} %</td>"
        f"<td>{100 * index['total']:.0f} %</td>"
        f'<td style="text-align:left"><span class="bar" '
        f'style="width:{140 * index["total"]:.0f}px"></span></td></tr>'
        for name, index in sorted(space["sobol"].items(), key=lambda kv: -kv[1]["total"])
    )
    head = "<tr><th>parameter</th><th>alone</th><th>with others</th><th></th></tr>"
    table = f"<table>{head}{rows}</table>" if rows else "<p>Too few episodes for indices.</p>"
    odds = space["probability"]
    chance = ""
    if odds is not None:
        chance = (
            f"<p>Probability of a collision at fault: {odds['value']:.2g}, between "
            f"{odds['low']:.2g} and {odds['high']:.2g} with 95 % ({escape(odds['how'])}, "
            f"{odds['episodes']} episodes).</p>"
        )
    return (
        f"<h3>{escape(space['name'])}</h3><p>{space['episodes']} episodes, {space['failures']} "
        "avoidable failures. Share of how critical episodes are that each parameter decides "
        f"(Sobol indices of a surrogate through them):</p>{table}{chance}"
    )
