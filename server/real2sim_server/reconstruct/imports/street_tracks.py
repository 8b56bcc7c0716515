"""Which column of a Street Gaussians ``actor_pose`` belongs to which track.

The checkpoint holds corrections [frames, columns] without saying whose they are; columns are
dealt out by ``get_obj_pose_tracking`` in lib/utils/waymo_utils.py of that program when it reads the
dataset, so the same has to be done here, step by step.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...geometry.transform import Float, apply_transform
from ...scene.trajectory import leads_anywhere
from .checkpoint import CheckpointError, read_json
from .street_folder import StreetFolder

IGNORED_CLASSES = ("sign", "misc")
EMPTY = -1


@dataclass(frozen=True, eq=False)
class StreetTracks:
    """Tracks of moving objects, laid out as in the checkpoint.

    Attributes:
        ids: [F, M] int64, track number of each column, -1 where it is free.
        positions: [F, M, 3] float64, box centres in the vehicle frame of the frame [m].
        headings: [F, M] float64, about the vehicle's z [rad].
        classes: by track number.
        sizes: (length, width, height) by track number, the largest of all frames [m].
    """

    ids: NDArray[np.int64]
    positions: Float
    headings: Float
    classes: Mapping[int, str]
    sizes: Mapping[int, tuple[float, float, float]]

    @property
    def track_ids(self) -> list[int]:
        """Numbers of all tracks, in order of appearance in the file."""
        return list(self.classes)


@dataclass(frozen=True)
class _TrackRow:
    """One line of ``track_info.txt``."""

    frame: int
    track: int
    category: str
    size: tuple[float, float, float]
    position: tuple[float, float, float]
    heading: float


def read_street_tracks(
    folder: Path, frames: StreetFolder, *, cameras: tuple[int, ...], tracker: bool
) -> StreetTracks:
    """Tracks that were moving and seen by ``cameras``, in the columns they were trained in.

    Raises:
        CheckpointError: naming the file that is missing or does not fit.
    """
    rows = _visible_rows(folder, cameras, "_castrack" if tracker else "")
    # Sizes come from all frames of the folder, poses only from those trained on.
    sizes: dict[int, tuple[float, float, float]] = {}
    classes: dict[int, str] = {}
    for row in rows:
        known = sizes.get(row.track, row.size)
        sizes[row.track] = (
            max(known[0], row.size[0]),
            max(known[1], row.size[1]),
            max(known[2], row.size[2]),
        )
        classes.setdefault(row.track, row.category)
    ids, positions, headings = _deal_columns(rows, frames)
    moving = [t for t in classes if _moves(ids, positions, frames.ego, t)]
    ids[~np.isin(ids, moving)] = EMPTY
    ids, positions, headings = _close_gaps(ids, positions, headings)
    return StreetTracks(
        ids, positions, headings, {t: classes[t] for t in moving}, {t: sizes[t] for t in moving}
    )


def _visible_rows(folder: Path, cameras: tuple[int, ...], suffix: str) -> list[_TrackRow]:
    file = folder / "track" / f"track_info{suffix}.txt"
    seen_file = folder / "track" / f"track_camera_vis{suffix}.json"
    try:
        lines = file.read_text().splitlines()[1:]
    except OSError as error:
        raise CheckpointError(f"{file}: cannot be read: {error.strerror}") from error
    seen = read_json(seen_file)
    rows = []
    for number, line in enumerate(lines, start=2):
        row = _parse(file, number, line)
        if row.category not in IGNORED_CLASSES and set(cameras) & _seen_by(seen_file, seen, row):
            rows.append(row)
    return rows


def _parse(file: Path, number: int, line: str) -> _TrackRow:
    words = line.split()
    try:
        height, width, length, x, y, z, heading = (float(w) for w in words[4:11])
        row = _TrackRow(
            int(words[0]), int(words[1]), words[2], (length, width, height), (x, y, z), heading
        )
    except (ValueError, IndexError) as error:
        raise CheckpointError(
            f"{file}: line {number} must be: frame track class alpha height width length x y z "
            f"heading speed; it is {line[:80]!r}"
        ) from error
    if not np.isfinite([*row.size, *row.position, heading]).all() or min(row.size) <= 0:
        raise CheckpointError(f"{file}: line {number}: box of no size or not finite: {line[:80]!r}")
    return row


def _seen_by(file: Path, seen: Mapping[str, Any], row: _TrackRow) -> set[int]:
    try:
        return {int(camera) for camera in seen[str(row.track)][str(row.frame)]}
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{file}: says nothing of track {row.track} in frame {row.frame}"
        ) from error


def _deal_columns(
    rows: list[_TrackRow], frames: StreetFolder
) -> tuple[NDArray[np.int64], Float, Float]:
    """Each row gets the first free column of its frame, in file order."""
    count = len(frames.times_us)
    inside = [r for r in rows if 0 <= r.frame - frames.first_frame < count]
    per_frame = np.bincount([r.frame - frames.first_frame for r in inside], minlength=count)
    ids = np.full((count, int(per_frame.max(initial=0))), EMPTY, dtype=np.int64)
    positions, headings = np.zeros((*ids.shape, 3)), np.zeros(ids.shape)
    taken = np.zeros(count, dtype=np.int64)
    for row in inside:
        at = (row.frame - frames.first_frame, taken[row.frame - frames.first_frame])
        ids[at], positions[at], headings[at] = row.track, row.position, row.heading
        taken[at[0]] += 1
    return ids, positions, headings


def _moves(ids: NDArray[np.int64], positions: Float, ego: Float, track: int) -> bool:
    frame, column = np.nonzero(ids == track)
    if not len(frame):
        return False
    world = apply_transform(ego[frame], positions[frame, column][:, None])[:, 0]
    return leads_anywhere(world)


def _close_gaps(
    ids: NDArray[np.int64], positions: Float, headings: Float
) -> tuple[NDArray[np.int64], Float, Float]:
    """Move tracks to the first columns, but only if that saves columns: so it was trained."""
    used = int((ids != EMPTY).sum(axis=1).max(initial=0))
    if used == ids.shape[1]:
        return ids, positions, headings
    order = np.argsort(ids == EMPTY, axis=1, kind="stable")[:, :used]
    return (
        np.take_along_axis(ids, order, axis=1),
        np.take_along_axis(positions, order[..., None], axis=1),
        np.take_along_axis(headings, order, axis=1),
    )
