"""Failures of a search: reports, shrinking and scenario files."""

from __future__ import annotations

import dataclasses
import json
import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.episode import ResetSpec

from ..policies.page import STYLE
from ..scene.lane import DRIVABLE
from ..world.recording import Recording
from ..world.scoring.instant import ScoringContext
from .episode import Drive, Driven
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
        found = evaluate(failure.space, _moved(failure, k, u))
        # An episode in which the planner fails shows no value to be safe.
        return found.at_fault or found.error is not None

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
    again = evaluate.drive(Drive(planner, options))
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
SCALE_M = 10
"""Length of the scale bar [m]."""
EGO, HIT, OTHER, ROAD, LINE = "#2b8a3e", "#d9622b", "#8f99a4", "#dde2e7", "#ffffff"
CARDS = """
.cards{display:grid;grid-template-columns:repeat(auto-fill,minmax(300px,1fr));gap:1.2rem}
.card{border:1px solid #dfe3e8;border-radius:6px;padding:.7rem .8rem;min-width:0}
.card h3{margin:.1rem 0 .4rem}.card p{margin:.25rem 0;font-size:.86rem}
svg{background:#f4f6f8;border-radius:4px;width:100%;height:auto;display:block}
svg text{font-size:11px;font-weight:600;paint-order:stroke;stroke:#fff;stroke-width:3px}
.key{font-size:.86rem}.key span{margin-right:.8rem;white-space:nowrap}
.key i{display:inline-block;width:.8rem;height:.8rem;border-radius:2px;vertical-align:-.08rem}
.big{font-size:1.05rem;color:#1a1d21}.bar{background:#3b6fb6;height:.7rem;display:inline-block}
video{width:100%;border-radius:4px;margin-top:.4rem;display:block}code{overflow-wrap:anywhere}
"""


COLOURS = {"ego": EGO, "what it collides with": HIT, "others": OTHER, "road": ROAD}
KEY = (
    '<p class="key">'
    + " ".join(f'<span><i style="background:{c}"></i> {name}</span>' for name, c in COLOURS.items())
    + "<br>From above at the end of the episode; pale: every half second of the 3 s before.</p>"
)


def render_page(report: Mapping[str, Any], failures: Sequence[Failure]) -> str:
    """The HTML page of failures.json."""
    title = f"Failures of {report['planner']}"
    cards = "".join(_card(f) for f in failures)
    body = "\n".join(
        [
            f"<h1>{escape(title)}</h1>",
            _summary(report),
            f'{KEY}<div class="cards">{cards}</div>' if failures else "",
            "<h2>What decides</h2>",
            *(_space(s) for s in report["spaces"]),
        ]
    )
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>{escape(title)}</title><style>{STYLE}{CARDS}</style></head>"
        f"<body>\n{body}\n</body></html>\n"
    )


def _summary(report: Mapping[str, Any]) -> str:
    if not report["planner_failed"]:
        return _driving(report)
    return (
        f'<p class="big">The planner itself failed in {report["planner_failed"]} of '
        f"{report['episodes']} episodes, which say nothing about its driving; first: "
        f"{escape(report['first_error'])}.</p>{_driving(report)}"
    )


