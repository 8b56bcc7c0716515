"""Checkpoints of drivestudio (OmniRe and others), ``checkpoint_final.pth``.

Source: github.com/ziyc/drivestudio (models/nodes, models/gaussians/vanilla.py, models/modules.py,
datasets).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...geometry import Float, invert_transform, transform_from
from ...scene import Camera, CameraRig, GaussianCloud, Scene, SceneObject, Sky, Trajectory
from ...scene.camera import T_VEHICLE_OPTICAL
from ...scene.cloud import SH_C0
from ...scene.errors import SceneError
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
    read_pose,
    sky_from_opengl_cube,
    table,
    tied_to_object,
)

R_CUBE_WORLD = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Rotation of view directions for the lookup in drivestudio's sky."""

FLAT = 1e-4
"""Thickness of flat Gaussians, which have only two scales, as a fraction of the smaller scale."""

LOST_MODELS = {
    "DeformableNodes": "deformable objects (cyclists and the like) are not kept",
    "SMPLNodes": "pedestrians on body models are not kept",
    "Affine": "colour corrections per image are not kept",
    "CamPose": "corrections of camera poses are not kept",
    "CamPosePerturb": "perturbations of camera poses are not kept",
}

DEFAULT_CAMERA_HEIGHT = 1.6


@dataclass(frozen=True, eq=False)
class _Drive:
    """Path and cameras of the ego, in the scene's world frame."""

    rig: CameraRig
    times_us: NDArray[np.int64]
    ego: Float


def import_drivestudio(
    path: str | PathLike[str], options: CheckpointOptions | None = None
) -> ImportedScene:
    """Read background, rigid objects and sky.

    The checkpoint holds the tracks of its objects; frames get time stamps by ``frame_rate``. With
    ``dataset`` (layouts with ``ego_pose``: Waymo, Argoverse, KITTI), the scene gets the cameras and
    the ego path. Otherwise it gets one camera at the origin of the drive. The world is the
    checkpoint's, with ``world='front_camera'`` rotated to x forward, z up.

    Raises:
        CheckpointError: a part is missing, damaged or does not fit.
    """
    file, options = Path(path), options or CheckpointOptions()
    state = load_checkpoint(file)
    models = table(file, state, "models")
    T_scene_file = T_VEHICLE_OPTICAL if options.world == "front_camera" else np.eye(4)
    warnings = [text for key, text in LOST_MODELS.items() if key in models]
    unknown = set(models) - set(LOST_MODELS) - {"Background", "RigidNodes", "Sky"}
    warnings += [f"model {key!r} is not known and not kept" for key in sorted(unknown)]
    frames = _frame_count(file, models, options)
    drive = _read_drive(options, frames, warnings)
    background = _cloud(file, models, "Background").moved(T_scene_file)
    scene = Scene(
        name=options.name or (options.dataset.name if options.dataset else file.stem),
        background=background,
        objects=_objects(file, models, drive.times_us, T_scene_file, warnings),
        sky=_sky(file, models, T_scene_file, warnings),
        rig=drive.rig,
        ego=Trajectory.from_transforms(drive.times_us, drive.ego),
        frame_times_us=drive.times_us,
        provenance=_provenance(file, state, options),
    )
    return ImportedScene(scene, tuple(warnings))


def _frame_count(file: Path, models: Mapping[str, Any], options: CheckpointOptions) -> int:
    """Number of frames: from the objects, otherwise from the options, otherwise two."""
    asked = None if options.last_frame is None else options.last_frame - options.first_frame + 1
    if "RigidNodes" not in models:
        return asked or 2
    visible = table(file, models, "RigidNodes").get("instances_fv")
    if not isinstance(visible, torch.Tensor) or visible.ndim != 2:
        raise CheckpointError(f"{file}: RigidNodes: 'instances_fv' is missing or not [F, I]")
    if asked is not None and asked != len(visible):
        raise CheckpointError(
            f"{file}: its objects have {len(visible)} frames; {options.first_frame} to "
            f"{options.last_frame} are {asked}"
        )
    return len(visible)


