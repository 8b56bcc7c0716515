"""``real2sim train-policy``: behaviour cloning of the recording vehicle."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from real2sim.planners.learned import REACH, PolicyShape, network, shrink, state_of

from .._files import atomic_file
from ..console import CommandError, print_figures, staged_progress, write_json
from ..geometry.rotation import quaternion_yaw, transform_from
from ..logs import open_log
from ..scene import CameraRig, Trajectory
from ..scene.io import load_scene
from ..world.ego.route import command_ahead
from ..world.path import LoggedPath
from .views import Seen, logged_views, scene_views

BATCH, RATE, DECAY = 32, 2e-3, 1e-4
HELD_OUT = 5
"""Every fifth place is kept from training, to say how well what was not seen is answered."""
YAW_WEIGHT = 4.0
"""An error of a radian counts as much as one of so many units of position."""
RETURN = 1.5
"""Seconds in which a view beside the path is brought back to it."""


@dataclass(frozen=True)
class Asked:
    """The options as they were typed.

    Attributes:
        camera: name; None: the one that looks most nearly ahead.
        epochs: passes over the data.
        shifted: views beside the path for each recorded one; of scenes only.
        seed: of weights, order and shifts.
    """

    camera: str | None = None
    epochs: int = 60
    shifted: int = 5
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Lessons:
    """What the network learns from, N examples.

    Attributes:
        images: [N, 3, H, W] float32 in [-1, 1].
        states: [N, 4] float32.
        poses: [N, K, 3] float32, what was driven, in units of the network.
        held: [N] bool, kept from training.
    """

    images: NDArray[np.float32]
    states: NDArray[np.float32]
    poses: NDArray[np.float32]
    held: NDArray[np.bool_]


def run(
    *,
    source: Path,
    out: Path,
    asked: Asked,
    log_format: str | None,
    sequence: str | None,
    json_path: Path | None,
) -> None:
    """Train on a scene bundle (images are drawn, beside the path too) or a log (its images).

    Raises:
        CommandError: too short a drive, or a camera that is not there.
    """
    start = time.perf_counter()
    with staged_progress() as report:
        if (source / "scene.json").is_file():
            scene = load_scene(source)
            ego, shape = scene.ego, _shape(scene.rig, asked)
            views = scene_views(scene, shape, shifted=asked.shifted, seed=asked.seed)
        else:
            log = open_log(source, format=log_format, sequence=sequence)
            ego, shape = log.ego, _shape(log.rig, asked)
            views = logged_views(log, shape)
        lessons = lessons_of(ego, shape, _told(views, report))
        weights, figures = learn(lessons, shape, asked, on_epoch=report)
    _save(weights, shape, out)
    figures |= {"examples": len(lessons.images), "seconds": time.perf_counter() - start}
    print_figures(f"policy for camera {shape.camera}", figures)
    write_json(json_path, figures)


def lessons_of(ego: Trajectory, shape: PolicyShape, views: Iterable[Seen]) -> Lessons:
    """Views with what the recording vehicle did next, as seen from each of them.

    A view beside the path is answered by the way back to it: the offset is gone after
    ``RETURN`` seconds. Views so late that the recording does not cover the plan are left out.

    Raises:
        CommandError: none is left.
    """
    path, images, states, poses, held = LoggedPath(ego), [], [], [], []
    for seen in views:
        answer = driven_from(ego, shape, seen)
        if answer is None:
            continue
        velocity = ego.velocity(seen.t_us)
        near = path.nearest(*seen.T_world_vehicle[:2, 3].tolist())
        images.append(shrink(seen.image, shape.width, shape.height))
        states.append(state_of(float(np.linalg.norm(velocity[:2])), command_ahead(path, near.s)))
        poses.append(answer)
        held.append(seen.frame % HELD_OUT == HELD_OUT - 1)
    if len(images) < 2 * HELD_OUT:
        raise CommandError(
            f"the drive has {len(images)} views with {shape.poses * shape.spacing:g} s of driving "
            f"after them; {2 * HELD_OUT} are needed"
        )
    return Lessons(np.stack(images), np.stack(states), np.stack(poses), np.array(held))


def driven_from(ego: Trajectory, shape: PolicyShape, seen: Seen) -> NDArray[np.float32] | None:
    """[K, 3] poses that the recording vehicle came to, in the frame of the view, in units of the
    network; None where the recording ends before."""
    delays = (np.arange(shape.poses) + 1) * shape.spacing
    times = seen.t_us + np.round(delays * 1e6).astype(np.int64)
    if times[-1] > ego.end_us:
        return None
    to_view = np.linalg.inv(seen.T_world_vehicle)
    now = to_view @ transform_from(*ego.pose(seen.t_us))
    # Where the view stands seen from the path; it fades, with a slope of 0 at its end.
    left = np.clip(1.0 - delays / RETURN, 0.0, 1.0) ** 2
    found = np.empty((shape.poses, 3))
    for k, t_us in enumerate(times.tolist()):
        position, quaternion = ego.pose(t_us)
        place = to_view[:3, :3] @ position + to_view[:3, 3]
        turn = float(quaternion_yaw(quaternion)) - _yaw(seen.T_world_vehicle)
        found[k, :2] = place[:2] - left[k] * now[:2, 3]
        found[k, 2] = np.arctan2(np.sin(turn), np.cos(turn))
    answer: NDArray[np.float32] = (found / [REACH, REACH, 1.0]).astype(np.float32)
    return answer


def learn(
    lessons: Lessons, shape: PolicyShape, asked: Asked, *, on_epoch: Any = None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Weights by name, and figures: mean error of positions [m] on seen and unseen places."""
    import torch

    threads = torch.get_num_threads()
    # The network is too small to share out, and one thread gives the same bits everywhere.
    torch.set_num_threads(1)
    try:
        return _learn(lessons, shape, asked, on_epoch)
    finally:
        torch.set_num_threads(threads)


