"""Checkpoints of Street Gaussians (Yan et al. 2024), with their dataset folder."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..._files import read_text
from ...geometry import Float, apply_transform, transform_from, yaw_quaternion
from ...scene import Camera, CameraRig, GaussianCloud, Scene, SceneObject, Sky, Trajectory
from ...scene.errors import SceneError
from ...scene.trajectory import leads_anywhere
from .checkpoint import (
    DIRECTIONS_WARNING,
    CheckpointError,
    CheckpointOptions,
    ImportedScene,
    array,
    cloud_of,
    file_hash,
    image_size,
    load_checkpoint,
    read_intrinsics,
    read_json,
    read_pose,
    sky_from_opengl_cube,
    table,
    tied_to_object,
)

# Dataset folder: cameras, ego path and time stamps.

CAMERA_NAMES = ("FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT")
WAYMO_SIZES = ((1920, 1280), (1920, 1280), (1920, 1280), (1920, 886), (1920, 886))


@dataclass(frozen=True, eq=False)
class StreetFolder:
    """Data of a dataset folder for the frames of a model.

    Attributes:
        rig: cameras used in training.
        first_frame: number of the first frame.
        times_us: [F] int64 time stamps of the frames [us].
        ego: [F, 4, 4] float64 ``T_world_vehicle``; the world is Waymo's, shifted by the mean
            position of the ego over all frames of the folder.
    """

    rig: CameraRig
    first_frame: int
    times_us: NDArray[np.int64]
    ego: Float


def read_street_folder(
    folder: Path, *, first_frame: int, last_frame: int | None, cameras: tuple[int, ...]
) -> StreetFolder:
    """Read ``ego_pose``, ``timestamps.json``, ``intrinsics`` and ``extrinsics``.

    Raises:
        CheckpointError: naming the file that is missing or does not fit.
    """
    poses = _ego_poses(folder)
    last = len(poses) - 1 if last_frame is None else last_frame
    if last >= len(poses):
        raise CheckpointError(
            f"{folder / 'ego_pose'}: has frames 0 to {len(poses) - 1}, not {first_frame} to {last}"
        )
    poses[:, :3, 3] -= poses[:, :3, 3].mean(axis=0)
    frames = range(first_frame, last + 1)
    try:
        rig = CameraRig(tuple(_camera(folder, camera) for camera in cameras))
    except SceneError as error:
        raise CheckpointError(f"{folder}: {error}") from error
    return StreetFolder(rig, first_frame, _times(folder, frames), poses[first_frame : last + 1])


def _ego_poses(folder: Path) -> Float:
    """``T_waymo_vehicle`` [all frames, 4, 4]; files of single cameras are skipped."""
    place = folder / "ego_pose"
    found = sorted(p for p in place.glob("*.txt") if re.fullmatch(r"\d+", p.stem))
    if not found:
        raise CheckpointError(f"{place}: holds no poses such as 000000.txt")
    numbers = [int(p.stem) for p in found]
    if numbers != list(range(len(numbers))):
        missing = sorted(set(range(max(numbers) + 1)) - set(numbers))[:5]
        raise CheckpointError(f"{place}: frames are missing or doubled, the first: {missing}")
    return np.stack([read_pose(p) for p in found])


def _camera(folder: Path, index: int) -> Camera:
    if not 0 <= index < len(CAMERA_NAMES):
        raise CheckpointError(f"camera {index}; allowed are 0 to {len(CAMERA_NAMES) - 1}")
    width, height = image_size(folder, index) or WAYMO_SIZES[index]
    return Camera(
        CAMERA_NAMES[index].lower(),
        width,
        height,
        read_intrinsics(folder / "intrinsics" / f"{index}.txt"),
        read_pose(folder / "extrinsics" / f"{index}.txt"),
    )


def _times(folder: Path, frames: range) -> NDArray[np.int64]:
    file = folder / "timestamps.json"
    by_frame = read_json(file).get("FRAME")
    try:
        seconds = [float(by_frame[f"{frame:06d}"]) for frame in frames]  # type: ignore[index]
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{file}: FRAME must hold seconds for frames {frames[0]:06d} to {frames[-1]:06d}; "
            f"at fault: {error}"
        ) from error
    times = np.rint(np.array(seconds) * 1e6).astype(np.int64)
    if (np.diff(times) <= 0).any():
        raise CheckpointError(f"{file}: time stamps of FRAME do not increase")
    return times


# Assignment of ``actor_pose`` columns to tracks.
#
# The checkpoint holds corrections [frames, columns] without track ids. Street Gaussians assigns
# the columns in ``get_obj_pose_tracking`` (lib/utils/waymo_utils.py) when it reads the dataset;
# the code here repeats these steps.

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
        lines = read_text(file).splitlines()[1:]
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
    """Assign each row to the first free column of its frame, in file order."""
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
    """Move tracks to the first columns, but only if that saves columns, as in training."""
    used = int((ids != EMPTY).sum(axis=1).max(initial=0))
    if used == ids.shape[1]:
        return ids, positions, headings
    order = np.argsort(ids == EMPTY, axis=1, kind="stable")[:, :used]
    return (
        np.take_along_axis(ids, order, axis=1),
        np.take_along_axis(positions, order[..., None], axis=1),
        np.take_along_axis(headings, order, axis=1),
    )


# Checkpoints.
#
# Reference: github.com/zju3dv/street_gaussians, lib/models and lib/utils.

DEFAULT_CAMERAS = (0, 1, 2)
CATEGORIES = {"vehicle": "car"}

LOST_PARTS = {
    "color_correction": "colour corrections per image",
    "pose_correction": "corrections of camera poses",
}


def import_street_gaussians(
    path: str | PathLike[str], options: CheckpointOptions | None = None
) -> ImportedScene:
    """Read a checkpoint with its dataset folder.

    Objects keep their own frames. Their tracks come from the folder, with the corrections of the
    checkpoint, composed with the ego path at the frames' time stamps. The world is the
    checkpoint's: Waymo's axes, shifted to the mean position of the ego.

    Raises:
        CheckpointError: a part is missing, damaged or does not fit the folder.
    """
    file, options = Path(path), options or CheckpointOptions()
    if options.dataset is None:
        raise CheckpointError(
            f"{file}: a Street Gaussians checkpoint holds corrections of tracks but no tracks; "
            "name the dataset folder it was trained on"
        )
    folder, cameras = Path(options.dataset), options.cameras or DEFAULT_CAMERAS
    state = load_checkpoint(file)
    frames = read_street_folder(
        folder,
        first_frame=options.first_frame,
        last_frame=options.last_frame,
        cameras=cameras,
    )
    tracks = read_street_tracks(folder, frames, cameras=cameras, tracker=options.tracker)
    _check_tracks(file, state, tracks)
    objects = _objects(
        file,
        state,
        tracks,
        trajectories=_trajectories(file, state, tracks, frames),
        fourier_scale=options.fourier_scale,
    )
    warnings = [f"{text} are not kept" for key, text in LOST_PARTS.items() if state.get(key)]
    warnings += _object_warnings(state, objects, tracks)
    scene = Scene(
        name=options.name or folder.name,
        background=_cloud(file, state, "background", options.fourier_scale),
        objects=objects,
        sky=_sky(file, state, warnings),
        rig=frames.rig,
        ego=Trajectory.from_transforms(frames.times_us, frames.ego),
        frame_times_us=frames.times_us,
        provenance=_provenance(file, state, options, cameras),
    )
    return ImportedScene(scene, tuple(warnings))


def _check_tracks(file: Path, state: Mapping[str, Any], tracks: StreetTracks) -> None:
    """Check that the models in the file match the tracks."""
    held = {key for key in state if str(key).startswith("obj_")}
    expected = {model_name(t) for t in tracks.track_ids}
    if held != expected:
        extra, missing = sorted(held - expected)[:8], sorted(expected - held)[:8]
        raise CheckpointError(
            f"{file}: its objects are not the moving tracks of the dataset folder: only in the "
            f"file: {extra}, only in the folder: {missing}; frames, cameras and tracker must be as "
            "in its configuration (data.selected_frames, data.cameras, data.use_tracker)"
        )


def model_name(track: int) -> str:
    """Key of a track's Gaussians in a checkpoint."""
    return f"obj_{track:03d}"