def _driving(report: Mapping[str, Any]) -> str:
    found, episodes = report["failures"], report["episodes"] - report["planner_failed"]
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
        poster = Path(failure.film).with_suffix(".jpg").as_posix()
        lines.append(
            f'<video controls playsinline preload="none" poster="{escape(poster)}" '
            f'src="{escape(failure.film)}"></video>'
        )
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

    def placed(points: NDArray[np.float64]) -> str:
        """Points [N, 2 or more] of the world, as the attribute ``points``."""
        dx, dy = points[:, 0] - last.ego.x, points[:, 1] - last.ego.y
        x = MAP_PX / 2 - (cos * dy - sin * dx) * scale
        y = MAP_PX * 0.62 - (cos * dx + sin * dy) * scale
        return " ".join(f"{px:.1f},{py:.1f}" for px, py in zip(x, y, strict=True))

    def box(x: float, y: float, yaw: float, size: Sequence[float], style: str) -> str:
        """A box with a pointed front."""
        length, width = size[0] / 2, size[1] / 2
        nose = length - min(0.9, length)
        local = np.array(
            [(length, 0.0), (nose, width), (-length, width), (-length, -width), (nose, -width)]
        )
        c, s = math.cos(yaw), math.sin(yaw)
        return f'<polygon points="{placed(local @ [[c, s], [-s, c]] + [x, y])}" {style}/>'

    hit = failure.found.impact.get("object")
    parts = _road(context, placed, np.array([last.ego.x, last.ego.y]), scale)
    shown = instants[-31::5] if len(instants) > 1 else instants
    for instant in [*shown, last]:
        faint = "" if instant is last else ' opacity="0.25"'
        ego, others = instant.ego, instant.others
        ahead = context.centre_ahead
        x, y = ego.x + ahead * math.cos(ego.yaw), ego.y + ahead * math.sin(ego.yaw)
        for k, name in enumerate(others.ids):
            if name != hit and instant is not last:
                continue
            style = f'fill="{HIT if name == hit else OTHER}"{faint}'
            cx, cy = others.centres[k, :2].tolist()
            parts.append(box(cx, cy, float(others.yaws[k]), others.sizes[k].tolist(), style))
        parts.append(box(x, y, ego.yaw, context.ego_size, f'fill="{EGO}"{faint}'))
    beside = MAP_PX / 2 + (context.ego_size[1] / 2 + 0.6) * scale
    behind = MAP_PX * 0.62 - context.centre_ahead * scale + 4
    parts.append(f'<text x="{beside:.1f}" y="{behind:.1f}" fill="{EGO}">ego</text>')
    left, bottom = 10, MAP_PX - 10
    parts.append(
        f'<path d="M{left} {bottom - 5}v5h{SCALE_M * scale:.1f}v-5" fill="none" stroke="#1a1d21"/>'
        f'<text x="{left + 5}" y="{bottom - 4}" fill="#1a1d21">{SCALE_M} m</text>'
    )
    return (
        f'<svg viewBox="0 0 {MAP_PX} {MAP_PX}" role="img" aria-label="from above">'
        f"{''.join(parts)}</svg>"
    )


def _road(
    context: ScoringContext,
    placed: Callable[[NDArray[np.float64]], str],
    middle: NDArray[np.float64],
    scale: float,
) -> list[str]:
    """Lanes within the top view: of the map, or else the corridors of the recorded drives."""

    def near(line: NDArray[np.float64]) -> bool:
        gaps = line[:, :2] - middle
        # The ends of a long straight lane may both be far away.
        return bool((gaps.min(axis=0) < MAP_M).all() and (gaps.max(axis=0) > -MAP_M).all())

    if context.road_map is None:
        driven = [(context.route, context.corridor), *((k, context.lane) for k in context.lanes)]
        driven = [(line, half) for line, half in driven if near(line)]
        shapes = [(line, ROAD, f"{2 * half * scale:.1f}") for line, half in driven]
        shapes += [(line, LINE, '1" stroke-dasharray="6 6') for line, _ in driven]
        return [
            f'<polyline points="{placed(line)}" fill="none" stroke="{colour}" '
            f'stroke-width="{width}" stroke-linejoin="round"/>'
            for line, colour, width in shapes
        ]
    lanes = context.road_map.graph.lanes.values()
    outlines = [
        np.concatenate([a, b[::-1]]) for a, b in (k.rims for k in lanes if k.kind in DRIVABLE)
    ]
    return [
        f'<polygon points="{placed(line)}" fill="{ROAD}" stroke="{LINE}" stroke-width="1.5"/>'
        for line in outlines
        if near(line)
    ]


def _space(space: Mapping[str, Any]) -> str:
    rows = "".join(
        f"<tr><td>{escape(name)}</td><td>{100 * index['first']:.0f} %</td>"
        f"<td>{100 * index['total']:.0f} %</td>"
        f'<td style="text-align:left"><span class="bar" '
        f'style="width:{140 * index["total"]:.0f}px"></span></td></tr>'
        for name, index in sorted(space["sobol"].items(), key=lambda kv: -kv[1]["total"])
    )
    head = "<tr><th>parameter</th><th>alone</th><th>with others</th><th></th></tr>"
    table = (
        f'<div class="scroll"><table>{head}{rows}</table></div>'
        if rows
        else "<p>Too few episodes for indices.</p>"
    )
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
