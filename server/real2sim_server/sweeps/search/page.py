"""One HTML page of a search, which a person reads in a minute; it loads nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from ...policies.page import STYLE
from .failure import Failure

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
    """The page of what failures.json holds."""
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
            f'<p class="big">No avoidable failure in {episodes} episodes of {spaces}. That is no '
            "proof that there is none.</p>"
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
            f"<p>It goes well with <b>{escape(edge.parameter)}</b> {_number(edge.first_pass)} "
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
    """The last seconds from above, the ego's way upwards."""
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
