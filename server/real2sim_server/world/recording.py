"""Recordings: an episode in one file, with requests, committed states and score inputs.

The file is a zip archive:

- ``episode.json``: format, scene and its hash, scenario, scores and their versions, and values
  sampled for the start and the objects;
- ``log.msgpack``: entries of the session from its reset (kind, step, payload);
- ``instants.msgpack``: score inputs of every step, and a digest of its observation;
- ``context.msgpack``: constants of the scores;
- ``state.msgpack``: differences between scenario and scene, if the episode started from a scenario;
- ``frames/<camera>/<modality>/<step>.jpg`` and ``.png``: requested images, and
  ``frames/<sensor>/lidar|radar/<step>.cloud``: point clouds (msgpack).

All parts except the frames are byte-identical for the same episode.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any, get_args

import numpy as np
from numpy.typing import NDArray

from real2sim_proto import decode, encode

from .._files import atomic_file
from .._npy import read_entries
from ..edit import AssetLookup, EditError, ScenarioState, pack_state, unpack_state
from ..geometry import Float
from ..scene import Scene
from . import scoring
from .common import WorldError
from .observation import reactive
from .path import LoopTransform
from .plan import PlannedTrajectory
from .replay import KINDS, Entry, Replayer, recorded_spec
from .scoring import (
    ContactRecord,
    EgoSample,
    Instant,
    MetricAccumulator,
    ObjectSamples,
    Score,
    ScoringContext,
    metrics_version,
)
from .scoring.instant import Side
from .storyboard.program import ShownSignal
from .world import World

# --- Plain values --------------------------------------------------------------------------------

# All values are validated on reading: scoring kernels do not check indices, so shapes, lengths and
# values must be right.

MAX_LENGTH_M = 1e6
"""Maximum length of a route or lane [m]; they are divided into segments of less than a metre."""

MAX_NUMBER = 1e12
"""Maximum of any length, speed or mass, SI units."""


def instant_row(instant: Instant, digest: str) -> dict[str, Any]:
    """An instant and the digest of its observation as plain values."""
    others = instant.others
    row: dict[str, Any] = {
        "step": instant.step,
        "t_us": instant.t_us,
        "ego": list(instant.ego),
        "ids": list(others.ids),
        "categories": list(others.categories),
        "centres": others.centres,
        "yaws": others.yaws,
        "sizes": others.sizes,
        "velocities": others.velocities,
        "contacts": [asdict(c) | {"impulse": list(c.impulse)} for c in instant.contacts],
        "secondary": instant.secondary,
        "digest": digest,
    }
    if instant.plan is not None:
        row["plan"] = [instant.plan.times_us.tolist(), instant.plan.poses.tolist()]
    if instant.loop is not None:
        row["seam"] = list(instant.loop)
    if instant.signals:
        row["signals"] = [[s.signal_id, s.state, s.stop_line] for s in instant.signals]
    return row


def read_instant(row: Mapping[str, Any]) -> tuple[Instant, str]:
    """Inverse of :func:`instant_row`.

    Raises:
        ValueError, KeyError, TypeError: invalid row.
    """
    ids = tuple(_string(name) for name in _list(row["ids"]))
    count = len(ids)
    categories = tuple(_string(name) for name in _list(row["categories"]))
    if len(categories) != count:
        raise ValueError(f"{len(categories)} categories of {count} objects")
    instant = Instant(
        step=_integer(row["step"]),
        t_us=_integer(row["t_us"]),
        ego=EgoSample(*_numbers(row["ego"], (len(EgoSample._fields),), "ego").tolist()),
        others=ObjectSamples(
            ids=ids,
            categories=categories,
            centres=_numbers(row["centres"], (count, 3), "centres"),
            yaws=_numbers(row["yaws"], (count,), "yaws"),
            sizes=_numbers(row["sizes"], (count, 3), "sizes"),
            velocities=_numbers(row["velocities"], (count, 2), "velocities"),
        ),
        contacts=tuple(_contact(c) for c in _list(row["contacts"])),
        secondary=_integer(row["secondary"]),
        plan=_plan(row["plan"]) if "plan" in row else None,
        loop=LoopTransform(*_numbers(row["seam"], (3,), "seam").tolist())
        if "seam" in row
        else None,
        signals=tuple(_signal(s) for s in _list(row.get("signals", []))),
    )
    return instant, _string(row["digest"])


def read_context(fields: Mapping[str, Any]) -> ScoringContext:
    """Inverse of :meth:`ScoringContext.fields`.

    Raises:
        ValueError, KeyError, TypeError: invalid fields.
    """
    for name in ("dt", "rear_overhang", "ego_mass", "corridor", "lane", "start_s", "route_end_s"):
        _number(fields[name], name)
    for name in ("speed_limit", "no_action_impact"):
        if fields.get(name) is not None:
            _number(fields[name], name)
    if _integer(fields.get("warmup_steps", 0)) < 0:
        raise ValueError(f"{fields['warmup_steps']} steps of warm-up")
    for name in ("background", "reactive"):
        if not isinstance(fields.get(name, False), bool):
            raise ValueError(f"{name} is {str(fields[name])[:40]!r}, neither true nor false")
    expert = _numbers(fields["expert_s"], (None,), "expert_s")
    if _integer(fields["horizon"]) + 1 != len(expert) or fields["dt"] <= 0:
        raise ValueError(f"horizon {fields['horizon']} does not fit {len(expert)} expert positions")
    if fields["ego_mass"] <= 0:
        raise ValueError(f"an ego_mass of {fields['ego_mass']} kg; it is above 0")
    _numbers(fields["ego_size"], (3,), "ego_size")
    _numbers([list(pair) for pair in fields["history"]] or np.zeros((0, 2)), (None, 2), "history")
    route = _way(fields["route"], "route")
    if len(route) < 2 or (route[0] == route[1]).all() or (route[-1] == route[-2]).all():
        raise ValueError("the route has no direction at an end")
    lanes = [_way(line, "lane") for line in _list(fields["lanes"])]
    return ScoringContext.from_fields(dict(fields) | {"route": route, "lanes": lanes})


def _way(value: Any, what: str) -> Float:
    points = _numbers(value, (None, 2), what)
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    if length > MAX_LENGTH_M:
        raise ValueError(f"a {what} of {length:.0f} m; allowed are {MAX_LENGTH_M:.0f} m")
    return points


def _contact(fields: Mapping[str, Any]) -> ContactRecord:
    x, y = _numbers(fields["impulse"], (2,), "impulse").tolist()
    for name in ("relative_speed", "ego_speed", "object_speed"):
        _number(fields[name], name)
    _number(fields.get("since", 1.0), "since")
    if fields["object_id"] is not None:
        _string(fields["object_id"])
    if fields["side"] not in get_args(Side) or not isinstance(fields["begun"], bool):
        raise ValueError(f"a contact on side {fields['side']!r}")
    _string(fields["category"])
    return ContactRecord(**dict(fields) | {"impulse": (x, y)})


def _signal(value: Any) -> ShownSignal:
    name, state, line = _list(value)
    if line is None:
        return ShownSignal(_string(name), _string(state), None)
    x, y, heading = _numbers(line, (3,), "stop line").tolist()
    return ShownSignal(_string(name), _string(state), (x, y, heading))


def _plan(value: Any) -> PlannedTrajectory:
    times, poses = value
    whole = np.array([_integer(t) for t in _list(times)], np.int64)
    if not len(whole) or (np.diff(whole) <= 0).any():
        raise ValueError("the times of a plan do not increase")
    return PlannedTrajectory(whole, _numbers(poses, (len(whole), 3), "plan"))


def _numbers(value: Any, shape: tuple[int | None, ...], what: str) -> Float:
    """Float64 array of a shape, where None stands for any length.

    Always a writable copy: kernels would be recompiled for read-only arrays.
    """
    array: NDArray[np.float64] = np.array(value, dtype=np.float64)
    fits = len(shape) == array.ndim and all(
        wanted in (None, given) for wanted, given in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise ValueError(f"{what} has shape {list(array.shape)}, not {list(shape)}")
    if not (np.abs(array) <= MAX_NUMBER).all():
        raise ValueError(f"{what} holds values that are not finite, or beyond {MAX_NUMBER:g}")
    return array


def _number(value: Any, what: str) -> None:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not (is_number and abs(value) <= MAX_NUMBER):
        raise ValueError(f"{what} is {str(value)[:40]!r}, no number within {MAX_NUMBER:g}")


def _integer(value: Any) -> int:
    if type(value) is not int or abs(value) > 1 << 62:
        raise ValueError(f"{value!r} is not a whole number of 63 bits")
    return value


def _string(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"a {type(value).__name__} where text must be")
    return value


def _list(value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError(f"a {type(value).__name__} where a list must be")
    return value


FORMAT = "real2sim-episode"
VERSION = 1
MAX_BYTES = 2 << 30
"""Maximum unpacked size; hours of driving take a tenth of it."""
_FRAME = re.compile(r"frames/[^/]+/[^/]+/[0-9]{1,9}\.[a-z0-9]{1,8}")


class RecordingError(ValueError):
    """An invalid recording, or one that this version cannot read."""


@dataclass(frozen=True, eq=False)
class Recording:
    """One episode.

    Attributes:
        scene, scene_hash: the scene.
        scenario_id, scenario_revision: the scenario; None for the scene without one.
        entries: entries of the session, its reset first.
        context: constants of the scores.
        instants: one per committed state, step 0 first.
        digests: SHA-256 of each observation without images, by instant.
        scores: final scores at recording time.
        metrics: versions of the scores.
        state: objects at the start, see :func:`~real2sim_server.edit.pack_state`; None for the
            scene without a scenario.
        frames: file names in the archive by camera and step, for images.
        drawn: values sampled for the start and the objects, by name.
    """

    scene: str
    scene_hash: str
    scenario_id: str | None
    scenario_revision: int | None
    entries: tuple[Entry, ...]
    context: ScoringContext
    instants: tuple[Instant, ...]
    digests: tuple[str, ...]
    scores: tuple[dict[str, Any], ...]
    metrics: str
    state: bytes | None = field(default=None, repr=False)
    frames: Mapping[str, bytes] = field(default_factory=dict, repr=False)
    drawn: Mapping[str, float] = field(default_factory=dict)

    def replayer(self, scene: Scene, assets: AssetLookup | None = None) -> Replayer:
        """A replayer of the session, before its first entry.

        Args:
            scene: scene of the recording.
            assets: finds the assets of the scenario.

        Raises:
            EditError: UNKNOWN_ASSET.
            RecordingError: the recording started from a scenario whose state an old file lacks.
        """
        initial = ScenarioState.of(scene, assets=assets)
        if self.state is not None:
            initial = unpack_state(initial, self.state)
        elif self.scenario_id is not None:
            raise RecordingError(
                f"the episode began from scenario {self.scenario_id!r} at revision "
                f"{self.scenario_revision}, which is not in the file; it can still be scored"
            )
        return Replayer.on(scene, initial)

    def rescore(self) -> list[Score]:
        """Scores by the current metrics, computed from the recorded instants alone."""
        return scoring.scores_of(self.accumulators()[-1], self.context)

    def accumulators(self) -> list[MetricAccumulator]:
        """The accumulator at every instant."""
        accumulator = scoring.begin_accumulator(self.instants[0], self.context)
        accumulators = [accumulator]
        for instant in self.instants[1:]:
            accumulator = scoring.update_accumulator(accumulator, instant, self.context)
            accumulators.append(accumulator)
        return accumulators


def digest(world: World) -> str:
    """SHA-256 of the observation of a world, without images."""
    fields = world.observe().obs_fields()
    fields["agents"] = [
        world.agents.positions,
        world.agents.quaternions,
        world.agents.velocities,
        [o.object_id for o in world.agents.objects],
    ]
    return hashlib.sha256(encode(fields)).hexdigest()


def record(
    replayer: Replayer,
    entries: Sequence[Entry],
    *,
    scene_hash: str,
    scenario: tuple[str, int] | None = None,
    state: ScenarioState | None = None,
    no_action_impact: float | None = None,
) -> Recording:
    """Create the recording of an episode by replaying it.

    Args:
        replayer: new replayer on the episode's scene.
        entries: entries of the episode, its reset first; snapshot restores drop what they undo.
        scene_hash: hash of the scene's bundle.
        scenario: id and revision.
        state: state of that scenario.
        no_action_impact: value for NeuroNCAP, see :func:`~.replay.no_action_impact`.
    """
    instants: list[Instant] = []
    digests: list[str] = []
    for entry in entries:
        world = replayer.apply(entry)
        if entry.kind == "snapshot":
            continue
        # A step appends an instant, an edit replaces the last one, and a restore drops later ones.
        del instants[world.steps :], digests[world.steps :]
        instants.append(world.instant)
        digests.append(digest(world))
    context = _with_no_action_impact(world.context, no_action_impact)
    scores = scoring.scores_of(world.accumulator, context)
    return Recording(
        scene=world.scene.name,
        scene_hash=scene_hash,
        scenario_id=scenario[0] if scenario else None,
        scenario_revision=scenario[1] if scenario else None,
        entries=tuple(entries),
        context=context,
        instants=tuple(instants),
        digests=tuple(digests),
        scores=tuple(s.fields() for s in scores),
        metrics=metrics_version(),
        state=pack_state(state) if state is not None else None,
        drawn=world.sampled,
    )


def _with_no_action_impact(context: ScoringContext, impact: float | None) -> ScoringContext:
    if impact is None:
        return context
    return ScoringContext.from_fields(context.fields() | {"no_action_impact": impact})


# --- file -------------------------------------------------------------------------------------


def to_bytes(recording: Recording) -> bytes:
    """The recording as a file."""
    about = {
        "format": FORMAT,
        "version": VERSION,
        "scene": recording.scene,
        "scene_hash": recording.scene_hash,
        "scenario_id": recording.scenario_id,
        "scenario_revision": recording.scenario_revision,
        "metrics": recording.metrics,
        "scores": list(recording.scores),
        "steps": len(recording.instants) - 1,
        **({"drawn": dict(recording.drawn)} if recording.drawn else {}),
    }
    entries = [[e.kind, e.step, e.payload] for e in recording.entries]
    rows = [instant_row(i, d) for i, d in zip(recording.instants, recording.digests, strict=True)]
    parts = {
        "episode.json": json.dumps(about, indent=2, allow_nan=False).encode(),
        "log.msgpack": encode({"entries": entries}),
        "instants.msgpack": encode({"instants": rows}),
        "context.msgpack": encode(recording.context.fields()),
        **({"state.msgpack": recording.state} if recording.state is not None else {}),
        **recording.frames,
    }
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, data in parts.items():
            # A fixed date, so that the file is deterministic.
            info = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
            packed = zipfile.ZIP_STORED if name.startswith("frames/") else zipfile.ZIP_DEFLATED
            archive.writestr(info, data, compress_type=packed)
    return file.getvalue()


def save_recording(recording: Recording, path: Path) -> Path:
    """Write the recording atomically."""
    with atomic_file(path) as file:
        file.write(to_bytes(recording))
    return path


def load_recording(path: Path) -> Recording:
    """Read a recording from a file.

    Raises:
        RecordingError: the file is not a recording, damaged, too large, or of a newer version.
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        return _read_recording(file, str(path))


