"""The number of launches, copies and waits per serving frame does not depend on the world."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from real2sim_server.geometry import transform_from
from real2sim_server.render import (
    Frame,
    Instance,
    RigView,
    rasterize,
    render_cameras,
    render_rigs,
)
from real2sim_server.render._cuda.serving import NvrtcBackend
from real2sim_server.scene import Camera, GaussianCloud, Sky, TimeColour
from real2sim_server.scene.camera import T_VEHICLE_OPTICAL

from ..render.kernel_twin import COMPILER, NEEDS_COMPILER
from . import pretended
from .pretended_launcher import PretendedLauncher

pytestmark = pytest.mark.skipif(COMPILER is None, reason=NEEDS_COMPILER)
SKY = Sky.uniform((0.3, 0.5, 0.9), resolution=8)


@pytest.fixture
def serving(device_counts: pretended.Counts) -> NvrtcBackend:
    return NvrtcBackend(PretendedLauncher())


def cloud(seed: int, count: int = 30) -> GaussianCloud:
    rng = np.random.default_rng(seed)
    parts = (
        rng.uniform((4, -4, -1), (12, 4, 3), (count, 3)),
        rng.normal(size=(count, 4)),
        np.exp(rng.uniform(-3, -1, (count, 3))),
        rng.uniform(0, 1, count),
        rng.normal(0, 0.3, (count, 4, 3)),
    )
    return GaussianCloud(*(torch.from_numpy(part.astype(np.float32)) for part in parts))


def cameras() -> list[Camera]:
    sizes = [(32, 20), (20, 32), (32, 20), (48, 16), (32, 20)]
    return [
        Camera(
            f"camera {k}",
            width,
            height,
            np.array([[20.0, 0, width / 2], [0, 20, height / 2], [0, 0, 1]]),
            T_VEHICLE_OPTICAL,
        )
        for k, (width, height) in enumerate(sizes)
    ]


def world(objects: int, seconds: float = 0.0) -> list[Instance]:
    made = [Instance(CLOUDS[0], colour=COLOUR, t_us=int(seconds * 1e6))]
    for k in range(objects):
        pose = transform_from([0.1 * k + seconds, 0.2, 0.0], np.array([1.0, 0, 0, 0.01 * k]))
        made.append(Instance(CLOUDS[1 + k % 3], pose, k + 1))
    return made


CLOUDS = [cloud(seed) for seed in range(4)]
COLOUR = TimeColour(torch.full((30, 2, 3), 0.1), "cosine", 0, 10**7)


@pytest.mark.parametrize("objects", [2, 40])
def test_a_frame_needs_one_copy_to_the_device_and_few_launches(
    serving: NvrtcBackend, device_counts: pretended.Counts, objects: int
) -> None:
    def draw(seconds: float) -> None:
        drawn = world(objects, seconds)
        wanted = ["rgb", "depth", "instance"]
        render_cameras(drawn, cameras(), np.eye(4), sky=SKY, modalities=wanted, backend=serving)

    draw(0.0)  # Uploads the clouds and reserves memory.
    device_counts.__init__()  # type: ignore[misc]
    draw(0.5)
    assert device_counts.launches <= 25
    assert device_counts.to_device == 1
    # One for the kernel counters and one for all images. The next frame is drawn during the second.
    assert device_counts.to_host == 2
    assert device_counts.waits == 2


def test_the_next_frame_is_drawn_before_the_last_one_is_copied(
    serving: NvrtcBackend, device_counts: pretended.Counts
) -> None:
    def started(seconds: float) -> list[Frame]:
        view = RigView(world(3, seconds), cameras(), np.eye(4), SKY)
        wanted = ["rgb", "depth"]
        return render_rigs([view], modalities=wanted, backend=serving, waits=False)[0]

    started(0.0)
    device_counts.__init__()  # type: ignore[misc]
    first, second = started(0.2), started(0.6)
    # Each frame has waited for the counters of its kernels, but for no image.
    assert (device_counts.to_host, device_counts.waits) == (2, 2)
    for frames, seconds in ((first, 0.2), (second, 0.6)):
        expected = render_cameras(world(3, seconds), cameras(), np.eye(4), sky=SKY, backend=serving)
        for frame, other in zip(frames, expected, strict=True):
            frame.ready()
            np.testing.assert_array_equal(frame.rgb, other.rgb)
            np.testing.assert_array_equal(frame.images["depth"], other.images["depth"])


def test_device_images_match_the_reference(serving: NvrtcBackend) -> None:
    viewmats = np.stack([camera.viewmat(np.eye(4)) for camera in cameras()[:1]])
    Ks = np.stack([camera.K for camera in cameras()[:1]])
    given, expected = (
        rasterize(world(5, 0.2), viewmats, Ks, 32, 20, sky=SKY, backend=backend)
        for backend in (serving, "reference")
    )
    assert given.rgb.device.type == "pretended"
    assert float((given.rgb.cpu() - expected.rgb).abs().max()) < 1 / 255
    assert given.instance is not None
    assert expected.instance is not None
    assert torch.equal(given.instance.cpu(), expected.instance)


def test_device_frames_match_the_reference(serving: NvrtcBackend) -> None:
    given, expected = (
        render_cameras(world(5, 0.2), cameras()[:2], np.eye(4), sky=SKY, backend=backend)
        for backend in (serving, "reference")
    )
    for one, other in zip(given, expected, strict=True):
        assert np.abs(one.rgb.astype(int) - other.rgb.astype(int)).max() <= 1
        assert one.depth is not None
        assert other.depth is not None
        np.testing.assert_allclose(one.depth, other.depth, rtol=1e-4, atol=1e-4)
        np.testing.assert_array_equal(one.images["instance"], other.images["instance"])
