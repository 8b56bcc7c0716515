"""The CPU backend matches the reference."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from real2sim_server.geometry import transform_from
from real2sim_server.render import Instance, RasterOptions, RenderOutput, rasterize
from real2sim_server.scene import GaussianCloud, Sky

WIDTH, HEIGHT = 150, 110
K = np.array([[[140.0, 0, 70], [0, 150, 60], [0, 0, 1]]])


def random_cloud(
    seed: int, *, count: int = 600, size: tuple[float, float] = (0.01, 0.5), bands: int = 16
) -> GaussianCloud:
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    low, high = (math.log(value) for value in size)
    span = torch.tensor([8.0, 6, 12])
    return GaussianCloud(
        means=uniform(count, 3) * span - span / 2 + torch.tensor([0, 0, 4.5]),
        quats=torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1),
        scales=torch.exp(uniform(count, 3) * (high - low) + low),
        opacities=uniform(count),
        sh=(uniform(count, bands, 3) - 0.5) * torch.tensor([2.0] + [0.3] * (bands - 1))[:, None],
    )


def needles(seed: int) -> GaussianCloud:
    cloud = random_cloud(seed, count=200)
    thin = cloud.scales.clone()
    thin[:, 0] = 5.0
    thin[:, 1:] = 1e-4
    return GaussianCloud(cloud.means, cloud.quats, thin, cloud.opacities, cloud.sh)


def with_opacity(seed: int, opacity: float) -> GaussianCloud:
    cloud = random_cloud(seed)
    opacities = torch.full_like(cloud.opacities, opacity)
    return GaussianCloud(cloud.means, cloud.quats, cloud.scales, opacities, cloud.sh)


def shifted(seed: int, offset: tuple[float, float, float]) -> GaussianCloud:
    cloud = random_cloud(seed)
    means = cloud.means + torch.tensor(offset)
    return GaussianCloud(means, cloud.quats, cloud.scales, cloud.opacities, cloud.sh)


CLOUDS = {
    **{f"random {seed}": random_cloud(seed) for seed in range(4)},
    **{f"{bands} bands": random_cloud(10 + bands, bands=bands) for bands in (1, 4, 9)},
    "many small": random_cloud(20, count=4000, size=(0.002, 0.05)),
    "dense": random_cloud(21, count=3000, size=(0.1, 0.4)),
    "needles": needles(22),
    "more needles": needles(23),
    "huge": random_cloud(24, count=60, size=(5, 1000)),
    "points": random_cloud(25, size=(1e-9, 1e-8)),
    "behind the camera": shifted(26, (0, 0, -20)),
    "around the camera": shifted(27, (0, 0, -4.5)),
    "off screen": shifted(28, (100, 0, 0)),
    "half off screen": shifted(29, (4, 3, 0)),
    "opacity 0": with_opacity(30, 0.0),
    "opacity 1": with_opacity(31, 1.0),
    "empty": GaussianCloud.empty(sh_degree=2),
}


def draw(cloud: GaussianCloud, backend: str, **options: object) -> RenderOutput:
    return rasterize(
        [Instance(cloud, instance_id=7)],
        np.eye(4)[None],
        K,
        WIDTH,
        HEIGHT,
        options=RasterOptions(background=(0.2, 0.4, 0.6), **options),  # type: ignore[arg-type]
        backend=backend,
    )


def assert_agree(given: RenderOutput, expected: RenderOutput, tolerance: float = 1 / 255) -> None:
    assert torch.isfinite(given.rgb).all()
    torch.testing.assert_close(given.rgb, expected.rgb, rtol=0, atol=tolerance)
    torch.testing.assert_close(given.alpha, expected.alpha, rtol=0, atol=tolerance)
    if given.depth is not None and expected.depth is not None:
        solid = expected.alpha > 0.1
        torch.testing.assert_close(given.depth[solid], expected.depth[solid], rtol=0.01, atol=1e-3)
    if given.instance is not None and expected.instance is not None:
        sure = (expected.alpha - 0.5).abs() > 1e-3
        assert torch.equal(given.instance[sure], expected.instance[sure])


@pytest.mark.parametrize("name", CLOUDS)
def test_cpu_matches_reference(name: str) -> None:
    assert_agree(draw(CLOUDS[name], "cpu"), draw(CLOUDS[name], "reference"))


def test_cpu_matches_reference_when_antialiased() -> None:
    cloud, mode = CLOUDS["many small"], "antialiased"
    assert_agree(
        draw(cloud, "cpu", rasterize_mode=mode), draw(cloud, "reference", rasterize_mode=mode)
    )


def test_cpu_matches_reference_with_planes_and_radius_clip() -> None:
    options = {"near_plane": 2.0, "far_plane": 6.0, "radius_clip": 3.0, "eps2d": 0.1}
    cloud = CLOUDS["random 0"]
    assert_agree(draw(cloud, "cpu", **options), draw(cloud, "reference", **options))


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize(("depth", "instance"), [(False, False), (True, False), (False, True)])
def test_rgb_does_not_depend_on_the_other_images(backend: str, depth: bool, instance: bool) -> None:
    everything = draw(CLOUDS["random 1"], backend)
    some = draw(CLOUDS["random 1"], backend, depth=depth, instance=instance)
    assert torch.equal(some.rgb, everything.rgb)
    assert (some.depth is not None, some.instance is not None) == (depth, instance)


def test_cpu_matches_reference_for_several_cameras_and_placed_instances() -> None:
    T_world_object = transform_from([0.5, 0.2, 6.0], np.array([0.9, 0.1, -0.3, 0.2]))
    covars = torch.diag_embed(torch.rand(600, 3, generator=torch.Generator().manual_seed(1)) * 0.02)
    instances = [
        Instance(CLOUDS["random 0"]),
        Instance(CLOUDS["4 bands"], T_world_object, 3, scale=(0.5, 0.2, 0.4)),
        Instance(CLOUDS["random 2"], T_world_object @ T_world_object, 65_535, covars=covars),
    ]
    viewmats = np.stack([np.eye(4), transform_from([0.3, 0, 1], [0.95, 0.1, 0.2, 0])])
    sky = Sky(torch.rand(6, 5, 5, 3, generator=torch.Generator().manual_seed(0)))
    given, expected = (
        rasterize(instances, viewmats, np.repeat(K, 2, 0), WIDTH, HEIGHT, sky=sky, backend=backend)
        for backend in ("cpu", "reference")
    )
    assert_agree(given, expected)
    assert set(expected.instance.int().unique().tolist()) == {0, 3, 65_535}