def recording_of_bytes(data: bytes, where: str) -> Recording:
    """Read a recording from the content of a file; ``where`` names it in error messages.

    Raises:
        RecordingError: as :func:`load_recording`.
    """
    return _read_recording(io.BytesIO(data), where)


def _read_recording(file: IO[bytes], where: str) -> Recording:
    try:
        with zipfile.ZipFile(file) as archive:
            return _of_parts(read_entries(archive, max_bytes=MAX_BYTES))
    except RecordingError as error:
        raise RecordingError(f"{where}: {error}") from error
    # A damaged file can raise almost any error.
    except Exception as error:
        raise RecordingError(
            f"{where} is not an episode recording, or is broken: {error or type(error).__name__}"
        ) from error


def _of_parts(parts: Mapping[str, bytes]) -> Recording:
    about = json.loads(parts["episode.json"])
    if about.get("format") != FORMAT or about.get("version") != VERSION:
        raise RecordingError(
            f"format {about.get('format')!r} version {about.get('version')!r}; "
            f"this program reads {FORMAT!r} version {VERSION}"
        )
    log, instants, context = (
        decode(parts[f"{name}.msgpack"], max_bytes=MAX_BYTES)
        for name in ("log", "instants", "context")
    )
    rows = [read_instant(row) for row in instants["instants"]]
    if not rows:
        raise RecordingError("it holds no instant")
    entries = tuple(_entry(*entry) for entry in log["entries"])
    frames = {name: data for name, data in parts.items() if name.startswith("frames/")}
    for name in frames:
        if not _FRAME.fullmatch(name):
            raise RecordingError(f"an image is called {name!r}")
    return Recording(
        scene=_text(about, "scene"),
        scene_hash=_text(about, "scene_hash"),
        scenario_id=_text(about, "scenario_id") if about["scenario_id"] is not None else None,
        scenario_revision=about["scenario_revision"],
        entries=entries,
        context=read_context(_younger_context(entries) | context),
        instants=tuple(instant for instant, _ in rows),
        digests=tuple(found for _, found in rows),
        scores=tuple(dict(score) for score in about["scores"]),
        metrics=_text(about, "metrics"),
        state=parts.get("state.msgpack"),
        frames=frames,
        drawn={str(k): float(v) for k, v in about.get("drawn", {}).items()},
    )