def _trajectories(
    file: Path, state: Mapping[str, Any], tracks: StreetTracks, frames: StreetFolder
) -> dict[int, Trajectory]:
    """``T_world_object`` of each track with the corrections of the checkpoint."""
    poses = _object_poses(file, state, tracks, frames)
    trajectories = {}
    for track in tracks.track_ids:
        frame, column = np.nonzero(tracks.ids == track)
        if (np.diff(frame) == 0).any():
            raise CheckpointError(f"track {track} of the dataset folder is twice in one frame")
        trajectories[track] = Trajectory.from_transforms(
            frames.times_us[frame], poses[frame, column]
        )
    return trajectories


def _object_poses(
    file: Path, state: Mapping[str, Any], tracks: StreetTracks, frames: StreetFolder
) -> Float:
    """``T_world_object`` [F, M, 4, 4], corrected; meaningless where a column is free."""
    count, columns = tracks.ids.shape
    positions, yaw = tracks.positions.copy(), tracks.headings.copy()
    actor = state.get("actor_pose") or {}
    # Without corrections (opt_track off) the table is empty.
    if columns and actor:
        params = table(file, actor, "params")
        positions += array(file, "actor_pose", params, "opt_trans", (count, columns, 3))
        theta = array(file, "actor_pose", params, "opt_rots", (count, columns, 1))[..., 0]
        # The checkpoint's quaternion is (cos, 0, 0, sin) of theta itself, a rotation by twice
        # theta.
        yaw += 2 * theta
    placed: Float = frames.ego[:, None] @ transform_from(positions, yaw_quaternion(yaw))
    return placed


