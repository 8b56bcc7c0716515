"""An episode as one file: requests, committed states, and enough to score it again.

The file is a zip archive:

- ``episode.json``: format, scene and hash, scenario, versions of scores, scores, and what the
  seed drew for the start and for objects;
- ``log.msgpack``: entries of the session from its reset on (kind, step, payload);
- ``instants.msgpack``: what the scores need of every step, and a digest of its observation;
- ``context.msgpack``: what stays the same for the scores;
- ``state.msgpack``: how the scenario differed from the scene, where it began from one;
- ``frames/<camera>/<modality>/<step>.jpg`` and ``.png``: images, where requested, and
  ``frames/<sensor>/lidar|radar/<step>.cloud``: point clouds (msgpack).

Everything but the frames is the same bytes for the same episode.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from real2sim_proto import decode, encode

from ..._files import atomic_file
from ..._npy import read_entries
from ...edit import AssetLookup, EditError, ScenarioState, pack_state, unpack_state
from ...scene import Scene
from .. import scoring
from ..common import WorldError
from ..evaluation import reactive
from ..scoring import (
    Instant,
    MetricAccumulator,
    Score,
    ScoringContext,
    metrics_version,
)
from ..world import World
from .replay import KINDS, Entry, Replayer, recorded_spec
from .rows import instant_row, read_context, read_instant

FORMAT = "real2sim-episode"
VERSION = 1
MAX_BYTES = 2 << 30
"""Of all parts when unpacked; hours of driving have a tenth of it."""
_FRAME = re.compile(r"frames/[^/]+/[^/]+/[0-9]{1,9}\.[a-z0-9]{1,8}")


class RecordingError(ValueError):
    """A file that is no recording, or one that this version does not read."""


@dataclass(frozen=True, eq=False)
class Recording:
    """One episode.

    Attributes:
        scene, scene_hash: what it ran on.
        scenario_id, scenario_revision: what it began from; None for the bare scene.
        entries: of the session, its reset first.
        context: of the scores.
        instants: of every committed state, step 0 first.
        digests: SHA-256 of every observation without images, by instant.
        scores: at the end, as they were when it was recorded.
        metrics: versions of the scores.
        state: the objects that it began with, see :func:`~real2sim_server.edit.pack_state`; None
            for the bare scene.
        frames: file names in the archive by camera and step, for images.
        drawn: what the seed drew for the start and for objects, by name.
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
        """The session before its first entry.

        Args:
            scene: that it ran on.
            assets: finds those that its scenario shows.

        Raises:
            EditError: UNKNOWN_ASSET.
            RecordingError: it began from a scenario, and an old file does not hold its state.
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
        """Scores by the metrics of this version, from the recorded instants alone."""
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
    """SHA-256 of everything that a world lets be observed, apart from images."""
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
    """The recording of an episode, by replaying it.

    Args:
        replayer: fresh, on the episode's scene.
        entries: of the episode, its reset first; returns to snapshots cut off what they undo.
        scene_hash: of the scene's bundle.
        scenario: id and revision.
        state: of that scenario.
        no_action_impact: for NeuroNCAP, see :func:`~.history.no_action_impact`.
    """
    instants: list[Instant] = []
    digests: list[str] = []
    for entry in entries:
        world = replayer.apply(entry)
        if entry.kind == "snapshot":
            continue
        # A step adds an instant; what changes the present one replaces it; a return cuts off.
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
        drawn=world.drawn,
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
            # A fixed date, so that the same episode is the same file.
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
    """The recording in a file.

    Raises:
        RecordingError: no recording, broken, too large, or of a newer version.
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        return _read_recording(file, str(path))


def recording_of_bytes(data: bytes, where: str) -> Recording:
    """The recording in the content of a file; ``where`` names it in messages.

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
    # Damage shows as almost any error, depending on where it is.
    except Exception as error:
        raise RecordingError(
            f"{where} is no episode recording, or is broken: {error or type(error).__name__}"
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
    """What the scores take from the reset today; old files hold it there alone."""
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
    """The first step at which its replay differs; None where all bits are the same.

    Of an episode with scores of other versions poses and velocities are compared: what else was
    observed holds scores.

    Args:
        recording: of the episode.
        replayer: fresh, on the same scene.

    Raises:
        RecordingError: an entry that cannot be applied.
        WorldError, EditError: one that never took effect.
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
    """SHA-256 of where ego and objects are at an instant, and how they move."""
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
    # What an entry holds is looked at where it is applied.
    except Exception as error:
        raise RecordingError(
            f"entry {number} ({entry.kind}, step {entry.step}) is damaged: {error}"
        ) from error
