"""A sweep: points of a space, driven by planners, as one table."""

from __future__ import annotations

import json
import math
import os
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, Self

from real2sim.planners import needs_of
from real2sim_proto.sweeps import StopRule

from .._files import atomic_file
from ..console import CommandError
from ..executors import Executor, Recipe
from ..policies.planner_process import PLAN_LIMIT_S, PlannerFailedError, PlannerProcesses
from ..scene import Scene
from ..scene.io import open_scene
from ..world import warm_up
from ..world.recording import save_recording
from ..world.scoring import metrics_version
from .episode import CameraFeed, Drive, Driven, drive_episode, load, recording_of
from .parameters import Choice, IntRange, Value, drawn_parameters, points_of, values_at
from .spec import SweepSpec, write_scenario_file

if TYPE_CHECKING:
    import pyarrow as pa


# --- Journal -------------------------------------------------------------------------------------

# Rows of episodes on disk, to resume a killed sweep.

FORMAT = "real2sim-episodes 1"
MAX_BYTES = 4 << 30
MAX_LINE = 1 << 20


class Journal:
    """An append-only file with lines ``checksum key row``.

    If the program is killed during a write, the checksum of the last line is wrong and the line is
    removed. Other damaged lines are skipped, and their episodes are driven again.

    Args:
        path: path of the file; created if missing.

    Raises:
        ValueError: a file of another kind, or too large.
        OSError: it cannot be read or written.
    """

    def __init__(self, path: Path) -> None:
        self.rows: dict[str, dict[str, Any]] = {}
        self._path = path
        self._file: IO[bytes] | None = None
        self._end = self._read() if path.exists() else 0

    def __enter__(self) -> Self:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self._path.open("ab")
        self._file.truncate(self._end)
        if self._end == 0:
            self._write(FORMAT.encode() + b"\n")
        return self

    def __exit__(
        self,
        _kind: type[BaseException] | None,
        _error: BaseException | None,
        _trace: TracebackType | None,
    ) -> None:
        assert self._file is not None
        self._file.close()
        self._file = None

    def add(self, key: str, row: Mapping[str, Any]) -> None:
        """Store a row durably: after the call returns, it survives a kill of the program."""
        # Numbers are written as the shortest text that parses to the same bits.
        text = f"{key} {json.dumps(dict(row), separators=(',', ':'))}".encode()
        self._write(b"%08x %s\n" % (zlib.crc32(text), text))
        self.rows[key] = dict(row)

    def _write(self, line: bytes) -> None:
        assert self._file is not None
        self._file.write(line)
        self._file.flush()
        os.fdatasync(self._file.fileno())

    def _read(self) -> int:
        """Read all complete lines; returns the end of the last one."""
        if (size := self._path.stat().st_size) > MAX_BYTES:
            raise ValueError(f"{self._path} has {size} bytes; at most {MAX_BYTES} are read")
        end = 0
        with self._path.open("rb") as file:
            first = file.readline(MAX_LINE)
            if not first.endswith(b"\n"):
                if not (FORMAT.encode() + b"\n").startswith(first):
                    raise ValueError(f"{self._path} is not a journal of episodes")
                return 0
            if first.rstrip(b"\n") != FORMAT.encode():
                raise ValueError(f"{self._path} is not a journal of episodes of this version")
            end = file.tell()
            while (line := file.readline(MAX_LINE)).endswith(b"\n"):
                end = file.tell()
                if (found := _row(line)) is not None:
                    self.rows[found[0]] = found[1]
        return end


def open_journal(path: Path) -> Journal:
    """The journal of a sweep or a search. Raises CommandError for a file of another kind."""
    try:
        return Journal(path)
    except ValueError as error:
        raise CommandError(str(error)) from error


def _row(line: bytes) -> tuple[str, dict[str, Any]] | None:
    checksum, _, text = line.rstrip(b"\n").partition(b" ")
    try:
        if int(checksum, 16) != zlib.crc32(text):
            return None
        key, _, fields = text.decode().partition(" ")
        row = json.loads(fields)
    except (ValueError, RecursionError):
        return None
    return (key, row) if isinstance(row, dict) else None