def _objects(
    file: Path,
    state: Mapping[str, Any],
    tracks: StreetTracks,
    *,
    trajectories: Mapping[int, Trajectory],
    fourier_scale: float,
) -> dict[str, SceneObject]:
    objects: dict[str, SceneObject] = {}
    for track, trajectory in trajectories.items():
        cloud = _cloud(file, state, model_name(track), fourier_scale)
        middle = trajectory.middle
        category = CATEGORIES.get(tracks.classes[track], tracks.classes[track])
        object_id = f"{category}_{track}"
        objects[object_id] = SceneObject(
            object_id,
            category,
            tracks.sizes[track],
            tied_to_object(cloud, middle[:3, :3]),
            trajectory,
        )
    return objects


def _object_warnings(
    state: Mapping[str, Any], objects: Mapping[str, SceneObject], tracks: StreetTracks
) -> list[str]:
    warnings = []
    varying = sum(state[model_name(t)]["feature_dc"].shape[1] > 1 for t in tracks.track_ids)
    if varying:
        warnings.append(
            f"{varying} objects change colour over time; they keep that of the middle of their life"
        )
    if any(o.cloud.sh_degree for o in objects.values()):
        warnings.append(DIRECTIONS_WARNING)
    return warnings


def _cloud(file: Path, state: Mapping[str, Any], key: str, fourier_scale: float) -> GaussianCloud:
    """Gaussians of one model; a first-harmonic Fourier series is evaluated at half its time."""
    part = table(file, state, key)
    means = array(file, key, part, "xyz", (None, 3))
    n = len(means)
    series = array(file, key, part, "feature_dc", (n, None, 3))
    basis = fourier_basis(0.5 * fourier_scale, series.shape[1])
    first = np.einsum("nkc,k->nc", series, basis)[:, None]
    rest = array(file, key, part, "feature_rest", (n, None, 3))
    return cloud_of(
        file,
        means=means,
        quats=array(file, key, part, "rotation", (n, 4)),
        log_scales=array(file, key, part, "scaling", (n, 3)),
        logits=array(file, key, part, "opacity", (n, 1)),
        sh=np.concatenate([first, rest], axis=1),
    )


def fourier_basis(time: float, count: int) -> Float:
    """The real discrete Fourier basis [count] of the released code: 1, sin, cos, sin, cos ...

    ``time`` runs from 0 to the scale (1) over an object's life. Even terms are cos(pi k t), odd
    ones sin(pi (k + 1) t): so 1, sin(2 pi t), cos(2 pi t), sin(4 pi t), cos(4 pi t).
    """
    k = np.arange(count)
    basis: Float = np.where(k % 2 == 0, np.cos(np.pi * k * time), np.sin(np.pi * (k + 1) * time))
    return basis


def _sky(file: Path, state: Mapping[str, Any], warnings: list[str]) -> Sky | None:
    if not state.get("sky_cubemap"):
        return None
    params = table(file, table(file, state, "sky_cubemap"), "params")
    if "sky_codebook" in params:
        warnings.append("the sky is a codebook with a network, which is not read; it is black")
        return None
    faces = array(file, "sky_cubemap", params, "sky_cube_map", (6, None, None, 3))
    if faces.shape[1] != faces.shape[2] or not faces.size:
        raise CheckpointError(f"{file}: sky_cubemap: faces are {faces.shape[1:3]}, not square")
    return sky_from_opengl_cube(faces, np.eye(3))


def _provenance(
    file: Path, state: Mapping[str, Any], options: CheckpointOptions, cameras: tuple[int, ...]
) -> dict[str, Any]:
    iteration = state.get("iter")
    return {
        "source": "Street Gaussians checkpoint",
        "file": file.name,
        "sha256": file_hash(file),
        "iteration": iteration if isinstance(iteration, int) else None,
        "dataset": options.dataset.name if options.dataset else None,
        "first_frame": options.first_frame,
        "last_frame": options.last_frame,
        "cameras": list(cameras),
    }
