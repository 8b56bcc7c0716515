"""A sweep: points of a space, driven by planners, as one table."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from real2sim.planners import load_planner, needs_of
from real2sim_proto.sweeps import StopRule

from ..console import CommandError
from ..executors import Executor
from ..scene import Scene
from ..world.recording.recording import save_recording
from ..world.scoring import metrics_version
from .episode import Drive, drive_episode, recording_of
from .journal import Journal
from .parameters import Choice, IntRange, Value, drawn_parameters, values_at
from .pictures import CameraFeed
from .sampling import points_of
from .scenes import open_scene
from .spec import SweepSpec
from .storyboard_space import write_scenario_file
from .table import write_table
from .worker import COLUMNS, Row, recipe_of

JOURNAL, TABLE = "episodes.journal", "episodes.parquet"
RECORDINGS, SCENARIOS = "recordings", "scenarios"
AT_ONCE = 64
"""With a stop rule, so many episodes are handed out before it is asked again."""

Report = Callable[[str, int, int], None]


@dataclass(frozen=True)
class PlannedEpisode:
    """One row of the table before it is driven.

    Attributes:
        point: number of the point of the space.
        planner, seed: who drives it, and with which seed.
        weight: of its point.
        values: of the parameters.
        drive: the episode.
        key: of the journal.
    """

    point: int
    planner: str
    seed: int
    weight: float
    values: Mapping[str, Value]
    drive: Drive
    key: str

    def columns(self) -> Row:
        """What the table says of it beside what was measured."""
        given = {"point": self.point, "planner": self.planner, "seed": self.seed}
        return {**given, "weight": self.weight, **self.values, "episode": self.key}


def run_sweep(
    spec: SweepSpec,
    out: Path,
    executor: Executor,
    *,
    scenes: Path | None = None,
    on_progress: Report = lambda _stage, _done, _total: None,
) -> dict[str, Any]:
    """Drive a sweep into a folder; what is there already of the same episodes is not driven again.

    The table depends on the spec, the scene and the version alone: not on who drives, in which
    order, nor on how often the sweep was killed on the way.

    Args:
        spec: what is driven.
        out: folder of ``episodes.parquet``, ``recordings/``, ``scenarios/`` and the journal.
        executor: who drives.
        scenes: folder of bundles; every worker finds it at the same path.
        on_progress: called with (stage, done, all).

    Returns:
        Figures: episodes, those that were driven now, collisions, at-fault ones; keys of the worst.

    Raises:
        CommandError: no such scene, planner, score or column.
        ExecutorError: the executor cannot go on.
    """
    assert spec.case.scene is not None
    scene = open_scene(spec.case.scene, scenes)
    _check(spec, scene)
    planned = planned_episodes(spec, scene.content_hash or "")
    recipe = recipe_of(spec.case.scene, scenes, spec.metrics)
    try:
        journal = Journal(out / JOURNAL)
    except ValueError as error:
        raise CommandError(str(error)) from error
    known = len(journal.rows)
    with journal:
        for part in _parts(planned, spec.stop):
            left = {e.key: e.drive for e in part if e.key not in journal.rows}
            total = known + len(left) if spec.stop else len(planned)

            def keep(key: str, row: Row, total: int = total) -> None:
                journal.add(key, row)
                on_progress("episodes", min(len(journal.rows), total), total)

            executor.run(recipe, left, keep)
            if spec.stop and _enough(planned, journal.rows, spec.stop) is not None:
                break
    stop = _enough(planned, journal.rows, spec.stop) if spec.stop else None
    episodes = planned if stop is None else planned[:stop]
    rows = [e.columns() | journal.rows[e.key] for e in episodes]
    write_table(out / TABLE, rows, column_types(spec))
    worst = _worst(episodes, rows, spec)
    for done, episode in enumerate(worst, start=1):
        _record(scene, episode.drive, out / RECORDINGS / f"{episode.key}.r2e")
        if spec.storyboard is not None:
            read = spec.storyboard.read(episode.values)
            write_scenario_file(_made(out / SCENARIOS), episode.key, read, spec.storyboard.source)
        on_progress("recordings", done, len(worst))
    return {
        "episodes": len(rows),
        "driven now": len(journal.rows) - known,
        "collisions": sum(bool(r["collisions"]) for r in rows),
        "at fault": sum(bool(r["at_fault"]) for r in rows),
        "errors": sum(r["error"] is not None for r in rows),
        "worst": [episode.key for episode in worst],
        "table": str(out / TABLE),
    }


def planned_episodes(spec: SweepSpec, scene_hash: str) -> list[PlannedEpisode]:
    """Rows of a sweep, in the order of its table: by point, planner, seed.

    Raises:
        CommandError: a point at which a derived parameter, or the case, is not allowed.
    """
    points, weights = points_of(spec.method, drawn_parameters(spec.parameters))
    found, keys = [], set()
    for number, (point, weight) in enumerate(zip(points, weights, strict=True)):
        try:
            values = values_at(spec.parameters, point)
            case = spec.case_at(values)
        except ValueError as error:
            raise CommandError(f"point {number} of the sweep: {error}") from error
        for planner in spec.planners:
            for seed in spec.seeds:
                drive = Drive.of(case, planner, seed)
                if (key := drive.key(scene_hash)) not in keys:
                    keys.add(key)
                    found.append(
                        PlannedEpisode(number, planner, seed, float(weight), values, drive, key)
                    )
    return found


def column_types(spec: SweepSpec) -> dict[str, type]:
    """Columns of the table, in their order."""
    types: dict[str, type] = {"point": int, "planner": str, "seed": int, "weight": float}
    for name, parameter in spec.parameters.items():
        types[name] = float
        if isinstance(parameter, IntRange):
            types[name] = int
        elif isinstance(parameter, Choice):
            kinds = {type(v) for v in parameter.values}
            types[name] = kinds.pop() if len(kinds) == 1 else float
            if kinds and str in kinds | {types[name]}:
                types[name] = str
    scores: dict[str, type] = {f"score_{name}": float for name in spec.metrics}
    return {**types, "episode": str, **COLUMNS, **scores}


def _check(spec: SweepSpec, scene: Scene) -> None:
    known = {part.partition("@")[0] for part in metrics_version().replace(",", " ").split()}
    if unknown := [name for name in spec.metrics if name not in known]:
        raise CommandError(f"no score {unknown[0]!r}; there are {', '.join(sorted(known))}")
    if spec.rank_by not in column_types(spec):
        raise CommandError(
            f"rank_by {spec.rank_by!r} is no column; there are {', '.join(column_types(spec))}"
        )
    taken = set(COLUMNS) | {"point", "planner", "seed", "weight", "episode"}
    if twice := sorted(taken & set(spec.parameters)):
        raise CommandError(f"parameter {twice[0]!r} has the name of a column; give it another")
    for planner in spec.planners:
        try:
            CameraFeed.of(scene, needs_of(load_planner(planner)))
        except (ValueError, OSError) as error:
            raise CommandError(f"planner {planner!r}: {error}") from error


def _parts(planned: list[PlannedEpisode], stop: StopRule | None) -> Iterator[list[PlannedEpisode]]:
    """What is handed out at a time: all, or as much as cannot be far beyond the stop."""
    size = AT_ONCE if stop is not None else max(len(planned), 1)
    for first in range(0, len(planned), size):
        yield planned[first : first + size]


def _enough(planned: list[PlannedEpisode], rows: Mapping[str, Row], stop: StopRule) -> int | None:
    """How many rows of the table are enough, counted in its order; None where all driven so far
    are not."""
    at_fault = collisions = 0
    for number, episode in enumerate(planned, start=1):
        if (row := rows.get(episode.key)) is None:
            return None
        at_fault += bool(row["at_fault"])
        collisions += bool(row["collisions"])
        limits = ((stop.at_fault, at_fault), (stop.collisions, collisions), (stop.episodes, number))
        if any(most is not None and count >= most for most, count in limits):
            return number
    return None


def _worst(
    episodes: list[PlannedEpisode], rows: list[Row], spec: SweepSpec
) -> list[PlannedEpisode]:
    """The highest in the column that ranks them."""

    def rank(k: int) -> tuple[float, int]:
        value = rows[k].get(spec.rank_by)
        return (math.inf if value is None or isinstance(value, str) else -float(value), k)

    ranked = sorted((k for k in range(len(rows)) if rows[k]["error"] is None), key=rank)
    return [episodes[k] for k in ranked[: spec.worst]]


def _record(scene: Scene, drive: Drive, path: Path) -> None:
    """A recording, for which the episode is driven once more: the same bits."""
    if not path.exists():
        driven = drive_episode(scene, drive, load_planner(drive.planner), keep_entries=True)
        save_recording(recording_of(scene, driven), path)


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder
