"""Behaviour cloning: a small network learns to drive like the recording vehicle."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from real2sim.planners.learned import REACH, PolicyShape, network, shrink, state_of

from .._files import atomic_file
from ..console import CommandError
from ..datasets.clips import Clip
from ..datasets.labels.boxes import STEP_US
from ..edit import ScenarioState
from ..edit.compose import instances_at
from ..geometry import quaternion_yaw, transform_from
from ..logs import DrivingLog
from ..render import render_cameras, select_backend
from ..scene import Scene, Trajectory
from ..world.path import LoggedPath, command_ahead

if TYPE_CHECKING:
    import torch


# --- Posed images --------------------------------------------------------------------------------

PERIOD_US = 100_000
"""Time between rendered images."""
LATERAL_SIGMA, YAW_SIGMA = 1.0, 0.12
"""Standard deviations of perturbed poses, clipped at two standard deviations [m], [rad]."""


@dataclass(frozen=True, eq=False)
class PosedImage:
    """One image and its pose.

    Attributes:
        rgb: uint8 [H, W, 3].
        t_us: time of the image.
        T_world_vehicle: [4, 4] float64, pose of the vehicle with the camera.
        frame: index of the instant.
        count: number of all images of the drive.
    """

    rgb: NDArray[np.uint8]
    t_us: int
    T_world_vehicle: NDArray[np.float64]
    frame: int
    count: int


def log_images(log: DrivingLog, shape: PolicyShape) -> Iterator[PosedImage]:
    """The images of a log."""
    for frame in range(log.frame_count):
        if not log.has_image(shape.camera, frame):
            continue
        t_us = log.image_time_us(shape.camera, frame)
        pose = transform_from(*log.ego.pose(t_us))
        yield PosedImage(log.image(shape.camera, frame), t_us, pose, frame, log.frame_count)


def scene_images(
    scene: Scene, shape: PolicyShape, *, shifted: int, seed: int
) -> Iterator[PosedImage]:
    """Images rendered along the recorded path of a scene, with ``shifted`` perturbed poses per
    time.

    A policy trained only on the path cannot return to it (Pomerleau 1989 rotated images instead;
    here the scene is rendered from the perturbed pose).
    """
    rng = np.random.default_rng(seed)
    camera = scene.rig[shape.camera].resized(2 * shape.width)
    backend, state = select_backend("auto"), ScenarioState.of(scene)
    instants = range(scene.start_us, scene.end_us + 1, PERIOD_US)
    for frame, t_us in enumerate(instants):
        T_world_ego = transform_from(*scene.ego.pose(t_us))
        for k in range(shifted + 1):
            pose = T_world_ego @ _random_offset(rng) if k else T_world_ego
            (rendered,) = render_cameras(
                instances_at(scene, state, t_us), [camera], pose, sky=scene.sky, backend=backend
            )
            yield PosedImage(rendered.rgb, t_us, pose, frame, len(instants) * (shifted + 1))


def _random_offset(rng: np.random.Generator) -> NDArray[np.float64]:
    lateral, yaw = np.clip(rng.normal(size=2), -2.0, 2.0) * [LATERAL_SIGMA, YAW_SIGMA]
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0, 0], [s, c, 0, lateral], [0, 0, 1, 0], [0, 0, 0, 1]])


BATCH_SIZE, LEARNING_RATE, WEIGHT_DECAY = 32, 2e-3, 1e-4
HOLD_OUT_EVERY = 5
"""Every fifth frame is held out, to measure the error outside the training set."""
YAW_WEIGHT = 4.0
"""Units of position equivalent to an error of one radian."""
RECOVERY_TIME = 1.5
"""Time in which a perturbed vehicle returns to the path [s]."""


@dataclass(frozen=True, eq=False)
class CloningDataset:
    """Training data of the network, N examples.

    Attributes:
        images: [N, 3, H, W] float32 in [-1, 1].
        states: [N, 4] float32.
        poses: [N, K, 3] float32, driven poses, in units of the network.
        held_out: [N] bool, excluded from training.
    """

    images: NDArray[np.float32]
    states: NDArray[np.float32]
    poses: NDArray[np.float32]
    held_out: NDArray[np.bool_]


def build_dataset(
    ego: Trajectory, shape: PolicyShape, images: Iterable[PosedImage]
) -> CloningDataset:
    """Images with the future poses of the recording vehicle, in the frame of each image.

    A perturbed vehicle returns to the path within ``RECOVERY_TIME``. Images are dropped if the
    recording ends before the plan.

    Args:
        ego: the recorded drive.
        shape: input and output of the network.
        images: images on the path of the drive or next to it.

    Raises:
        CommandError: too few images remain.
    """
    path = LoggedPath(ego)
    inputs, states, poses, held_out = [], [], [], []
    for image in images:
        expert = expert_poses(ego, shape, image)
        if expert is None:
            continue
        speed = float(np.linalg.norm(ego.velocity(image.t_us)[:2]))
        near = path.nearest(*image.T_world_vehicle[:2, 3].tolist())
        inputs.append(shrink(image.rgb, shape.width, shape.height))
        states.append(state_of(speed, command_ahead(path, near.s)))
        poses.append(expert)
        held_out.append(image.frame % HOLD_OUT_EVERY == HOLD_OUT_EVERY - 1)
    if len(inputs) < 2 * HOLD_OUT_EVERY:
        raise CommandError(
            f"the drive has {len(inputs)} views with {shape.poses * shape.spacing:g} s of driving "
            f"after them; {2 * HOLD_OUT_EVERY} are needed"
        )
    return CloningDataset(np.stack(inputs), np.stack(states), np.stack(poses), np.array(held_out))


def expert_poses(
    ego: Trajectory, shape: PolicyShape, image: PosedImage
) -> NDArray[np.float32] | None:
    """[K, 3] future poses (x, y, yaw) of the recording vehicle, in the frame of the image's
    vehicle, in units of the network; None if the recording ends earlier.
    """
    delays = (np.arange(shape.poses) + 1) * shape.spacing
    times = image.t_us + np.round(delays * 1e6).astype(np.int64)
    if times[-1] > ego.end_us:
        return None
    T_vehicle_world = np.linalg.inv(image.T_world_vehicle)
    T_vehicle_ego = T_vehicle_world @ transform_from(*ego.pose(image.t_us))
    # The offset from the path decays to 0, with slope 0 at the end.
    remaining = np.clip(1.0 - delays / RECOVERY_TIME, 0.0, 1.0) ** 2
    poses = np.empty((shape.poses, 3))
    for k, t_us in enumerate(times.tolist()):
        position, quaternion = ego.pose(t_us)
        local = T_vehicle_world[:3, :3] @ position + T_vehicle_world[:3, 3]
        yaw = float(quaternion_yaw(quaternion)) - _yaw(image.T_world_vehicle)
        poses[k, :2] = local[:2] - remaining[k] * T_vehicle_ego[:2, 3]
        poses[k, 2] = np.arctan2(np.sin(yaw), np.cos(yaw))
    scaled: NDArray[np.float32] = (poses / [REACH, REACH, 1.0]).astype(np.float32)
    return scaled


def train_network(
    dataset: CloningDataset,
    shape: PolicyShape,
    *,
    epochs: int = 60,
    seed: int = 0,
    on_progress: Callable[[int, int], None] | None = None,
) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Train a policy by AdamW with a one-cycle learning rate.

    Args:
        dataset: examples.
        shape: shape of the network.
        epochs: passes over the dataset.
        seed: seed of weights, order and brightness; results for a seed are bit-identical.
        on_progress: called with (epochs done, all).

    Returns:
        Weights by name, and figures: the number of weights, and mean position errors [m] on
        training and held-out examples.
    """
    import torch

    threads = torch.get_num_threads()
    # The network is too small for several threads, and one thread is reproducible everywhere.
    torch.set_num_threads(1)
    try:
        torch.manual_seed(seed)
        model = network(shape)
        tensors = tuple(map(torch.from_numpy, (dataset.images, dataset.states, dataset.poses)))
        held_out = torch.from_numpy(dataset.held_out)
        _optimise(model, tensors, torch.nonzero(~held_out)[:, 0], epochs, on_progress)
        errors = _position_errors(model, tensors)
    finally:
        torch.set_num_threads(threads)
    figures = {
        "weights": sum(p.numel() for p in model.parameters()),
        "error_seen_m": float(errors[~held_out].mean()),
        "error_unseen_m": float(errors[held_out].mean()) if held_out.any() else None,
    }
    return dict(model.state_dict()), figures


