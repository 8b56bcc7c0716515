"""Gradients of the CPU backend match the reference, which torch differentiates in float64.

Tolerances are relative to the largest gradient of an input. 99 % of the values agree within
float32 rounding (about 1e-5). Pixels on the rim of a Gaussian, where alpha is cut off at 1/255, may
count in only one backend, which adds up to 1e-3 in these small scenes.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from real2sim_server.geometry import transform_from
from real2sim_server.render import Instance, RasterOptions, RenderOutput, rasterize
from real2sim_server.scene import GaussianCloud, Sky

WIDTH, HEIGHT = 75, 50
K = np.array([[70.0, 0, 37], [0, 66, 24], [0, 0, 1]])
CAMERAS = np.stack(
    [np.eye(4), transform_from([0.3, 0, 1], np.array([0.95, 0.1, 0.2, 0])), np.eye(4)]
)
POSE = transform_from([0.5, 0.2, 4.0], np.array([0.9, 0.1, -0.3, 0.2]))
RELATIVE, RELATIVE_OF_MOST = 1e-3, 5e-5
Leaves = dict[str, Tensor]


def cloud_leaves(seed: int, *, count: int = 250, bands: int = 16) -> Leaves:
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    span = torch.tensor([7.0, 5, 10])
    lengths = 0.5 + uniform(count, 1)
    return {
        "means": uniform(count, 3) * span - span / 2 + torch.tensor([0, 0, 4.5]),
        "quats": torch.nn.functional.normalize(uniform(count, 4) - 0.5, dim=-1) * lengths,
        "scales": torch.exp(uniform(count, 3) * 3 - 4),
        "opacities": uniform(count),
        "sh": (uniform(count, bands, 3) - 0.5) * torch.tensor([2.0] + [0.4] * (bands - 1))[:, None],
    }


def needle_leaves(seed: int) -> Leaves:
    leaves = cloud_leaves(seed, count=80)
    leaves["scales"] = torch.tensor([3.0, 1e-3, 1e-3]).repeat(80, 1)
    return leaves


def scene_leaves(seed: int) -> Leaves:
    generator = torch.Generator().manual_seed(100 + seed)
    factor = torch.randn(250, 3, 3, generator=generator) * 0.15
    parts = {
        "ground": cloud_leaves(seed),
        "car": cloud_leaves(seed + 10, bands=4),
        "cloth": cloud_leaves(seed + 20, bands=1),
    }
    leaves = {f"{name}.{part}": v for name, cloud in parts.items() for part, v in cloud.items()}
    return leaves | {
        "car.T_world_object": torch.from_numpy(POSE),
        "cloth.T_world_object": torch.from_numpy(POSE @ POSE).float(),
        "cloth.covars": factor @ factor.mT,
        "viewmats": torch.from_numpy(CAMERAS),
        "faces": torch.rand(6, 5, 5, 3, generator=generator),
    }


def cloud_of(leaves: Leaves, name: str) -> GaussianCloud:
    parts = ("means", "quats", "scales", "opacities", "sh")
    return GaussianCloud(*(leaves[f"{name}.{part}"] for part in parts))


def draw_scene(leaves: Leaves, backend: str, **options: object) -> RenderOutput:
    instances = [
        Instance(cloud_of(leaves, "ground")),
        Instance(cloud_of(leaves, "car"), leaves["car.T_world_object"], 3, scale=(0.5, 0.3, 0.4)),
        Instance(
            cloud_of(leaves, "cloth"),
            leaves["cloth.T_world_object"],
            7,
            covars=leaves["cloth.covars"],
        ),
    ]
    viewmats = leaves["viewmats"]
    return rasterize(
        instances,
        viewmats,
        np.repeat(K[None], len(viewmats), 0),
        WIDTH,
        HEIGHT,
        sky=Sky(leaves["faces"]),
        options=RasterOptions(**options),  # type: ignore[arg-type]
        backend=backend,
    )


def draw_cloud(leaves: Leaves, backend: str, **options: object) -> RenderOutput:
    return rasterize(
        [Instance(GaussianCloud(**leaves))],
        np.eye(4)[None],
        K[None],
        WIDTH,
        HEIGHT,
        options=RasterOptions(background=(0.3, 0.5, 0.2), **options),  # type: ignore[arg-type]
        backend=backend,
    )


def loss_of(output: RenderOutput, images: tuple[str, ...] = ("rgb", "alpha", "depth")) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    total = torch.zeros(())
    for name in ("rgb", "alpha", "depth"):
        image = getattr(output, name)
        weights = torch.randn(image.shape, generator=generator)
        if name in images:
            total = total + (image * weights).sum()
    return total


def gradients(draw, leaves: Leaves, backend: str, images=None, **options):  # type: ignore[no-untyped-def]
    own = {name: leaf.detach().clone().requires_grad_() for name, leaf in leaves.items()}
    output = draw(own, backend, **options)
    loss_of(output, *([images] if images else [])).backward()
    return {name: leaf.grad for name, leaf in own.items()}, output


def assert_agree(given: dict[str, Tensor | None], expected: dict[str, Tensor | None]) -> None:
    for name, reference in expected.items():
        mine = given[name]
        if reference is None:
            assert mine is None or not mine.any(), name
            continue
        assert mine is not None, name
        assert mine.dtype == reference.dtype, name
        largest = float(reference.abs().max())
        errors = (mine - reference).abs().flatten()
        worst, most = float(errors.max()), float(errors.quantile(0.99))
        assert worst <= RELATIVE * largest, f"{name}: {worst / largest:.1e} of {largest:.3g}"
        if errors.numel() > 100:
            assert most <= RELATIVE_OF_MOST * largest, f"{name}: mostly {most / largest:.1e}"


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("seed", range(3))
def test_all_gradients_match_the_reference(seed: int, mode: str) -> None:
    leaves = scene_leaves(seed)
    given, _ = gradients(draw_scene, leaves, "cpu", rasterize_mode=mode)
    expected, _ = gradients(draw_scene, leaves, "reference", rasterize_mode=mode)
    assert all(
        value is not None and value.any() for value in expected.values() if value is not None
    )
    assert_agree(given, expected)


@pytest.mark.parametrize("images", [("rgb",), ("alpha",), ("depth",), ("rgb", "depth")])
def test_gradients_match_for_a_subset_of_images(images: tuple[str, ...]) -> None:
    leaves = scene_leaves(5)
    given, _ = gradients(draw_scene, leaves, "cpu", images)
    expected, _ = gradients(draw_scene, leaves, "reference", images)
    assert_agree(given, expected)


@pytest.mark.parametrize("bands", [1, 4, 9, 16])
def test_gradients_match_for_each_sh_degree(bands: int) -> None:
    leaves = cloud_leaves(30 + bands, bands=bands)
    given, _ = gradients(draw_cloud, leaves, "cpu")
    expected, _ = gradients(draw_cloud, leaves, "reference")
    assert_agree(given, expected)


@pytest.mark.parametrize("seed", [40, 41])
def test_gradients_of_needles_match(seed: int) -> None:
    leaves = needle_leaves(seed)
    given, _ = gradients(draw_cloud, leaves, "cpu")
    expected, _ = gradients(draw_cloud, leaves, "reference")
    assert_agree(given, expected)


def test_gradients_match_with_early_termination() -> None:
    leaves = cloud_leaves(50, count=1500)
    leaves["opacities"] = 0.6 + 0.4 * leaves["opacities"]
    leaves["scales"] = leaves["scales"] * 4
    given, output = gradients(draw_cloud, leaves, "cpu")
    expected, _ = gradients(draw_cloud, leaves, "reference")
    assert float(output.alpha.detach().quantile(0.5)) > 0.999
    assert_agree(given, expected)


def test_gradients_match_with_planes_radius_clip_and_blur() -> None:
    options = {"near_plane": 2.0, "far_plane": 6.0, "radius_clip": 3.0, "eps2d": 0.1}
    leaves = cloud_leaves(60)
    given, _ = gradients(draw_cloud, leaves, "cpu", **options)
    expected, _ = gradients(draw_cloud, leaves, "reference", **options)
    assert_agree(given, expected)


def test_gradients_of_several_cameras_add_up() -> None:
    leaves = scene_leaves(6)
    together, _ = gradients(draw_scene, leaves, "cpu", ("rgb",))
    generator = torch.Generator().manual_seed(1)
    weights = torch.randn(len(CAMERAS), HEIGHT, WIDTH, 3, generator=generator)
    sums = {name: torch.zeros_like(leaf) for name, leaf in leaves.items()}
    for camera in range(len(CAMERAS)):
        own = {name: leaf.detach().clone().requires_grad_() for name, leaf in leaves.items()}
        one = draw_scene(own | {"viewmats": own["viewmats"][camera : camera + 1]}, "cpu")
        (one.rgb * weights[camera]).sum().backward()
        for name, leaf in own.items():
            if leaf.grad is not None:
                sums[name] += leaf.grad
    unused = {"cloth.quats", "cloth.scales"}
    for name in leaves.keys() - unused:
        assert together[name] is not None
        torch.testing.assert_close(together[name], sums[name], rtol=1e-5, atol=1e-4, msg=name)


def test_gradients_of_a_cloud_used_twice_add_up() -> None:
    leaves = cloud_leaves(70)

    def draw(own: Leaves, backend: str) -> RenderOutput:
        cloud = GaussianCloud(**own)
        placed = [Instance(cloud), Instance(cloud, POSE, 1)]
        return rasterize(placed, np.eye(4)[None], K[None], WIDTH, HEIGHT, backend=backend)

    given, _ = gradients(draw, leaves, "cpu")
    expected, _ = gradients(draw, leaves, "reference")
    assert_agree(given, expected)


def test_screen_statistics_match_the_reference() -> None:
    leaves = scene_leaves(7)
    _, given = gradients(draw_scene, leaves, "cpu", track_screen=True)
    _, expected = gradients(draw_scene, leaves, "reference", track_screen=True)
    assert given.screen is not None
    assert expected.screen is not None
    for mine, reference in zip(given.screen.radii, expected.screen.radii, strict=True):
        # At the image border a Gaussian may cover no pixel centre, and ceil may differ by one.
        different = (mine - reference).abs() > 0
        assert different.float().mean() < 0.02
        assert (mine - reference)[(mine > 0) & (reference > 0)].abs().max() <= 1
    for mine, reference in zip(given.screen.gradients, expected.screen.gradients, strict=True):
        largest = reference.amax(0)
        assert (largest > 0).all()
        assert ((mine - reference).abs().amax(0) <= RELATIVE * largest).all()
        assert (mine[:, 1] >= mine[:, 0] * (1 - 1e-4)).all()


def test_images_are_the_same_with_and_without_gradients() -> None:
    leaves = scene_leaves(8)
    plain = draw_scene(leaves, "cpu")
    own = {name: leaf.detach().clone().requires_grad_() for name, leaf in leaves.items()}
    carrying = draw_scene(own, "cpu")
    for name in ("rgb", "alpha", "depth", "instance"):
        assert torch.equal(getattr(plain, name), getattr(carrying, name).detach()), name
    assert carrying.rgb.requires_grad
    assert not plain.rgb.requires_grad
    with torch.no_grad():
        assert not draw_scene(own, "cpu").rgb.requires_grad