# --- Table ---------------------------------------------------------------------------------------


def write_table(path: Path, rows: Sequence[Mapping[str, Any]], types: Mapping[str, type]) -> None:
    """Write rows atomically; equal rows give equal bytes.

    Args:
        path: path of the file.
        rows: rows in order.
        types: types of the columns, in order: ``bool``, ``int``, ``float`` or ``str``.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    known: dict[type, pa.DataType] = {
        bool: pa.bool_(),
        int: pa.int64(),
        float: pa.float64(),
        str: pa.string(),
    }
    schema = pa.schema([(name, known[kind]) for name, kind in types.items()])
    columns = [
        pa.array([_as(kind, row.get(name)) for row in rows], known[kind])
        for name, kind in types.items()
    ]
    table = pa.Table.from_arrays(columns, schema=schema)
    with atomic_file(path) as file:
        pq.write_table(table, file, compression="zstd")


def _as(kind: type, value: Any) -> Any:
    return None if value is None else kind(value)


# --- Worker --------------------------------------------------------------------------------------

Row = dict[str, Any]
"""Columns of one episode: numbers, text, booleans, None for unknown values."""

COLUMNS: Mapping[str, type] = {
    "reason": str,
    "error": str,
    "steps": int,
    "seconds": float,
    "distance": float,
    "collisions": int,
    "at_fault": int,
    "off_road": bool,
    "criticality": float,
    "min_gap": float,
    "min_margin": float,
    "min_ttc": float,
    "impact_speed": float,
    "impact_side": str,
    "impact_object": str,
    "impact_kind": str,
}
"""Measured columns of every episode, without wall-clock times, to keep tables comparable."""
PLANNER_FAILED = "planner failed"
"""Reason of an episode that ended because of the planner itself, and not of its driving."""


def recipe_of(
    scene: str,
    scenes: Path | None,
    metrics: Sequence[str] = (),
    plan_limit_s: float = PLAN_LIMIT_S,
) -> Recipe:
    """A factory of workers for a scene; arguments as for :class:`EpisodeWorker`."""
    return partial(EpisodeWorker, scene, scenes, tuple(metrics), plan_limit_s)


class EpisodeWorker:
    """Holds a scene and drives episodes in it.

    Args:
        scene, scenes: as for :func:`~..scene.io.open_scene`.
        metrics: scores to add as columns.
        plan_limit_s: time limit for each answer of a planner [s].
        threads: number of threads.
    """

    def __init__(
        self,
        scene: str,
        scenes: Path | None,
        metrics: Sequence[str],
        plan_limit_s: float,
        threads: int,
    ) -> None:
        import numba
        import torch

        numba.set_num_threads(min(threads, numba.get_num_threads()))
        torch.set_num_threads(threads)
        warm_up()
        self._scene = open_scene(scene, scenes)
        self._metrics = metrics
        self._processes = PlannerProcesses(plan_limit_s, threads=threads)

    def make(self, task: Drive) -> Row:
        """The row of an episode."""
        driven = drive_episode(self._scene, task, load(task.planner, self._processes))
        return row_of(driven, self._metrics)


def row_of(driven: Driven, metrics: Sequence[str] = ()) -> Row:
    """Columns of a finished episode, and the requested scores."""
    row: Row = dict.fromkeys(COLUMNS)
    row |= {f"score_{name}": None for name in metrics}
    row["error"] = driven.error
    if (world := driven.world) is None:
        return row | {"reason": "refused"}
    last = world.accumulator
    scores = {s.name: s.value for s in world.scores()} if metrics else {}
    return row | {
        "reason": PLANNER_FAILED if driven.error else world.reason or "over",
        "steps": world.steps,
        "seconds": world.steps * world.context.dt,
        "distance": last.distance,
        "collisions": last.collisions,
        "at_fault": sum(last.at_fault.values()),
        "off_road": last.off_road,
        "criticality": driven.criticality,
        "min_gap": _finite(driven.danger.gap),
        "min_margin": driven.danger.margin,
        "min_ttc": _finite(last.min_ttc),
        **_impact(driven),
        **{f"score_{name}": scores.get(name) for name in metrics},
    }


def _impact(driven: Driven) -> Row:
    """Columns of the first contact, if it ended the episode."""
    assert driven.world is not None
    begun = [c for c in driven.world.instant.contacts if c.begun]
    if not begun:
        return {"impact_speed": driven.world.accumulator.first_impact}
    first = min(begun, key=lambda c: (c.since, c.object_id or ""))
    return {
        "impact_speed": first.relative_speed,
        "impact_side": first.side,
        "impact_object": first.object_id,
        "impact_kind": first.category,
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


JOURNAL, TABLE = "episodes.journal", "episodes.parquet"
RECORDINGS, SCENARIOS = "recordings", "scenarios"
AT_ONCE = 64
"""With a stop rule, number of episodes to start before it is evaluated again."""

Report = Callable[[str, int, int], None]


@dataclass(frozen=True)
class PlannedEpisode:
    """One row of the table before it is driven.

    Attributes:
        point: index of the point in the space.
        planner, seed: planner and seed of the episode.
        weight: weight of the point.
        values: values of the parameters.
        drive: the episode.
        key: key in the journal.
    """

    point: int
    planner: str
    seed: int
    weight: float
    values: Mapping[str, Value]
    drive: Drive
    key: str

    def columns(self) -> Row:
        """Columns that do not depend on the result."""
        given = {"point": self.point, "planner": self.planner, "seed": self.seed}
        return {**given, "weight": self.weight, **self.values, "episode": self.key}


def run_sweep(
    spec: SweepSpec,
    out: Path,
    executor: Executor,
    *,
    scenes: Path | None = None,
    plan_limit_s: float = PLAN_LIMIT_S,
    on_progress: Report = lambda _stage, _done, _total: None,
) -> dict[str, Any]:
    """Drive a sweep and write it to a folder; episodes that are already there are skipped.

    The table depends only on the spec, the scene and the version, not on the executor, the order,
    or interruptions of the sweep.

    Args:
        spec: the sweep.
        out: folder of ``episodes.parquet``, ``recordings/``, ``scenarios/`` and the journal.
        executor: runs the episodes.
        scenes: folder of bundles, at the same path for every worker.
        plan_limit_s: time limit for each answer of a planner [s].
        on_progress: called with (stage, done, all).

    Returns:
        Figures: numbers of episodes, newly driven episodes, collisions and at-fault collisions of
        the episodes without an error, and episodes in which the planner failed; and the keys of
        the worst episodes.

    Raises:
        CommandError: no such scene, planner, score or column.
        ExecutorError: the executor cannot continue.
    """
    assert spec.case.scene is not None
    scene = open_scene(spec.case.scene, scenes)
    _check(spec, scene, plan_limit_s)
    planned = planned_episodes(spec, scene.content_hash or "")
    recipe = recipe_of(spec.case.scene, scenes, spec.metrics, plan_limit_s)
    journal = open_journal(out / JOURNAL)
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
    with PlannerProcesses(plan_limit_s) as processes:
        for done, episode in enumerate(worst, start=1):
            _record(scene, episode.drive, out / RECORDINGS / f"{episode.key}.r2e", processes)
            if spec.storyboard is not None:
                read, source = spec.storyboard.read(episode.values), spec.storyboard.source
                write_scenario_file(_made(out / SCENARIOS), episode.key, read, source)
            on_progress("recordings", done, len(worst))
    driven = [r for r in rows if r["error"] is None]
    failed = [r for r in rows if r["reason"] == PLANNER_FAILED]
    return {
        "episodes": len(rows),
        "driven now": len(journal.rows) - known,
        "collisions": sum(bool(r["collisions"]) for r in driven),
        "at fault": sum(bool(r["at_fault"]) for r in driven),
        "errors": len(rows) - len(driven),
        "planner failed": len(failed),
        "first error": f"{failed[0]['planner']}: {failed[0]['error']}" if failed else None,
        "worst": [episode.key for episode in worst],
        "table": str(out / TABLE),
    }


def planned_episodes(spec: SweepSpec, scene_hash: str) -> list[PlannedEpisode]:
    """Rows of a sweep, in the order of its table: by point, planner, seed.

    Raises:
        CommandError: a derived parameter, or the case, is invalid at a point.
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