def _learn(
    lessons: Lessons, shape: PolicyShape, asked: Asked, on_epoch: Any
) -> tuple[dict[str, Any], dict[str, Any]]:
    import torch

    torch.manual_seed(asked.seed)
    model = network(shape)
    images, states, poses = map(torch.from_numpy, (lessons.images, lessons.states, lessons.poses))
    taught = torch.from_numpy(np.flatnonzero(~lessons.held))
    optimizer = torch.optim.AdamW(model.parameters(), lr=RATE, weight_decay=DECAY)
    steps = asked.epochs * -(-len(taught) // BATCH)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps)
    weight = torch.tensor([1.0, 1.0, YAW_WEIGHT])
    for epoch in range(asked.epochs):
        for rows in taught[torch.randperm(len(taught))].split(BATCH):
            brightness = 0.8 + 0.4 * torch.rand(len(rows), 1, 1, 1)
            answer = model(images[rows] * brightness, states[rows])
            loss = torch.nn.functional.smooth_l1_loss(
                answer * weight, poses[rows] * weight, beta=0.05
            )
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
        if on_epoch is not None:
            on_epoch("learn", epoch + 1, asked.epochs)
    with torch.inference_mode():
        apart = (model.eval()(images, states) - poses)[..., :2].norm(dim=2).mean(1) * REACH
    held = torch.from_numpy(lessons.held)
    figures = {
        "weights": sum(p.numel() for p in model.parameters()),
        "error_seen_m": float(apart[~held].mean()),
        "error_unseen_m": float(apart[held].mean()) if held.any() else None,
    }
    return dict(model.state_dict()), figures


def _shape(rig: CameraRig, asked: Asked) -> PolicyShape:
    if asked.camera is not None and asked.camera not in rig.names:
        raise CommandError(f"no camera {asked.camera!r}; there are {', '.join(rig.names)}")
    ahead = max(rig, key=lambda camera: camera.T_vehicle_camera[0, 2]).name
    return PolicyShape(camera=asked.camera or ahead)


def _told(views: Iterable[Seen], report: Any) -> Iterable[Seen]:
    for count, seen in enumerate(views, start=1):
        report("look", count, seen.count)
        yield seen


def _yaw(T_world_vehicle: NDArray[np.float64]) -> float:
    return float(np.arctan2(T_world_vehicle[1, 0], T_world_vehicle[0, 0]))


def _save(weights: dict[str, Any], shape: PolicyShape, out: Path) -> None:
    from safetensors.torch import save

    with atomic_file(out) as file:
        file.write(save(weights, metadata=shape.metadata()))
