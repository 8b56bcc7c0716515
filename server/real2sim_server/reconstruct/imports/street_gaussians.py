"""Checkpoints of Street Gaussians (Yan et al. 2024), with their dataset folder.

Facts: github.com/zju3dv/street_gaussians, lib/models and lib/utils.
"""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from ...geometry.transform import Float, transform_from, yaw_quaternion
from ...scene import GaussianCloud, Scene, SceneObject, Sky, Trajectory
from .checkpoint import (
    DIRECTIONS_WARNING,
    CheckpointError,
    CheckpointOptions,
    ImportedScene,
    array,
    cloud_of,
    file_hash,
    load_checkpoint,
    sky_from_opengl_cube,
    table,
    tied_to_object,
)
from .street_folder import StreetFolder, read_street_folder
from .street_tracks import StreetTracks, read_street_tracks

DEFAULT_CAMERAS = (0, 1, 2)
CATEGORIES = {"vehicle": "car"}

LOST_PARTS = {
    "color_correction": "colour corrections per image",
    "pose_correction": "corrections of camera poses",
}


def import_street_gaussians(
    path: str | PathLike[str], options: CheckpointOptions | None = None
) -> ImportedScene:
    """Read a checkpoint with the dataset folder it was trained on.

    Objects keep their own frames; their tracks are those of the folder with the corrections of the
    checkpoint, composed with the path of the ego, at the frames' time stamps. The world is
    that of the checkpoint: Waymo's axes, shifted to the mean position of the ego.

    Raises:
        CheckpointError: a part that is missing, damaged or does not fit the folder.
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
    """The models in the file must be those of the tracks, else nothing fits together."""
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
    # Without corrections (opt_track off) there is an empty table.
    if columns and actor:
        params = table(file, actor, "params")
        positions += array(file, "actor_pose", params, "opt_trans", (count, columns, 3))
        theta = array(file, "actor_pose", params, "opt_rots", (count, columns, 1))[..., 0]
        # Its quaternion is (cos, 0, 0, sin) of theta itself, which turns by twice theta.
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
        middle = trajectory.transform((trajectory.start_us + trajectory.end_us) // 2)
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
    """Gaussians of one model; a Fourier series of the first harmonic is taken at half its time."""
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