def check_planners(planners: Sequence[str], scene: Scene, plan_limit_s: float) -> None:
    """Check that sweeps can drive planners in a scene. A planner that fails is no error here.

    Raises:
        CommandError: an unknown planner, or one whose cameras or modalities are not available.
    """
    with PlannerProcesses(plan_limit_s) as processes:
        for planner in planners:
            try:
                CameraFeed.of(scene, needs_of(load(planner, processes)))
            except (ValueError, TypeError, OSError) as error:
                raise CommandError(f"planner {planner!r}: {error}") from error
            except PlannerFailedError:
                continue


def _check(spec: SweepSpec, scene: Scene, plan_limit_s: float) -> None:
    known = {part.partition("@")[0] for part in metrics_version().replace(",", " ").split()}
    if unknown := [name for name in spec.metrics if name not in known]:
        raise CommandError(f"no score {unknown[0]!r}; there are {', '.join(sorted(known))}")
    if spec.rank_by not in column_types(spec):
        raise CommandError(
            f"rank_by {spec.rank_by!r} is not a column; there are {', '.join(column_types(spec))}"
        )
    taken = set(COLUMNS) | {"point", "planner", "seed", "weight", "episode"}
    if twice := sorted(taken & set(spec.parameters)):
        raise CommandError(f"parameter {twice[0]!r} has the name of a column; give it another")
    check_planners(spec.planners, scene, plan_limit_s)


