"""Pictures of episodes, and a self-contained HTML page that compares planners."""

from __future__ import annotations

import base64
import contextlib
import io
import math
import statistics
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .._files import atomic_file
from ..geometry import quaternion_yaw
from ..render import RasterOptions, render_cameras, select_backend
from ..render.images import turbo_jpeg, video_file
from ..scene import Scene
from ..world import World
from ..world.recording import Recording, load_recording
from ..world.replay import Replayer
from ..world.scoring import METRICS, metric_versions
from .episodes import EpisodeResult

# --- Plots ----------------------------------------------------------------------------------------

COLORS = ("#1f6feb", "#d1495b", "#2a9d5c", "#e08a00", "#7b4fc9", "#0e8f9e", "#8a5a2b", "#555e68")
TTC_SHOWN = 4.0
"""Maximum plotted time to collision [s]."""
MARGIN = 14.0

Array = NDArray[np.float64]


def plot_curves(results: Sequence[EpisodeResult], policies: Sequence[str]) -> bytes:
    """Speed, time to collision, lateral error and progress over time, for one case.

    Args:
        results: episodes of the case; the first seed is drawn opaque, the others faint.
        policies: all planners, in the order of their colors.
    """
    plt = _pyplot()
    figure, axes = plt.subplots(2, 2, figsize=(13, 6.4), dpi=90, sharex=True)
    first = min(one.seed for one in results)
    for one in results:
        strong = one.seed == first
        color = COLORS[policies.index(one.policy) % len(COLORS)]
        times, series = _series(one.recording)
        for ax, values in zip(axes.flat, series, strict=True):
            ax.plot(
                times,
                values,
                color=color,
                lw=1.8 if strong else 0.7,
                alpha=0.95 if strong else 0.4,
                label=one.policy if strong else None,
            )
        if one.reason == "collision":
            for ax, values in zip(axes.flat, series, strict=True):
                ax.plot(times[-1], values[-1], "x", color=color, ms=8, mew=2)
    titles = (
        "speed [m/s]",
        f"time to collision, up to {TTC_SHOWN:g} [s]",
        "lateral error [m]",
        "progress [m]",
    )
    for ax, title in zip(axes.flat, titles, strict=True):
        ax.set_title(title, loc="left", fontsize=10)
        ax.grid(alpha=0.25)
    for ax in axes[1]:
        ax.set_xlabel("time [s]")
    axes[0, 1].set_ylim(-0.1, TTC_SHOWN + 0.2)
    axes[0, 0].legend(frameon=False, fontsize=8)
    return _png(figure)


