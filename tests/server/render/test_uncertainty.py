"""Uncertainty images: the blended mean of each pixel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_server.render import (
    Instance,
    RasterOptions,
    RenderError,
    encode_image,
    render_cameras,
)
from real2sim_server.render.frame import uncertainty_picture
from real2sim_server.scene import UNSEEN, Camera, GaussianCloud, Sky
from real2sim_server.scene.camera import T_VEHICLE_OPTICAL

K = np.array([[40.0, 0, 24], [0, 40, 20], [0, 0, 1]])
FRONT = Camera("front", 48, 40, K, T_VEHICLE_OPTICAL)
MIDDLE, CORNER = (20, 24), (0, 0)


def ball(distance: float, *, opacity: float = 0.999, known: float | None = 0.1) -> Instance:
    cloud = GaussianCloud(
        torch.tensor([[distance, 0.0, 0.0]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), 0.5),
        torch.tensor([opacity]),
        torch.full((1, 1, 3), 1.5),
        None if known is None else torch.tensor([known]),
    )
    return Instance(cloud, instance_id=1)


def drawn(*world: Instance, sky: Sky | None = None, backend: str = "cpu", **given) -> np.ndarray:
    given = {"modalities": ["rgb", "uncertainty"]} | given
    [frame] = render_cameras(world, [FRONT], np.eye(4), sky=sky, backend=backend, **given)
    return frame.images["uncertainty"]


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_pixels_blend_uncertainty_by_weight(backend):
    image = drawn(ball(5, opacity=0.6, known=0.2), ball(8, known=0.04), backend=backend)
    assert (image.dtype, image.shape) == (np.float32, (40, 48))
    assert image[MIDDLE] == pytest.approx(0.6 * 0.2 + 0.4 * 0.04, abs=2e-3)
    assert image[CORNER] == pytest.approx(UNSEEN)


def test_the_sky_has_its_uncertainty_or_counts_as_unseen():
    sky = Sky.uniform((0.5, 0.6, 0.9), resolution=4)
    assert drawn(ball(5), sky=sky)[CORNER] == pytest.approx(UNSEEN)
    known = replace(sky, uncertainties=torch.full((6, 4, 4), 0.02))
    image = drawn(ball(5), sky=known)
    assert image[CORNER] == pytest.approx(0.02, abs=1e-5)
    assert image[MIDDLE] == pytest.approx(0.1, abs=3e-3)


def test_clouds_without_uncertainty_count_as_unseen():
    image = drawn(ball(5, known=None), ball(500, known=0.01))
    assert image[MIDDLE] == pytest.approx(UNSEEN, abs=3e-3)


def test_scenes_without_uncertainty_are_refused():
    with pytest.raises(RenderError, match="real2sim fit-uncertainty SCENE LOG"):
        drawn(ball(5, known=None))


def test_uncertainty_does_not_change_the_other_images():
    world = [ball(5, opacity=0.7), ball(8)]
    names = ["rgb", "depth", "instance"]
    options = {"sky": Sky.uniform((0.5, 0.6, 0.9)), "backend": "cpu"}
    [plain] = render_cameras(world, [FRONT], np.eye(4), modalities=names, **options)
    [both] = render_cameras(
        world, [FRONT], np.eye(4), modalities=[*names, "uncertainty"], **options
    )
    for name in names:
        np.testing.assert_array_equal(both.images[name], plain.images[name])
    alone = drawn(*world, sky=options["sky"], modalities=["uncertainty"])
    np.testing.assert_array_equal(alone, both.images["uncertainty"])


def test_merged_gaussians_have_the_mean_uncertainty():
    rng = np.random.default_rng(3)
    count = 4_000
    means = np.stack([np.full(count, 30.0), *rng.uniform(-20, 20, (2, count))], axis=1)
    cloud = GaussianCloud(
        torch.from_numpy(means).float(),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        torch.full((count, 3), 0.6),
        torch.full((count,), 0.9),
        torch.zeros(count, 1, 3),
        torch.from_numpy(rng.choice([0.02, 0.2], count)).float(),
    )
    full, merged = (
        drawn(Instance(cloud), options=RasterOptions(detail=detail)) for detail in ("full", "auto")
    )
    assert not np.array_equal(full, merged)
    assert merged.mean() == pytest.approx(full.mean(), rel=0.05)
    assert full.mean() == pytest.approx(0.11, rel=0.1)


def test_png_uncertainty_has_16_bits():
    import cv2

    image = np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4)
    encoded = encode_image(image, "uncertainty", "jpeg")
    assert (encoded.codec, encoded.dtype) == ("png", "uint16")
    read = cv2.imdecode(np.frombuffer(encoded.data, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(read / 65535, image, atol=0.5 / 65535)


def test_the_colour_map_runs_from_dark_to_bright():
    picture = uncertainty_picture(np.array([[0.0, UNSEEN / 2, UNSEEN, 1.0]], np.float32))
    brightness = picture.sum(-1)[0]
    assert brightness[0] < 20 < brightness[1] < brightness[2] == brightness[3]