def _cloud(file: Path, models: Mapping[str, Any], key: str) -> GaussianCloud:
    """All Gaussians of one model, in the frames of the checkpoint."""
    part = table(file, models, key)
    means = array(file, key, part, "_means", (None, 3))
    n = len(means)
    first = array(file, key, part, "_features_dc", (n, 3))
    rest = array(file, key, part, "_features_rest", (n, None, 3))
    if not rest.shape[1]:
        # Without harmonics, colours are a sigmoid.
        first = (1 / (1 + np.exp(-np.clip(first, -80, 80))) - 0.5) / SH_C0
    return cloud_of(
        file,
        means=means,
        quats=array(file, key, part, "_quats", (n, 4)),
        log_scales=_log_scales(file, key, part, n),
        logits=array(file, key, part, "_opacities", (n, 1)),
        sh=np.concatenate([first[:, None], rest], axis=1),
    )


def _log_scales(file: Path, key: str, part: Mapping[str, Any], n: int) -> Float:
    """Three log scales. Spheres in the file have one, discs two."""
    given = array(file, key, part, "_scales", (n, None))
    match given.shape[1]:
        case 3:
            return given
        case 2:
            thin = given.min(axis=1, keepdims=True) + np.log(FLAT)
            return np.concatenate([given, thin], axis=1)
        case 1:
            return np.repeat(given, 3, axis=1)
    raise CheckpointError(
        f"{file}: {key}: '_scales' has {given.shape[1]} columns; allowed are 1 to 3"
    )


@dataclass(frozen=True, eq=False)
class _Instances:
    """Rigid objects: all Gaussians [N], their owners, and poses [F, I] in the file's world.

    A pose is meaningless where the instance is not visible.
    """

    cloud: GaussianCloud
    owner: NDArray[np.int64]
    sizes: Float
    positions: Float
    quats: Float
    visible: NDArray[np.bool_]

    def object(
        self, instance: int, times_us: NDArray[np.int64], T_scene_file: Float
    ) -> SceneObject | None:
        """One object, or None without Gaussians or frames. Raises SceneError for bad values."""
        frames = np.flatnonzero(self.visible[:, instance])
        mine = self.owner == instance
        if not (len(frames) and mine.any()):
            return None
        if (np.linalg.norm(self.quats[frames, instance], axis=1) < 1e-9).any():
            raise SceneError("a rotation has length zero")
        poses = transform_from(self.positions[frames, instance], self.quats[frames, instance])
        path = Trajectory.from_transforms(times_us[frames], poses)
        middle = path.middle
        cloud = tied_to_object(self.cloud.select(torch.from_numpy(mine)), middle[:3, :3])
        length, width, height = self.sizes[instance].tolist()
        return SceneObject(
            f"vehicle_{instance}",
            "vehicle",
            (length, width, height),
            cloud,
            path.moved(T_scene_file),
        )


def _objects(
    file: Path,
    models: Mapping[str, Any],
    times_us: NDArray[np.int64],
    T_scene_file: Float,
    warnings: list[str],
) -> dict[str, SceneObject]:
    """One object per instance that is visible in some frame and has Gaussians."""
    if "RigidNodes" not in models:
        return {}
    instances = _read_instances(file, models, len(times_us))
    objects: dict[str, SceneObject] = {}
    for i in range(len(instances.sizes)):
        try:
            scene_object = instances.object(i, times_us, T_scene_file)
        except SceneError as error:
            raise CheckpointError(f"{file}: instance {i} of RigidNodes: {error}") from error
        if scene_object is not None:
            objects[scene_object.object_id] = scene_object
    skipped = len(instances.sizes) - len(objects)
    if skipped:
        warnings.append(f"{skipped} instances without Gaussians or visible frames are not kept")
    if objects:
        warnings.append(
            "the checkpoint does not say what its rigid objects are; all are of category 'vehicle'"
        )
    if objects and instances.cloud.sh_degree:
        warnings.append(DIRECTIONS_WARNING)
    return objects


def _read_instances(file: Path, models: Mapping[str, Any], frames: int) -> _Instances:
    key = "RigidNodes"
    part = table(file, models, key)
    cloud = _cloud(file, models, key)
    sizes = array(file, key, part, "instances_size", (None, 3))
    shape = (frames, len(sizes))
    owner = array(file, key, part, "points_ids", (len(cloud), 1))[:, 0].astype(np.int64)
    if len(owner) and not (owner.min() >= 0 and owner.max() < len(sizes)):
        raise CheckpointError(f"{file}: {key}: 'points_ids' beyond its {len(sizes)} instances")
    return _Instances(
        cloud,
        owner,
        sizes,
        positions=array(file, key, part, "instances_trans", (*shape, 3)),
        quats=array(file, key, part, "instances_quats", (*shape, 4)),
        visible=array(file, key, part, "instances_fv", shape) != 0,
    )


