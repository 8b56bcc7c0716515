"""Labels from one pass against separate passes."""

from __future__ import annotations

import numba
import numpy as np
import pytest
import torch

from real2sim_server.render import Instance, RasterOptions, rasterize, select_backend
from real2sim_server.render.rasterize import checked_request
from real2sim_server.render.types import Window
from real2sim_server.scene import GaussianCloud, Sky

WIDTH, HEIGHT = 104, 72
K = np.array([[[90.0, 0, 52], [0, 90, 36], [0, 0, 1]]])
WINDOWS = [Window(3, 0, 0, WIDTH, HEIGHT), Window(5, 20, 10, 71, 60)]
SKY = Sky.uniform((0.4, 0.5, 0.6))


def cloud(count: int, seed: int) -> GaussianCloud:
    generator = np.random.default_rng(seed)
    parts = (
        generator.uniform((-2, -1.5, -1), (2, 1.5, 1), (count, 3)),
        generator.normal(size=(count, 4)),
        np.exp(generator.uniform(-4, -1.5, (count, 3))),
        generator.uniform(0.2, 1, count),
        generator.normal(0, 0.3, (count, 4, 3)),
    )
    return GaussianCloud(*(torch.from_numpy(part.astype(np.float32)) for part in parts))


def at(z: float, x: float = 0.0) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = x, 0, z
    return pose


@pytest.fixture(scope="module")
def instances() -> list[Instance]:
    """A background and two objects, one partly occluded."""
    return [
        Instance(cloud(600, 1), at(8)),
        Instance(cloud(400, 2), at(4, 0.5), 3),
        Instance(cloud(400, 3), at(6, -0.8), 5),
    ]


def label(instances, *, along_rays=False, level=0.5):
    request = checked_request(instances, np.eye(4)[None], K, (WIDTH, HEIGHT), sky=SKY)
    backend = select_backend("cpu")
    (found,) = backend.label(request, [WINDOWS], level=level, along_rays=along_rays)
    return found


def drawn(instances, *, sky=SKY):
    options = RasterOptions(depth=False, median_depth=True)
    return rasterize(
        instances, np.eye(4)[None], K, WIDTH, HEIGHT, sky=sky, options=options, backend="cpu"
    )


def test_labels_equal_separate_passes(instances):
    found, passes = label(instances), drawn(instances)
    assert torch.equal(found.rgb, passes.rgb[0])
    np.testing.assert_array_equal(found.depth, passes.median_depth[0].numpy())
    np.testing.assert_array_equal(found.instance, passes.instance[0].numpy())
    assert set(np.unique(found.instance)) == {0, 3, 5}


def test_object_depths_equal_objects_drawn_alone(instances):
    for window, alone in zip(WINDOWS, label(instances).alone, strict=True):
        own = [i for i in instances if i.instance_id == window.instance_id]
        depth = drawn(own).median_depth[0].numpy()
        part = depth[window.top : window.bottom, window.left : window.right]
        np.testing.assert_array_equal(alone, part)
        assert (alone > 0).mean() > 0.3


def test_labels_do_not_depend_on_the_number_of_threads(instances):
    threads, one = numba.get_num_threads(), label(instances, along_rays=True)
    try:
        numba.set_num_threads(1)
        other = label(instances, along_rays=True)
    finally:
        numba.set_num_threads(threads)
    assert torch.equal(one.rgb, other.rgb)
    for first, second in zip(
        (one.depth, one.instance, *one.alone), (other.depth, other.instance, *other.alone),
        strict=True,
    ):  # fmt: skip
        np.testing.assert_array_equal(first, second)


def test_depth_along_rays_follows_the_disc():
    """A large disc tilted by 60 degrees, whose depth varies by metres across the image."""
    turn = torch.tensor([[np.cos(np.pi / 6), 0, np.sin(np.pi / 6), 0]], dtype=torch.float32)
    disc = GaussianCloud(
        means=torch.tensor([[0.0, 0, 0]]),
        quats=turn,
        scales=torch.tensor([[2.0, 2.0, 1e-3]]),
        opacities=torch.tensor([0.99]),
        sh=torch.zeros(1, 1, 3),
    )
    found = label([Instance(disc, at(6))], along_rays=True)
    x = (np.arange(WIDTH) + 0.5 - 52) / 90
    # The plane through (0, 0, 6) with its normal tilted by 60 degrees: z = 6 - tan(60) x.
    true = 6 / (1 + np.tan(np.pi / 3) * x)
    seen = found.depth[36] > 0
    assert seen.sum() > 25
    np.testing.assert_allclose(found.depth[36][seen], true[seen], rtol=0.01)
    assert np.ptp(true[seen]) > 0.5


def test_a_lower_level_gives_no_smaller_depths(instances):
    half, fifth = label(instances, level=0.5).depth, label(instances, level=0.2).depth
    assert ((fifth > 0) == (half > 0)).all()
    assert (fifth >= half).all()
    assert (fifth > half).any()
