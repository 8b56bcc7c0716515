"""Checks the files of a log before hours of work are spent on it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from .driving_log import ChecksFiles, DrivingLog, LogError, damage_named

FARTHEST_M = 100_000.0
"""Of the world's zero; single precision is 8 mm there."""
NAMED_FILES = 5
"""How many bad images, and how many bad sweeps, are named in a summary."""


@dataclass(frozen=True)
class LogCheck:
    """What :func:`check_log` looked at, and what is wrong.

    Attributes:
        image_headers, sweep_headers: how many files had their header checked.
        images, sweeps: how many had all of their contents read.
        table_problems: what is wrong with times, poses, boxes and cameras, a sentence each.
        image_problems: one sentence for each bad image; it names the file.
        sweep_problems: one sentence for each bad sweep; it names the file.
        empty_sweeps: frames whose sweep holds no points, where those of other frames do.
    """

    image_headers: int
    sweep_headers: int
    images: int
    sweeps: int
    table_problems: tuple[str, ...]
    image_problems: tuple[str, ...]
    sweep_problems: tuple[str, ...]
    empty_sweeps: tuple[int, ...]

    @property
    def problems(self) -> tuple[str, ...]:
        """All of them, one sentence each; empty for a good log."""
        return (*self.table_problems, *self.image_problems, *self.sweep_problems)

    def as_json(self) -> dict[str, Any]:
        """JSON values only."""
        return asdict(self)

    def summary(self) -> tuple[str, ...]:
        """The problems for people: how many files are bad, the first of them, what to do."""
        lines = list(self.table_problems)
        for kind, bad, looked_at in (
            ("image", self.image_problems, max(self.image_headers, self.images)),
            ("sweep", self.sweep_problems, max(self.sweep_headers, self.sweeps)),
        ):
            if bad:
                lines.append(f"{len(bad)} of {_count(looked_at, kind)} cannot be used:")
                lines += [f"  {problem}" for problem in bad[:NAMED_FILES]]
            if len(bad) > NAMED_FILES:
                lines.append(f"  and {len(bad) - NAMED_FILES} more")
        if self.image_problems or self.sweep_problems:
            lines.append("write these files again, or write the log without their frames")
        return tuple(lines)

    def done(self) -> str:
        """What was looked at, such as "headers of 120 images and 60 sweeps checked, contents of 3
        sweeps read"."""
        headers = _listed((self.image_headers, "image"), (self.sweep_headers, "sweep"))
        contents = _listed((self.images, "image"), (self.sweeps, "sweep"))
        told = ([f"headers of {headers} checked"] if headers else []) + (
            [f"contents of {contents} read"] if contents else []
        )
        return ", ".join(told) or "there are no files to check"

    def raise_for_problems(self) -> None:
        """Raise LogError with the :meth:`summary` where there are problems."""
        if self.problems:
            raise LogError("\n".join(self.summary()))


def _count(number: int, kind: str) -> str:
    return f"{number} {kind}{'' if number == 1 else 's'}"


def _listed(*counts: tuple[int, str]) -> str:
    return " and ".join(_count(number, kind) for number, kind in counts if number)


def check_log(
    log: DrivingLog,
    *,
    sweeps: Collection[int] | None = None,
    decode_images: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
) -> LogCheck:
    """Look at every file of a log; a bad one does not keep the others from being looked at.

    The header of each image says its size and its end mark whether it is whole; the header of each
    sweep says which arrays it holds. A source without headers (:class:`ChecksFiles`) has all its
    sweeps read, and its images only where ``decode_images`` asks for it.

    Args:
        log: any log.
        sweeps: frames whose sweeps are read, which finds values that are not finite; None for all.
        decode_images: decode every image, which finds damage inside files.
        on_progress: called with (done, total) after each frame.
    """
    source = log.source if isinstance(log.source, ChecksFiles) else None
    image_problems: list[str] = []
    sweep_problems: list[str] = []
    points: dict[int, int | None] = {}
    headers = decoded = read = 0
    for frame in range(log.frame_count):
        for camera in log.rig.names:
            try:
                if decode_images:
                    decoded += 1
                    log.image(camera, frame)
                elif source is not None:
                    headers += 1
                    with damage_named(f"image of camera {camera!r} at frame {frame}"):
                        source.check_image(camera, frame)
            except LogError as error:
                image_problems.append(str(error))
        try:
            if source is None or sweeps is None or frame in sweeps:
                read += 1
                points[frame] = len(log.lidar(frame).points)
            else:
                with damage_named(f"sweep of frame {frame}"):
                    points[frame] = source.check_sweep(frame)
        except LogError as error:
            sweep_problems.append(str(error))
        if on_progress is not None:
            on_progress(frame + 1, log.frame_count)
    empty = tuple(frame for frame, count in points.items() if count == 0)
    return LogCheck(
        image_headers=headers,
        # Reading a sweep checks its header too, but says more.
        sweep_headers=log.frame_count if read < log.frame_count else 0,
        images=decoded,
        sweeps=read,
        table_problems=(*_cameras(log), *_times(log), *_place(log), *_tracks(log)),
        image_problems=tuple(image_problems),
        sweep_problems=tuple(sweep_problems),
        empty_sweeps=empty if len(empty) < len(points) else (),
    )


def _cameras(log: DrivingLog) -> Iterator[str]:
    if len(log.rig):
        return
    known = list(log.provenance.get("cameras_without_images", []))
    named = f"its cameras {known} have no images" if known else "it has no cameras"
    yield (
        f"log {log.name!r} cannot be trained on: {named}; put the images where the data set has "
        "them (LiDAR and boxes can be used as they are)"
    )


def _times(log: DrivingLog) -> Iterator[str]:
    times = log.frame_times_us
    if len(times) == 0 or (np.diff(times) <= 0).any():
        yield f"log {log.name!r}: frame times must increase strictly, at least one"
    for camera in log.rig.names:
        given = log.image_times_us.get(camera, times)
        if given.shape != times.shape:
            yield (
                f"log {log.name!r}: camera {camera!r} has {len(given)} image times for "
                f"{len(times)} frames"
            )
        for t_us in given[~np.array([log.ego.covers(int(t)) for t in given], bool)][:1]:
            yield (
                f"log {log.name!r}: ego poses cover [{log.ego.start_us}, {log.ego.end_us}] us, "
                f"but camera {camera!r} takes an image at {t_us} us"
            )


def _place(log: DrivingLog) -> Iterator[str]:
    far = float(np.abs(log.ego.positions).max())
    if far > FARTHEST_M:
        yield (
            f"log {log.name!r}: its drive lies {far / 1e3:,.0f} km from the world's zero, where "
            f"Gaussians could only move by {float(np.spacing(np.float32(far))):.2g} m; subtract "
            "the first pose's position from all poses and boxes"
        )


def _tracks(log: DrivingLog) -> Iterator[str]:
    names: set[str] = set()
    for track in log.tracks:
        if track.object_id in names:
            yield f"log {log.name!r}: object {track.object_id!r} is there twice"
        names.add(track.object_id)
        if not (np.isfinite(track.size).all() and min(track.size) > 0):
            yield (
                f"log {log.name!r}: object {track.object_id!r} needs a positive length, width and "
                f"height, not {track.size}"
            )
