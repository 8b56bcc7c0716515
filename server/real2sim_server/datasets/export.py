"""Export of a drive to a folder of labelled data."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

from ..render import Backend, encode_image
from ..scene import Camera, Scene
from .clips import Clip, ClipMakers, write_shard
from .drive import DatasetError, Drive
from .labels import HOW
from .labels.points import ROOF
from .plan import ExportPlan, PlannedClip, Variant, planned_cameras, planned_lidar, planned_shards
from .writers import LabelledDrive, writer_of
from .writers.categories import written_as_other
from .writers.plain import labels_sheet

# --- Previews ------------------------------------------------------------------------------------

# Sheets of labels over pictures for a first inspection.

MAX_PREVIEWS = 6
QUALITY = 85


def write_previews(clips: Sequence[Clip], cameras: Sequence[Camera], folder: Path) -> None:
    """Write sheets of up to 6 frames, evenly over clips and cameras, as jpg into ``folder``."""
    frames = [(clip, frame) for clip in clips for frame in clip.frames]
    count = min(MAX_PREVIEWS, len(frames) * len(cameras))
    folder.mkdir(exist_ok=True)
    for number in range(count):
        clip, frame = frames[(2 * number + 1) * len(frames) // (2 * count)]
        camera = cameras[number % len(cameras)]
        data = encode_image(labels_sheet(clip, camera, frame), "rgb", "jpeg", quality=QUALITY).data
        (folder / f"{number}.jpg").write_bytes(data)


# --- Statistics ----------------------------------------------------------------------------------

# Boxes counted by class, distance and visible share.

ZONE_M, ZONES = 20, 5
"""Width of the distance zones around the ego [m], and their number; the last is unbounded."""


def statistics_of(clips: Sequence[Clip]) -> dict[str, Any]:
    """Boxes by category, and by category and distance from the ego; boxes in images by category and
    visibility; numbers of objects and frames.
    """
    boxes: Counter[str] = Counter()
    distances: dict[str, Counter[int]] = {}
    seen: dict[str, Counter[int]] = {}
    objects: dict[str, set[tuple[str, str]]] = {}
    for clip in clips:
        for frame in clip.frames:
            categories = {o["object_id"]: o["category"] for o in frame["objects"]}
            for subject in frame["objects"]:
                category = subject["category"]
                boxes[category] += 1
                x, y = subject["T_ego_object"][0][3], subject["T_ego_object"][1][3]
                zone = min(int(math.hypot(x, y) / ZONE_M), ZONES - 1)
                distances.setdefault(category, Counter())[zone] += 1
                objects.setdefault(category, set()).add((clip.name, subject["object_id"]))
            for view in (v for views in frame["views"].values() for v in views):
                level = min(int(view["visibility"] * 5), 4)
                seen.setdefault(categories[view["object_id"]], Counter())[level] += 1
    return {
        "frames": sum(len(clip.frames) for clip in clips),
        "boxes": dict(sorted(boxes.items())),
        "tracks": {name: len(objects[name]) for name in sorted(objects)},
        "boxes_by_distance": _named(distances, _zone_name),
        "boxes_in_images_by_visibility": _named(seen, _level_name),
    }


def _named(counts: dict[str, Counter[int]], name: Any) -> dict[str, dict[str, int]]:
    return {
        category: {name(k): counts[category][k] for k in sorted(counts[category])}
        for category in sorted(counts)
    }


def _zone_name(zone: int) -> str:
    near = zone * ZONE_M
    return f"{near} m and more" if zone == ZONES - 1 else f"{near} to {near + ZONE_M} m"


def _level_name(level: int) -> str:
    return f"{level * 20} to {level * 20 + 20} %"


FORMAT = "real2sim-dataset"
VERSION = 1
LICENCE, MANIFEST, PREVIEW = "LICENSE.txt", "manifest.json", "preview"
OUTPUT_SHARE = 0.7
"""Approximate size of one written format relative to its labels."""


@dataclass(frozen=True)
class Estimate:
    """Estimated cost of an export, measured on a few frames on this machine.

    Attributes:
        frames, images: numbers of frames and images.
        nbytes: approximate size of the folder during the export [bytes].
        minutes: approximate duration [min].
    """

    frames: int
    images: int
    nbytes: int
    minutes: float


def estimate(
    drive: Drive | Sequence[Variant], plan: ExportPlan, *, backend: str | Backend = "auto"
) -> Estimate:
    """Estimate an export from three labelled frames, without writing it.

    Raises:
        DatasetError: as :func:`export_dataset`.
    """
    variants = _variants(drive)
    cameras, clips = planned_cameras(variants[0].drive, plan), planned_shards(variants, plan)
    planned_lidar(plan)
    for name in plan.formats:
        writer_of(name)
    frames = sum(len(clip.times_us) for clip in clips)
    middle = clips[len(clips) // 2]
    few = replace(middle, times_us=middle.times_us[:3])
    with tempfile.TemporaryDirectory(prefix="real2sim-dataset-") as folder:
        seconds = [time.perf_counter()]
        write_shard(
            variants[few.variant],
            plan,
            cameras,
            few,
            Path(folder) / "clip",
            backend=backend,
            on_frame=lambda: seconds.append(time.perf_counter()),
        )
        files = [path for path in Path(folder).rglob("*") if path.is_file()]
        nbytes = sum(path.stat().st_size for path in files) / len(few.times_us)
    each = min(b - a for a, b in pairwise(seconds))
    return Estimate(
        frames=frames,
        images=frames * len(cameras),
        nbytes=round(frames * nbytes * (1 + OUTPUT_SHARE * len(plan.formats))),
        minutes=frames * each / 60,
    )


def export_dataset(
    drive: Drive | Sequence[Variant],
    plan: ExportPlan,
    out: str | Path,
    *,
    made_of: Mapping[str, Any] | None = None,
    backend: str | Backend = "auto",
    makers: ClipMakers | None = None,
    on_progress: Callable[[str, int, int], None] = lambda _stage, _done, _total: None,
) -> Path:
    """Label a drive and write it to the new folder ``out``, which is created atomically.

    If an export is interrupted, its finished clips are kept next to ``out``. The same call then
    continues after the last complete clip, with the same result.

    Args:
        drive: drive to export, or the variants of a sweep, all of one scene.
        plan: export options.
        out: a folder that does not exist yet.
        made_of: further inputs of the drive (operations, episode ...), for the manifest; JSON
            values only.
        backend: renderer.
        makers: workers that make the clips, of the same drive; None for this process.
        on_progress: called with (stage, done, total): labelled frames, written formats.

    Returns:
        ``out``: a folder for each format, ``preview`` with a few sheets of labels over pictures,
        ``manifest.json`` and ``LICENSE.txt``.

    Raises:
        DatasetError: ``out`` exists, an unknown format or camera, times outside the drive, or an
            interrupted export with other options.
        RenderError, OSError: it cannot be rendered or written.
    """
    target = Path(out)
    if target.exists():
        raise DatasetError(f"{target} exists already; name a folder that does not")
    if not plan.formats:
        raise DatasetError("name at least one format")
    writers = [writer_of(name) for name in plan.formats]
    variants = _variants(drive)
    scene = variants[0].drive.scene
    cameras, clips = planned_cameras(variants[0].drive, plan), planned_shards(variants, plan)
    lidar = planned_lidar(plan)
    digest = _digest(variants, plan, made_of or {})
    work = _work_folder(target, digest)

    def make_here(left: Sequence[PlannedClip], folder: Path, step: Callable[[int], None]) -> None:
        for clip in left:
            write_shard(
                variants[clip.variant],
                plan,
                cameras,
                clip,
                folder / clip.name,
                backend=backend,
                on_frame=lambda: step(1),
            )

    make = make_here if makers is None else partial(makers.run, plan)
    opened = _labelled_clips(clips, work=work, make=make, on_progress=on_progress)
    content = LabelledDrive(
        name=scene.name,
        digest=digest,
        cameras=tuple(cameras),
        ego_size=scene.ego_size,
        period_us=plan.period_us,
        clips=opened,
        ground=scene.ground,
        licence=_licence(scene.provenance),
        lidar_position=ROOF if lidar is None else tuple(lidar.T_vehicle_lidar[:3, 3].tolist()),
    )
    result = work / "result"
    result.mkdir(exist_ok=True)
    for done, writer in enumerate(writers):
        on_progress("formats", done, len(writers))
        if not (result / writer.name).exists():
            unfinished = work / f".{writer.name}.partial"
            shutil.rmtree(unfinished, ignore_errors=True)
            unfinished.mkdir()
            writer.write(content, unfinished)
            unfinished.rename(result / writer.name)
    on_progress("formats", len(writers), len(writers))
    write_previews(opened, cameras, result / PREVIEW)
    _write_licence(result / LICENCE, scene.provenance)
    _write_manifest(result, scene, plan, opened, digest=digest, made_of=made_of or {})
    result.rename(target)
    shutil.rmtree(work)
    return target


def work_folder(out: str | Path) -> Path:
    """Folder of the finished clips of an interrupted export to ``out``."""
    target = Path(out)
    return target.with_name(f".{target.name}.export")


def _variants(drive: Drive | Sequence[Variant]) -> list[Variant]:
    return list(drive) if isinstance(drive, Sequence) else [Variant(drive)]


def _digest(variants: Sequence[Variant], plan: ExportPlan, made_of: Mapping[str, Any]) -> str:
    scene, values = variants[0].drive.scene, [dict(variant.values) for variant in variants]
    content = [scene.name, scene.content_hash, plan.digest, made_of, values]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _work_folder(target: Path, digest: str) -> Path:
    work = work_folder(target)
    if work.exists() and (work / "digest").exists() and (work / "digest").read_text() != digest:
        raise DatasetError(
            f"{work} holds a stopped export with other options; remove it, or name another folder"
        )
    work.mkdir(parents=True, exist_ok=True)
    (work / "digest").write_text(digest)
    return work


def _labelled_clips(
    clips: Sequence[PlannedClip],
    *,
    work: Path,
    make: Callable[[Sequence[PlannedClip], Path, Callable[[int], None]], None],
    on_progress: Callable[[str, int, int], None],
) -> list[Clip]:
    folder = work / "clips"
    folder.mkdir(exist_ok=True)
    left = [clip for clip in clips if not (folder / clip.name).exists()]
    total = sum(len(clip.times_us) for clip in clips)
    done = total - sum(len(clip.times_us) for clip in left)

    def step(frames: int) -> None:
        nonlocal done
        done += frames
        on_progress("frames", done, total)

    if done:
        on_progress("frames", done, total)
    make(left, folder, step)
    return [Clip.open(folder / clip.name) for clip in clips]


def _licence(provenance: Mapping[str, Any]) -> str:
    return str(provenance.get("licence") or "not stated by the source")


def _write_licence(path: Path, provenance: Mapping[str, Any]) -> None:
    source = provenance.get("dataset") or provenance.get("source") or "a recording"
    sequence = f", sequence {provenance['sequence']}" if provenance.get("sequence") else ""
    path.write_text(
        "The images and labels of this data set were made of a scene that was reconstructed from "
        f"{source}{sequence}.\nThe terms of that recording hold for them too:\n\n"
        f"{_licence(provenance)}\n",
        encoding="utf-8",
    )


def _write_manifest(
    result: Path,
    scene: Scene,
    plan: ExportPlan,
    clips: Sequence[Clip],
    *,
    digest: str,
    made_of: Mapping[str, Any],
) -> None:
    statistics = statistics_of(clips)
    others = {name: written_as_other(name, statistics["boxes"]) for name in plan.formats}
    unmade = "lidar" if planned_lidar(plan) is None else "points"
    files = sorted(p for p in result.rglob("*") if p.is_file() and p != result / MANIFEST)
    content = {
        "format": FORMAT,
        "version": VERSION,
        "digest": digest,
        "scene": scene.name,
        "scene_hash": scene.content_hash,
        "made_of": dict(made_of),
        "plan": {**asdict(plan), "splits": dict(plan.splits)},
        "clips": {clip.name: _clip_row(clip) for clip in clips},
        "statistics": statistics
        | {"boxes_of_other_categories": {k: v for k, v in others.items() if v}},
        "labels": {k: v for k, v in HOW.items() if k != unmade},
        "provenance": dict(scene.provenance),
        "licence": _licence(scene.provenance),
        "files": {
            str(path.relative_to(result)): {
                "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
                "bytes": path.stat().st_size,
            }
            for path in files
        },
    }
    (result / MANIFEST).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _clip_row(clip: Clip) -> dict[str, Any]:
    row: dict[str, Any] = {"split": clip.split, "frames": len(clip.frames)}
    return row | {"values": dict(clip.values)} if clip.values else row