def _sky(
    file: Path, models: Mapping[str, Any], T_scene_file: Float, warnings: list[str]
) -> Sky | None:
    if "Sky" not in models:
        return None
    part = table(file, models, "Sky")
    if "base" not in part:
        warnings.append("the sky is a network, which is not read; it is black")
        return None
    faces = array(file, "Sky", part, "base", (6, None, None, 3))
    if faces.shape[1] != faces.shape[2] or not faces.size:
        raise CheckpointError(f"{file}: Sky: faces are {faces.shape[1:3]}, not square")
    return sky_from_opengl_cube(faces, R_CUBE_WORLD @ T_scene_file[:3, :3].T)


def _read_drive(options: CheckpointOptions, frames: int, warnings: list[str]) -> _Drive:
    times = np.rint(np.arange(frames) * 1e6 / options.frame_rate).astype(np.int64)
    if options.dataset is None:
        warnings.append(
            "without the dataset folder there are no cameras and no path of the ego; there is one "
            "camera, at the start of the drive"
        )
        return _Drive(_default_rig(), times, np.stack([_start(options)] * frames))
    folder = Path(options.dataset)
    if options.world == "front_camera" or not (folder / "ego_pose").is_dir():
        raise CheckpointError(
            f"{folder}: layouts without ego_pose (nuScenes) are not read; leave the dataset out "
            "and say world='front_camera'"
        )
    numbers = range(options.first_frame, options.first_frame + frames)
    poses = np.stack([read_pose(folder / "ego_pose" / f"{t:03d}.txt") for t in numbers])
    return _Drive(_rig(folder, options), times, invert_transform(poses[0]) @ poses)


def _default_rig() -> CameraRig:
    pose = T_VEHICLE_OPTICAL.copy()
    pose[2, 3] = DEFAULT_CAMERA_HEIGHT
    k = np.array([[800.0, 0, 480], [0, 800, 320], [0, 0, 1]])
    return CameraRig((Camera("front", 960, 640, k, pose),))


def _start(options: CheckpointOptions) -> Float:
    """``T_world_vehicle`` when the drive began: the origin, or below the front camera there."""
    start = np.eye(4)
    if options.world == "front_camera":
        start[2, 3] = -DEFAULT_CAMERA_HEIGHT
    return start


def _rig(folder: Path, options: CheckpointOptions) -> CameraRig:
    found = sorted(int(p.stem) for p in (folder / "extrinsics").glob("*.txt") if p.stem.isdigit())
    cameras = options.cameras or tuple(found)
    if not cameras:
        raise CheckpointError(f"{folder / 'extrinsics'}: holds no cameras such as 0.txt")
    poses = {c: read_pose(folder / "extrinsics" / f"{c}.txt") for c in cameras}
    # Waymo's cameras look along x, all others follow OpenCV. The first camera looks ahead in every
    # layout.
    ahead = read_pose(folder / "extrinsics" / f"{found[0]}.txt")[0, :3] if found else np.zeros(3)
    T_camera_optical = T_VEHICLE_OPTICAL if ahead[0] > ahead[2] else np.eye(4)
    try:
        return CameraRig(
            tuple(_camera(folder, c, pose @ T_camera_optical) for c, pose in poses.items())
        )
    except SceneError as error:
        raise CheckpointError(f"{folder}: {error}") from error


def _camera(folder: Path, index: int, pose: Float) -> Camera:
    k = read_intrinsics(folder / "intrinsics" / f"{index}.txt")
    # Without images, assume the principal point at the image centre.
    middle = (round(2 * k[0, 2]), round(2 * k[1, 2]))
    width, height = image_size(folder, index) or middle
    return Camera(f"camera_{index}", width, height, k, pose)


def _provenance(file: Path, state: Mapping[str, Any], options: CheckpointOptions) -> dict[str, Any]:
    step = state.get("step")
    return {
        "source": "drivestudio checkpoint",
        "file": file.name,
        "sha256": file_hash(file),
        "iteration": step if isinstance(step, int) else None,
        "dataset": options.dataset.name if options.dataset else None,
        "first_frame": options.first_frame,
        "frame_rate": options.frame_rate,
        "world": options.world,
    }