def _parts(planned: list[PlannedEpisode], stop: StopRule | None) -> Iterator[list[PlannedEpisode]]:
    """Batches of episodes: all at once, or up to AT_ONCE with a stop rule."""
    size = AT_ONCE if stop is not None else max(len(planned), 1)
    for first in range(0, len(planned), size):
        yield planned[first : first + size]


def _enough(planned: list[PlannedEpisode], rows: Mapping[str, Row], stop: StopRule) -> int | None:
    """Number of rows that satisfy the stop rule, in table order; None if not yet satisfied."""
    at_fault = collisions = 0
    for number, episode in enumerate(planned, start=1):
        if (row := rows.get(episode.key)) is None:
            return None
        at_fault += row["error"] is None and bool(row["at_fault"])
        collisions += row["error"] is None and bool(row["collisions"])
        limits = ((stop.at_fault, at_fault), (stop.collisions, collisions), (stop.episodes, number))
        if any(most is not None and count >= most for most, count in limits):
            return number
    return None


def _worst(
    episodes: list[PlannedEpisode], rows: list[Row], spec: SweepSpec
) -> list[PlannedEpisode]:
    """The episodes with the highest values in the ranking column."""

    def rank(k: int) -> tuple[float, int]:
        value = rows[k].get(spec.rank_by)
        return (math.inf if value is None or isinstance(value, str) else -float(value), k)

    ranked = sorted((k for k in range(len(rows)) if rows[k]["error"] is None), key=rank)
    return [episodes[k] for k in ranked[: spec.worst]]


def _record(scene: Scene, drive: Drive, path: Path, processes: PlannerProcesses) -> None:
    """Create a recording by driving the episode again, with bit-identical results."""
    if path.exists():
        return
    driven = drive_episode(scene, drive, load(drive.planner, processes), keep_entries=True)
    if driven.error is None:
        save_recording(recording_of(scene, driven), path)


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder
