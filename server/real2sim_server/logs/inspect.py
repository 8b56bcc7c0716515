"""Report and drawings of a log's contents, which reveal a wrong calibration at a glance."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .check import ego_steps, gaps_between, questions_to
from .drawing import draw_frame, draw_top_view
from .driving_log import DrivingLog, LidarSweep, LogError, left_out_lines
from .images import write_image

INSPECTED_FRAMES = 3
PICTURE_WIDTH = 960


@dataclass(frozen=True)
class CameraReport:
    """A camera: size [px], horizontal field of view [rad], delay of its images [s]."""

    name: str
    width: int
    height: int
    fov: float
    image_delay: float


@dataclass(frozen=True)
class LogReport:
    """Contents of a log.

    Attributes:
        name, dataset, sequence, reader, licence: origin.
        cameras: the rig.
        frames: number of frames.
        duration: time from the first to the last frame [s].
        rate: frames per second, 0 for a single frame.
        gaps: (frame before the gap, its length [s]).
        lidar_points: minimum, median and maximum of the inspected sweeps; zeros if none can be
            read.
        lidar_range: 99th percentile of distances [m].
        tracks: number of objects by category.
        moving: number of moving objects by category.
        ego_distance: driven distance [m].
        ego_speed: maximum speed [m/s].
        left_out: by kind, one sentence for each record of the files that the log does not use.
        questions: suspicious properties, in plain words; empty for a good log.
        problems: unreadable parts of the inspected frames, one sentence each.
        drawings: files that were written.
    """

    name: str
    dataset: str
    sequence: str
    reader: str
    licence: str
    cameras: tuple[CameraReport, ...]
    frames: int
    duration: float
    rate: float
    gaps: tuple[tuple[int, float], ...]
    lidar_points: tuple[int, int, int]
    lidar_range: float
    tracks: dict[str, int]
    moving: dict[str, int]
    ego_distance: float
    ego_speed: float
    left_out: Mapping[str, tuple[str, ...]]
    questions: tuple[str, ...]
    problems: tuple[str, ...]
    drawings: tuple[str, ...] = field(default=())

    def as_json(self) -> dict[str, Any]:
        """The report as JSON values."""
        return asdict(self)

    def lines(self) -> list[str]:
        """The report as readable lines, one fact each; without the problems."""
        rate = f", {self.rate:.4g} a second" if self.rate else ""
        least, median, most = self.lidar_points
        lines = [
            f"{self.name}: {self.dataset}, {self.sequence} ({self.reader}; {self.licence})",
            f"frames    {self.frames} in {self.duration:.1f} s{rate}",
            f"ego       {self.ego_distance:.1f} m, at most {self.ego_speed:.1f} m/s",
        ]
        lines += [
            f"camera    {c.name}: {c.width}x{c.height}, {np.degrees(c.fov):.0f} degrees wide"
            + (f", {c.image_delay * 1e3:+.0f} ms" if c.image_delay else "")
            for c in self.cameras
        ] or ["camera    none"]
        lidar = f"{median} points a sweep ({least} to {most}), to {self.lidar_range:.0f} m"
        lines.append(f"lidar     {lidar if most else 'none'}")
        lines += [
            f"objects   {count} {category} ({self.moving.get(category, 0)} moving)"
            for category, count in self.tracks.items()
        ] or ["objects   none"]
        lines += [f"left out  {text}" for text in left_out_lines(self.left_out)]
        lines += [f"question  {text}" for text in self.questions]
        lines += [f"drawing   {file}" for file in self.drawings]
        return lines


def _inspected_frames(log: DrivingLog) -> tuple[int, ...]:
    """The frames that :func:`inspect_log` reads: first, middle and last of the complete ones."""
    frames = [f for f in log.seen_frames() if f not in log.absent_sweeps]
    frames = frames or list(range(log.frame_count))
    chosen = np.linspace(0, len(frames) - 1, INSPECTED_FRAMES).tolist()
    return tuple(sorted({frames[round(i)] for i in chosen}))


def inspect_log(log: DrivingLog, out: str | Path | None = None) -> LogReport:
    """Inspect a log from a few of its frames. Unreadable parts are in ``problems``.

    Args:
        log: any log.
        out: folder for drawings, created if missing: ``frame_%06d.jpg``, all cameras of a frame
            with boxes and points coloured by depth, and ``top.png``, the middle frame from above.
            None draws nothing.
    """
    sweeps: dict[int, LidarSweep] = {}
    problems: list[str] = []
    for frame in _inspected_frames(log):
        try:
            sweeps[frame] = log.lidar(frame)
        except LogError as error:
            problems.append(str(error))
    moving = [t for t in log.tracks if t.trajectory.moves]
    counts = [len(s.points) for s in sweeps.values()] or [0]
    far = [np.linalg.norm(s.points - s.origin, axis=1) for s in sweeps.values() if len(s.points)]
    steps = np.diff(log.frame_times_us) * 1e-6
    return LogReport(
        name=log.name,
        dataset=str(log.provenance.get("dataset", "unknown")),
        sequence=str(log.provenance.get("sequence", log.name)),
        reader=str(log.provenance.get("reader", "unknown")),
        licence=str(log.provenance.get("licence", "unknown")),
        cameras=_cameras(log),
        frames=log.frame_count,
        duration=float(steps.sum()),
        rate=1 / float(np.median(steps)) if len(steps) else 0.0,
        gaps=gaps_between(steps),
        lidar_points=(min(counts), int(np.median(counts)), max(counts)),
        lidar_range=float(np.percentile(np.concatenate(far), 99)) if far else 0.0,
        tracks=dict(sorted(Counter(t.category for t in log.tracks).items())),
        moving=dict(sorted(Counter(t.category for t in moving).items())),
        ego_distance=float(ego_steps(log).sum()),
        ego_speed=float((ego_steps(log) / steps).max()) if len(steps) else 0.0,
        left_out=log.left_out,
        questions=tuple(questions_to(log, sweeps)),
        drawings=() if out is None else tuple(_draw(log, sweeps, Path(out), problems)),
        problems=tuple(problems),
    )


def _cameras(log: DrivingLog) -> tuple[CameraReport, ...]:
    return tuple(
        CameraReport(
            name=camera.name,
            width=camera.width,
            height=camera.height,
            fov=float(2 * np.arctan(camera.width / 2 / camera.K[0, 0])),
            image_delay=_delay(log, camera.name),
        )
        for camera in log.rig
    )


def _delay(log: DrivingLog, camera: str) -> float:
    times = log.image_times_us.get(camera, log.frame_times_us)
    return float(np.median(times - log.frame_times_us)) * 1e-6


def _draw(
    log: DrivingLog, sweeps: dict[int, LidarSweep], out: Path, problems: list[str]
) -> list[str]:
    """Files of the drawings; unreadable images are skipped and added to ``problems``."""
    out.mkdir(parents=True, exist_ok=True)
    files: list[str] = []
    for frame in sweeps:
        pictures = []
        for name in log.rig.names:
            if not log.has_image(name, frame):
                continue
            try:
                pictures.append(draw_frame(log, name, frame))
            except LogError as error:
                problems.append(str(error))
        if pictures:
            path = out / f"frame_{frame:06d}.jpg"
            write_image(path, _montage(pictures))
            files.append(str(path))
    if not sweeps:
        return files
    path = out / "top.png"
    middle = sorted(sweeps)[len(sweeps) // 2]
    write_image(path, draw_top_view(log, middle, sweeps[middle]))
    return [*files, str(path)]


def _montage(pictures: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Pictures side by side, up to three in a row, scaled to equal width."""
    import cv2

    width = min(PICTURE_WIDTH if len(pictures) > 1 else 1920, max(p.shape[1] for p in pictures))
    small = [
        cv2.resize(p, (width, round(p.shape[0] * width / p.shape[1])), interpolation=cv2.INTER_AREA)
        for p in pictures
    ]
    height = max(p.shape[0] for p in small)
    padded = [np.pad(p, ((0, height - p.shape[0]), (0, 0), (0, 0))) for p in small]
    columns = min(3, len(padded))
    while len(padded) % columns:
        padded.append(np.zeros_like(padded[0]))
    rows = [np.concatenate(padded[i : i + columns], 1) for i in range(0, len(padded), columns)]
    return np.concatenate(rows, axis=0)