def _optimise(
    model: torch.nn.Module,
    tensors: tuple[torch.Tensor, ...],
    train_rows: torch.Tensor,
    epochs: int,
    on_progress: Callable[[int, int], None] | None,
) -> None:
    import torch

    images, states, poses = tensors
    optimizer = torch.optim.AdamW(model.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    steps = epochs * -(-len(train_rows) // BATCH_SIZE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, total_steps=steps)
    weight = torch.tensor([1.0, 1.0, YAW_WEIGHT])
    for epoch in range(epochs):
        order = train_rows[torch.randperm(len(train_rows))]
        for rows in torch.split(order, BATCH_SIZE):
            brightness = 0.8 + 0.4 * torch.rand(len(rows), 1, 1, 1)
            predicted = model(images[rows] * brightness, states[rows])
            loss = torch.nn.functional.smooth_l1_loss(
                predicted * weight, poses[rows] * weight, beta=0.05
            )
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
        if on_progress is not None:
            on_progress(epoch + 1, epochs)


def _position_errors(model: torch.nn.Module, tensors: tuple[torch.Tensor, ...]) -> torch.Tensor:
    """[N] mean distance between predicted and driven positions [m]."""
    import torch

    images, states, poses = tensors
    with torch.inference_mode():
        error = (model.eval()(images, states) - poses)[..., :2]
        distances: torch.Tensor = error.norm(dim=2).mean(1) * REACH
    return distances


def save_policy(weights: dict[str, torch.Tensor], shape: PolicyShape, out: Path) -> None:
    """Write the weights as a ``.safetensors`` file that planner ``learned=FILE`` reads."""
    from safetensors.torch import save

    with atomic_file(out) as file:
        file.write(save(weights, metadata=shape.metadata()))


def _yaw(T_world_vehicle: NDArray[np.float64]) -> float:
    return float(np.arctan2(T_world_vehicle[1, 0], T_world_vehicle[0, 0]))


# --- Examples from data sets ---------------------------------------------------------------------

TRAIN = "train"
LAYOUT = "labels"
"""Name of the supported format, and of its folder in an export."""


def is_export(folder: Path) -> bool:
    """Whether a folder is a labelled data set."""
    return (folder / "manifest.json").is_file()


def exported_shape(folder: Path, camera: str | None) -> PolicyShape:
    """The shape of a policy for ``camera`` of an export; default: the most forward-looking one.

    Raises:
        CommandError: the camera does not exist, or the export has only other formats.
    """
    found = _content(folder)["cameras"]
    cameras = {one["name"]: np.array(one["T_vehicle_camera"]) for one in found}
    if camera is not None and camera not in cameras:
        raise CommandError(f"no camera {camera!r} in {folder}; there are {', '.join(cameras)}")
    ahead = max(cameras, key=lambda name: cameras[name][0, 2])
    return PolicyShape(camera=camera or ahead, spacing=STEP_US * 1e-6)


def exported_examples(
    folders: Sequence[Path],
    shape: PolicyShape,
    *,
    on_progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> CloningDataset:
    """All frames of exports whose ``ego_future`` covers a whole plan.

    Clips of splits other than ``train`` are held out. Without such clips, every fifth frame of each
    clip is held out.

    Args:
        folders: exports with the format ``labels``.
        shape: result of :func:`exported_shape`.
        on_progress: called with (clips read, all).

    Raises:
        CommandError: an export without labels or camera, or too few frames.
    """
    clips = [clip for folder in folders for clip in _clips(folder, shape)]
    splits = any(clip.split != TRAIN for clip in clips)
    inputs, states, poses, held_out = [], [], [], []
    for done, clip in enumerate(clips, start=1):
        for frame in clip.frames:
            plan = frame["ego_future"][: shape.poses]
            if len(plan) < shape.poses:
                continue
            rgb = clip.pixels("rgb", shape.camera, frame["index"])
            inputs.append(shrink(rgb, shape.width, shape.height))
            states.append(state_of(frame["ego"]["speed"], frame["ego"]["command"]))
            poses.append(np.array(plan)[:, 1:] / [REACH, REACH, 1.0])
            turn = frame["index"] % HOLD_OUT_EVERY == HOLD_OUT_EVERY - 1
            held_out.append(clip.split != TRAIN if splits else turn)
        on_progress(done, len(clips))
    if len(inputs) < 2 * HOLD_OUT_EVERY:
        raise CommandError(
            f"{len(inputs)} frames have {shape.poses * shape.spacing:g} s of driving after them; "
            f"{2 * HOLD_OUT_EVERY} are needed"
        )
    return CloningDataset(
        np.stack(inputs), np.stack(states), np.stack(poses).astype(np.float32), np.array(held_out)
    )


def _clips(folder: Path, shape: PolicyShape) -> list[Clip]:
    content = _content(folder)
    names = [one["name"] for one in content["cameras"]]
    if shape.camera not in names:
        raise CommandError(f"no camera {shape.camera!r} in {folder}; there are {', '.join(names)}")
    return [Clip.open(folder / LAYOUT / name) for name in content["clips"]]


def _content(folder: Path) -> dict[str, Any]:
    file = folder / LAYOUT / "dataset.json"
    if not file.is_file():
        raise CommandError(f"{folder} holds no labels; export it with --format {LAYOUT}")
    content: dict[str, Any] = json.loads(file.read_bytes())
    return content
