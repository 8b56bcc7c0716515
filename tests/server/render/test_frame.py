"""Camera frames of a vehicle."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence

import numpy as np
import pytest
import torch

from real2sim_proto import SEMANTIC_CLASSES
from real2sim_server.geometry import transform_from, yaw_quaternion
from real2sim_server.render import (
    Instance,
    RasterOptions,
    RenderError,
    RenderOutput,
    RigView,
    render_cameras,
    render_rigs,
    select_backend,
    warm_up,
)
from real2sim_server.render.images import solid_depth, to_uint8
from real2sim_server.scene import Camera, GaussianCloud, Sky
from real2sim_server.scene.camera import T_VEHICLE_OPTICAL


def camera(name: str, width: int, height: int) -> Camera:
    K = np.array([[40.0, 0, width / 2], [0, 40, height / 2], [0, 0, 1]])
    return Camera(name, width, height, K, T_VEHICLE_OPTICAL)


def ball(position: tuple[float, float, float], rgb: tuple[float, float, float]) -> GaussianCloud:
    sh = ((torch.tensor(rgb) - 0.5) / 0.2820947917738781).reshape(1, 1, 3)
    return GaussianCloud(
        torch.tensor([position]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), 0.5),
        torch.ones(1),
        sh,
    )


def test_frames_keep_the_camera_order_for_mixed_sizes() -> None:
    cameras = [camera("a", 32, 20), camera("b", 20, 32), camera("c", 32, 20)]
    frames = render_cameras([], cameras, np.eye(4), backend="cpu")
    assert [frame.camera for frame in frames] == ["a", "b", "c"]
    assert [frame.rgb.shape for frame in frames] == [(20, 32, 3), (32, 20, 3), (20, 32, 3)]


def test_a_camera_turns_with_its_vehicle() -> None:
    red = Instance(ball((0.0, 5.0, 0.0), (1.0, 0.0, 0.0)), instance_id=4)
    ahead = transform_from([0, 0, 0], yaw_quaternion(np.pi / 2))
    looking, away = (
        render_cameras([red], [camera("front", 41, 31)], pose, backend="cpu")[0]
        for pose in (ahead, np.eye(4))
    )
    assert looking.rgb[15, 20].tolist() == [255, 0, 0]
    assert looking.instance is not None
    assert looking.instance[15, 20] == 4
    assert looking.depth is not None
    assert looking.depth[15, 20] == pytest.approx(5.0, abs=1e-4)
    assert away.rgb.max() == 0


def test_depth_is_zero_where_alpha_is_below_half() -> None:
    faint = ball((5.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    faint = GaussianCloud(faint.means, faint.quats, faint.scales, torch.tensor([0.4]), faint.sh)
    frame = render_cameras([Instance(faint)], [camera("front", 21, 21)], np.eye(4), backend="cpu")
    assert frame[0].rgb.max() > 50
    assert frame[0].depth is not None
    assert frame[0].depth.max() == 0


def test_semantic_class_is_the_dominant_object_or_the_sky() -> None:
    world = [Instance(ball((5.0, 0, 0), (1, 0, 0)), instance_id=1, semantic=26)]

    def classes(sky: Sky | None) -> list[int]:
        wanted = ["semantic"]
        views = [camera("front", 48, 40)]
        [frame] = render_cameras(
            world, views, np.eye(4), sky=sky, modalities=wanted, backend="reference"
        )
        return [int(frame.images["semantic"][at]) for at in ((20, 24), (0, 0))]

    assert classes(Sky.uniform((0.5, 0.6, 0.9))) == [26, SEMANTIC_CLASSES["sky"]]
    assert classes(None) == [26, SEMANTIC_CLASSES["unlabeled"]]


def test_small_images_of_several_vehicles_are_batched(monkeypatch) -> None:
    backend, drawn = select_backend("cpu"), []
    draw = type(backend).rasterize_batch

    def counted(self: object, requests: Sequence[object]) -> RenderOutput:
        drawn.append(len(requests))
        return draw(self, requests)

    monkeypatch.setattr(type(backend), "rasterize_batch", counted)
    cameras = [camera("a", 32, 20), camera("b", 20, 32), camera("c", 32, 20)]
    views = [
        RigView([Instance(ball((x, 0, 0), (1, x / 9, 0)), semantic=26)], cameras, np.eye(4))
        for x in (5.0, 7.0, 9.0)
    ]
    modalities, small = ("rgb", "depth", "instance", "semantic"), RasterOptions(detail="auto")
    together = render_rigs(views, options=small, modalities=modalities, backend=backend)
    assert drawn == [3, 3]
    for view, frames in zip(views, together, strict=True):
        [alone] = render_rigs([view], options=small, modalities=modalities, backend=backend)
        for one, other in zip(frames, alone, strict=True):
            assert one.camera == other.camera
            for name in modalities:
                np.testing.assert_array_equal(one.images[name], other.images[name])


def test_frame_pose_is_the_world_camera_pose() -> None:
    vehicle = transform_from([3, 4, 5], yaw_quaternion(0.3))
    frame = render_cameras([], [camera("front", 8, 8)], vehicle, backend="cpu")[0]
    np.testing.assert_allclose(frame.T_world_camera, vehicle @ T_VEHICLE_OPTICAL)


def test_only_requested_images_are_made() -> None:
    options = RasterOptions(depth=False, instance=False)
    frame = render_cameras(
        [],
        [camera("front", 8, 8)],
        np.eye(4),
        options=options,
        sky=Sky.uniform((1, 0.5, 0)),
        backend="cpu",
    )[0]
    assert (frame.depth, frame.instance) == (None, None)
    assert frame.rgb[0, 0].tolist() == [255, 128, 0]


def test_broken_vehicle_pose_is_refused() -> None:
    with pytest.raises(RenderError, match="T_world_vehicle"):
        render_cameras([], [camera("front", 8, 8)], np.full((4, 4), np.nan))


def test_rounding_to_bytes_clamps_and_rounds_halves_up() -> None:
    levels = torch.tensor([-1.0, 0.0, 0.5 / 255, 0.49 / 255, 0.5, 1.0, 7.0, float("nan")])
    assert to_uint8(levels).tolist() == [0, 0, 1, 0, 128, 255, 255, 0]


def test_solid_depth_keeps_exactly_half_covered_pixels() -> None:
    depth = solid_depth(torch.tensor([2.0, 3.0]), torch.tensor([0.5, 0.4999]))
    assert depth.tolist() == [2.0, 0.0]


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_warm_up_leaves_a_backend_ready(backend: str) -> None:
    warm_up(backend)
    assert len(render_cameras([], [camera("a", 4, 4)], np.eye(4), backend=backend)) == 1


def test_warm_up_progress_counts_all_kernels(worker_kernels: None) -> None:
    """Run in a new process without warm kernels."""
    program = (
        "from real2sim_server import render\n"
        "from real2sim_server._numba import made\n"
        "for warm_up in (render.warm_up, render.warm_up_small_images):\n"
        "    warm_up('cpu')\n"
        "    assert made.done == made.expected, (warm_up.__name__, made)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