def plot_paths(results: Sequence[EpisodeResult], policies: Sequence[str]) -> bytes:
    """Top views of driven paths, two per row, with every object at its final pose."""
    plt = _pyplot()
    low, high = _extent([one.recording for one in results])
    rows = -(-len(results) // 2)
    height = 0.7 + 6.0 * (high[1] - low[1]) / max(high[0] - low[0], 1.0)
    figure, axes = plt.subplots(rows, 2, figsize=(13, height * rows), dpi=90, squeeze=False)
    for ax in axes.flat[len(results) :]:
        ax.set_visible(False)
    for ax, one in zip(axes.flat, results, strict=False):
        color = COLORS[policies.index(one.policy) % len(COLORS)]
        _draw_episode(ax, one.recording, color)
        ax.set_title(f"{one.policy}: {one.reason}", loc="left", fontsize=9)
        ax.set_xlim(low[0], high[0])
        ax.set_ylim(low[1], high[1])
        ax.set_aspect("equal")
    return _png(figure)


def _series(recording: Recording) -> tuple[Array, tuple[Array, Array, Array, Array]]:
    instants, accumulators = recording.instants, recording.accumulators()
    times = np.array([(i.t_us - instants[0].t_us) * 1e-6 for i in instants])
    ttc = np.array([min(accumulator.ttc, TTC_SHOWN) for accumulator in accumulators])
    return times, (
        np.array([i.ego.speed for i in instants]),
        ttc,
        np.array([i.ego.offset for i in instants]),
        np.array([accumulator.s - recording.context.start_s for accumulator in accumulators]),
    )


def _draw_episode(ax: Any, recording: Recording, color: str) -> None:
    context, last = recording.context, recording.instants[-1]
    ax.plot(context.route[:, 0], context.route[:, 1], color="black", lw=0.8, ls="--")
    for k, object_id in enumerate(last.others.ids):
        hit = any(object_id == c.object_id for i in recording.instants for c in i.contacts)
        box = rectangle_corners(
            last.others.centres[k, :2], last.others.yaws[k], last.others.sizes[k]
        )
        ax.fill(*box.T, color="#d1495b" if hit else "#8b949e", alpha=0.8 if hit else 0.45, lw=0)
        track = _track(recording, object_id)
        if np.ptp(track, axis=0).max() > 1.0:
            ax.plot(*track.T, color="#8b949e", lw=0.6)
    path = np.array([(i.ego.x, i.ego.y) for i in recording.instants])
    ax.plot(*path.T, color=color, lw=2)
    ahead = np.array([math.cos(last.ego.yaw), math.sin(last.ego.yaw)]) * context.centre_ahead
    box = rectangle_corners(path[-1] + ahead, last.ego.yaw, np.array(context.ego_size))
    ax.fill(*box.T, color=color, alpha=0.85, lw=0)


def _track(recording: Recording, object_id: str) -> Array:
    places = [
        i.others.centres[i.others.ids.index(object_id), :2]
        for i in recording.instants
        if object_id in i.others.ids
    ]
    return np.array(places)


def rectangle_corners(centre: Array, yaw: float, size: Array) -> Array:
    """[4, 2] corners of a box of ``size`` seen from above, in cyclic order [m]."""
    c, s = math.cos(yaw), math.sin(yaw)
    local = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * size[:2] / 2
    corners: Array = local @ np.array([[c, s], [-s, c]]) + centre
    return corners


def _extent(recordings: Sequence[Recording]) -> tuple[Array, Array]:
    places = [[(i.ego.x, i.ego.y) for i in r.instants] for r in recordings]
    places += [r.context.route.tolist() for r in recordings]
    points = np.concatenate([np.array(p) for p in places])
    low: Array = points.min(axis=0) - MARGIN
    high: Array = points.max(axis=0) + MARGIN
    return low, high


def _pyplot() -> Any:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    return pyplot


def _png(figure: Any) -> bytes:
    figure.tight_layout()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    _pyplot().close(figure)
    return buffer.getvalue()


# --- Films ---------------------------------------------------------------------------------------

Image = NDArray[np.uint8]


MAP_PIXELS, MAP_METRES = 160, 60.0
BACKGROUND, ROUTE, OBJECT, EGO = (40, 40, 40), (160, 160, 160), (255, 140, 60), (120, 220, 120)
"""Colors of the map."""
POSTER_QUALITY = 85


def film_episode(
    recording: Recording,
    replayer: Replayer,
    scene: Scene,
    path: Path,
    *,
    camera: str | None = None,
    width: int = 640,
    poster: Path | None = None,
) -> None:
    """Write an MP4 of a replayed episode, one image per step.

    Args:
        recording: the episode.
        replayer: replayer of the episode, before its first entry.
        scene: scene of the episode.
        path: file to write.
        camera: camera name; None: the first one.
        width: width of the film [px].
        poster: JPEG file to write, with the last image; None writes none.
    """
    chosen = scene.rig[camera or scene.rig.names[0]].resized(width)
    backend = select_backend("auto")
    with contextlib.ExitStack() as stack:
        video = None
        for world in _instants(recording, replayer):
            (frame,) = render_cameras(
                world.instances(),
                [chosen],
                world.T_world_body,
                sky=scene.sky,
                options=RasterOptions(),
                backend=backend,
            )
            image = np.array(frame.rgb)
            _draw_caption(image, world)
            _draw_map(image, world)
            if video is None:
                rate = 1e6 / world.spec.dt_us
                video = stack.enter_context(video_file(path, frames_per_second=rate))
            video.add(image)
    if poster is not None:
        with atomic_file(poster) as file:
            file.write(turbo_jpeg(image, POSTER_QUALITY))


def _instants(recording: Recording, replayer: Replayer) -> Iterator[World]:
    for entry in recording.entries:
        world = replayer.apply(entry)
        if entry.kind in {"reset", "action", "restore"}:
            yield world


def _draw_caption(image: Image, world: World) -> None:
    metrics = world.metrics()
    lines = [
        f"{(world.t_us - world.scene.start_us) * 1e-6:5.1f} s  {world.motion.speed:4.1f} m/s",
        f"pdms {metrics['pdms']:.2f}  completed {100 * metrics['route_completion']:.0f} %",
        *(f"{e.type} {e.object_id or ''}" for e in world.observe().events),
    ]
    for k, line in enumerate(lines):
        for color, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            cv2.putText(
                image, line, (8, 18 + 18 * k), cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, thickness
            )


def _draw_map(image: Image, world: World) -> None:
    """Draw a top view, with the ego heading up, into the lower right corner."""
    size = min(MAP_PIXELS, image.shape[0] // 2, image.shape[1] // 2)
    scale, motion = size / MAP_METRES, world.motion
    drawn = np.full((size, size, 3), BACKGROUND, np.uint8)
    cos, sin = math.cos(motion.yaw), math.sin(motion.yaw)

    def to_pixels(points: Array) -> NDArray[np.int32]:
        d = points - [motion.x, motion.y]
        ahead, left = d @ [cos, sin], d @ [-sin, cos]
        return np.stack([size / 2 - scale * left, 0.75 * size - scale * ahead], 1).astype(np.int32)

    cv2.polylines(drawn, [to_pixels(world.context.route)], False, ROUTE, 1)
    agents = world.agents
    for k in range(len(agents.objects)):
        yaw = float(quaternion_yaw(agents.quaternions[k]))
        corners = rectangle_corners(agents.positions[k, :2], yaw, agents.sizes[k])
        cv2.fillPoly(drawn, [to_pixels(corners)], OBJECT)
    ahead = world.context.centre_ahead
    centre = np.array([motion.x + ahead * cos, motion.y + ahead * sin])
    corners = rectangle_corners(centre, motion.yaw, np.array(world.scene.ego_size))
    cv2.fillPoly(drawn, [to_pixels(corners)], EGO)
    image[-size:, -size:] = drawn


# --- Page: summary --------------------------------------------------------------------------------

# Mean and standard deviation of each score, by planner and case.


@dataclass(frozen=True)
class ScoreStatistics:
    """Mean over ``count`` episodes, and population standard deviation if there are several."""

    mean: float
    deviation: float | None
    count: int

    @classmethod
    def of(cls, values: Sequence[float]) -> ScoreStatistics | None:
        """Statistics of values; None for no values."""
        if not values:
            return None
        deviation = statistics.pstdev(values) if len(values) > 1 else None
        return cls(statistics.fmean(values), deviation, len(values))


@dataclass(frozen=True)
class ScoreGroup:
    """Episodes of one planner in one case, or in all cases if ``case`` is None.

    Attributes:
        scores: statistics by name; None if undefined in every episode, or if the planner failed in
            any, because a mean over the others would be biased in its favour.
        collisions, at_fault: total numbers of collisions and of at-fault collisions, without
            episodes in which the planner failed.
        reasons: number of episodes by reason for the end.
        failed: number of episodes in which the planner failed.
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
        """Statistics of at least one episode."""
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
            collisions=sum(one.figures["collisions"] for one in results if one.error is None),
            at_fault=sum(one.figures["at_fault"] for one in results if one.error is None),
            reasons=dict(Counter(one.reason for one in results)),
            failed=failed,
        )


def group_scores(results: Sequence[EpisodeResult]) -> list[ScoreGroup]:
    """Summaries of every planner over all cases, then of every planner in every case, in order."""
    policies, cases = _unique(d.policy for d in results), _unique(d.case for d in results)
    groups = []
    for case in (None, *cases):
        for policy in policies:
            mine = [d for d in results if d.policy == policy and case in (None, d.case)]
            groups.append(ScoreGroup.of(policy, case, mine))
    return groups


def report_figures(results: Sequence[EpisodeResult], folder: Path) -> dict[str, Any]:
    """All results as JSON values; file paths are relative to ``folder``."""
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
    """Episodes of a report whose scores differ from their recordings; empty if all agree.

    Args:
        figures: result of ``report_figures``.
        folder: base of their relative file paths.
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
    """Expandable list of the limits of an episode's scores."""
    if one.error is not None:
        return ""
    items = "".join(
        f"<li><b>{escape(name)}</b>: {escape(score['cannot_see'])}</li>"
        for name, score in one.scores().items()
        if score["cannot_see"]
    )
    summary = f"blind spots of the scores of {escape(one.policy)}, seed {one.seed}"
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