def _younger_context(entries: Sequence[Entry]) -> dict[str, Any]:
    """Context fields that old files store only in the reset."""
    if not entries or entries[0].kind != "reset":
        return {}
    spec = recorded_spec(entries[0])
    return {
        "warmup_steps": spec.warmup_us // spec.dt_us,
        "background": spec.contact.background,
        "reactive": reactive(spec),
    }


def _entry(kind: Any, step: Any, payload: Any) -> Entry:
    if kind not in KINDS or type(step) is not int or not isinstance(payload, bytes):
        raise RecordingError(f"an entry of kind {str(kind)[:40]!r} is not understood")
    return Entry(kind, step, payload)


def _text(about: Mapping[str, Any], key: str) -> str:
    value = about[key]
    if not isinstance(value, str):
        raise RecordingError(f"{key!r} is a {type(value).__name__}, no text")
    return value


def first_difference(recording: Recording, replayer: Replayer) -> int | None:
    """The first step at which the replay differs; None if it is bitwise identical.

    If the recording has scores of other versions, only poses and velocities are compared, because
    observations contain scores.

    Args:
        recording: recording of the episode.
        replayer: new replayer on the same scene.

    Raises:
        RecordingError: an entry cannot be applied.
        WorldError, EditError: an entry is rejected.
    """
    same_scores = recording.metrics == metrics_version()
    then = recording.digests if same_scores else [_motion(i) for i in recording.instants]
    now: list[str] = []
    for number, entry in enumerate(recording.entries):
        world = _applied(replayer, entry, number)
        if entry.kind == "snapshot":
            continue
        del now[world.steps :]
        now.append(digest(world) if same_scores else _motion(world.instant))
    differing = [k for k, (a, b) in enumerate(zip(now, then, strict=False)) if a != b]
    if not differing and len(now) != len(then):
        return min(len(now), len(then))
    return differing[0] if differing else None


def _motion(instant: Instant) -> str:
    """SHA-256 of the poses and velocities of ego and objects at an instant."""
    others = instant.others
    fields = {
        "clock": [instant.step, instant.t_us],
        "ego": list(instant.ego),
        "ids": list(others.ids),
        "objects": [others.centres, others.yaws, others.sizes, others.velocities],
    }
    return hashlib.sha256(encode(fields)).hexdigest()


def _applied(replayer: Replayer, entry: Entry, number: int) -> World:
    try:
        return replayer.apply(entry)
    except (WorldError, EditError):
        raise
    # The payload is validated on application.
    except Exception as error:
        raise RecordingError(
            f"entry {number} ({entry.kind}, step {entry.step}) is damaged: {error}"
        ) from error
