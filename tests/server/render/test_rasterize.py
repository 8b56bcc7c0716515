"""Images with pixels calculated by hand, for the CPU backend and the reference."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_server.geometry import (
    invert_transform,
    matrix_to_quaternion,
    multiply_quaternions,
    quaternion_to_matrix,
    transform_from,
)
from real2sim_server.render import Instance, RasterOptions, RenderError, RenderOutput, rasterize
from real2sim_server.scene import GaussianCloud, Sky, TimeColour

SIZE, FOCAL = 33, 60.0
K = np.array([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
CENTRE = SIZE // 2
TURN = transform_from([0.4, -0.3, 5.0], np.array([0.8, 0.2, -0.5, 0.1]))


@pytest.fixture(params=["cpu", "reference"])
def backend(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def cloud_of(*splats: tuple[float, float, tuple[float, float, float]]) -> GaussianCloud:
    """Isotropic Gaussians on the optical axis: (depth [m], opacity, rgb), 0.2 m wide."""
    depths, opacities, colors = zip(*splats, strict=True)
    n = len(splats)
    return GaussianCloud(
        torch.tensor([[0.0, 0.0, z] for z in depths]),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        torch.full((n, 3), 0.2),
        torch.tensor(opacities),
        ((torch.tensor(colors) - 0.5) / 0.28209479177387814)[:, None, :].float(),
    )


def random_cloud(seed: int, count: int = 120) -> GaussianCloud:
    generator = torch.Generator().manual_seed(seed)
    return GaussianCloud(
        torch.randn(count, 3, generator=generator) * 0.5,
        torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1),
        torch.rand(count, 3, generator=generator) * 0.3 + 0.02,
        torch.rand(count, generator=generator),
        torch.randn(count, 16, 3, generator=generator) * 0.3,
    )


def moved(cloud: GaussianCloud, T: np.ndarray) -> GaussianCloud:
    """The cloud with transformed means and quaternions, and unchanged colours."""
    quats = multiply_quaternions(matrix_to_quaternion(T[:3, :3]), cloud.quats.numpy())
    means = cloud.means.numpy() @ T[:3, :3].T + T[:3, 3]
    return GaussianCloud(
        torch.from_numpy(means).float(),
        torch.from_numpy(quats).float(),
        cloud.scales,
        cloud.opacities,
        cloud.sh,
    )


def look(
    instances: list[Instance],
    backend: str,
    *,
    viewmat: np.ndarray | None = None,
    sky: Sky | None = None,
    **options: object,
) -> RenderOutput:
    return rasterize(
        instances,
        (np.eye(4) if viewmat is None else viewmat)[None],
        K[None],
        SIZE,
        SIZE,
        sky=sky,
        options=RasterOptions(**options),  # type: ignore[arg-type]
        backend=backend,
    )


def test_alpha_of_one_gaussian_matches_the_formula(backend: str) -> None:
    alpha = look([Instance(cloud_of((4.0, 0.7, (1, 0, 0))))], backend).alpha[0]
    variance = (FOCAL * 0.2 / 4) ** 2 + 0.3
    for offset in (0, 1, 3, 6):
        expected = 0.7 * math.exp(-0.5 * offset**2 / variance)
        assert float(alpha[CENTRE, CENTRE + offset]) == pytest.approx(expected, abs=2e-5)
        assert float(alpha[CENTRE - offset, CENTRE]) == pytest.approx(expected, abs=2e-5)


def test_contributions_below_1_255_are_dropped(backend: str) -> None:
    alpha = look([Instance(cloud_of((4.0, 0.7, (1, 0, 0))))], backend).alpha[0, CENTRE]
    variance = (FOCAL * 0.2 / 4) ** 2 + 0.3
    reach = math.sqrt(2 * variance * math.log(255 * 0.7))
    assert float(alpha[CENTRE + math.floor(reach)]) >= 1 / 255
    assert float(alpha[CENTRE + math.ceil(reach)]) == 0


def test_gaussians_are_blended_by_depth(backend: str) -> None:
    near, far = (3.0, 0.6, (1.0, 0.0, 0.0)), (6.0, 0.5, (0.0, 1.0, 0.0))
    for splats in ((near, far), (far, near)):
        out = look([Instance(cloud_of(*splats))], backend, background=(0, 0, 1))
        expected = [0.6, 0.4 * 0.5, 0.4 * 0.5]
        assert out.rgb[0, CENTRE, CENTRE].tolist() == pytest.approx(expected, abs=1e-5)


def test_equal_depth_keeps_the_order_of_instances(backend: str) -> None:
    red, green = cloud_of((4.0, 0.5, (1, 0, 0))), cloud_of((4.0, 0.5, (0, 1, 0)))
    for first, second, expected in ((red, green, [0.5, 0.25, 0]), (green, red, [0.25, 0.5, 0])):
        out = look([Instance(first), Instance(second)], backend)
        assert out.rgb[0, CENTRE, CENTRE].tolist() == pytest.approx(expected, abs=1e-5)


def test_blending_stops_before_transmittance_falls_below_the_limit(backend: str) -> None:
    layers = [(2.0 + i, 0.999, (float(i == 0), float(i == 1), float(i == 2))) for i in range(3)]
    out = look([Instance(cloud_of(*layers))], backend)
    # Transmittance is 1e-3 after the first layer. The second would leave 1e-6 and is not drawn.
    assert out.rgb[0, CENTRE, CENTRE].tolist() == pytest.approx([0.999, 0, 0], abs=1e-5)
    assert float(out.alpha[0, CENTRE, CENTRE]) == pytest.approx(0.999, abs=1e-5)


def test_alpha_is_capped(backend: str) -> None:
    out = look([Instance(cloud_of((3.0, 1.0, (1, 1, 1))))], backend)
    assert float(out.alpha.max()) == pytest.approx(0.999, abs=1e-6)


def test_depth_is_the_weighted_mean_or_zero(backend: str) -> None:
    out = look([Instance(cloud_of((3.0, 0.6, (1, 0, 0)), (6.0, 0.5, (0, 1, 0))))], backend)
    assert out.depth is not None
    expected = (0.6 * 3 + 0.2 * 6) / 0.8
    assert float(out.depth[0, CENTRE, CENTRE]) == pytest.approx(expected, abs=1e-4)
    assert float(out.depth[0, 0, 0]) == 0


def test_depth_of_a_wall_is_its_distance_along_the_axis(backend: str) -> None:
    grid = torch.linspace(-3, 3, 41)
    y, x = torch.meshgrid(grid, grid, indexing="ij")
    means = torch.stack([x, y, torch.full_like(x, 5.0)], -1).reshape(-1, 3)
    n = len(means)
    wall = GaussianCloud(
        means,
        torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        torch.tensor([[0.12, 0.12, 0.01]]).repeat(n, 1),
        torch.full((n,), 0.9),
        torch.zeros(n, 1, 3),
    )
    out = look([Instance(wall)], backend)
    assert out.depth is not None
    torch.testing.assert_close(out.depth, torch.full_like(out.depth, 5.0), rtol=0, atol=1e-4)


def test_instance_is_where_transmittance_falls_to_half(backend: str) -> None:
    thin, solid = cloud_of((3.0, 0.3, (1, 0, 0))), cloud_of((5.0, 0.9, (0, 1, 0)))
    out = look([Instance(thin, instance_id=2), Instance(solid, instance_id=9)], backend)
    assert out.instance is not None
    assert int(out.instance[0, CENTRE, CENTRE]) == 9
    assert int(out.instance[0, 0, 0]) == 0
    alone = look([Instance(thin, instance_id=2)], backend)
    assert alone.instance is not None
    assert int(alone.instance.int().max()) == 0


def test_an_object_pose_equals_a_moved_cloud(backend: str) -> None:
    cloud = random_cloud(0)
    flat = GaussianCloud(
        cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.sh[:, :1].contiguous()
    )
    placed = look([Instance(flat, TURN)], backend)
    baked = look([Instance(moved(flat, TURN))], backend)
    torch.testing.assert_close(placed.rgb, baked.rgb, rtol=0, atol=1e-4)


def test_rotating_object_and_camera_together_changes_nothing(backend: str) -> None:
    cloud = random_cloud(1)
    start = transform_from([0, 0, 4.0], np.array([1.0, 0, 0, 0]))
    still = look([Instance(cloud, start)], backend)
    turned = look([Instance(cloud, TURN @ start)], backend, viewmat=invert_transform(TURN))
    torch.testing.assert_close(turned.rgb, still.rgb, rtol=0, atol=1e-4)


def test_view_dependent_colour_uses_the_object_frame(backend: str) -> None:
    cloud = cloud_of((0.0, 0.9, (0.5, 0.5, 0.5))).with_sh_degree(1)
    sh = cloud.sh.clone()
    sh[:, 2, 0] = 1.0  # redder seen along +z of the object than along -z
    cloud = GaussianCloud(cloud.means, cloud.quats, cloud.scales, cloud.opacities, sh)
    ahead = transform_from([0, 0, 4.0], np.array([1.0, 0, 0, 0]))
    turned_round = transform_from([0, 0, 4.0], np.array([0.0, 1, 0, 0]))
    reds = [
        float(look([Instance(cloud, pose)], backend).rgb[0, CENTRE, CENTRE, 0]) / 0.9
        for pose in (ahead, turned_round)
    ]
    assert reds == pytest.approx([0.5 + 0.4886025, 0.5 - 0.4886025], abs=1e-4)


def test_an_object_scale_equals_a_stretched_cloud(backend: str) -> None:
    cloud, scale = random_cloud(2), np.array([0.5, 1.5, 0.8])
    rotations = quaternion_to_matrix(cloud.quats.numpy())
    factor = scale[:, None] * rotations * cloud.scales.numpy()[:, None, :].astype(np.float64)
    stretched = GaussianCloud(
        cloud.means * torch.from_numpy(scale).float(),
        cloud.quats,
        cloud.scales,
        cloud.opacities,
        cloud.sh,
    )
    covars = torch.from_numpy(factor @ factor.transpose(0, 2, 1)).float()
    by_scale = look([Instance(cloud, TURN, scale=tuple(scale))], backend)
    by_hand = look([Instance(stretched, TURN, covars=covars)], backend)
    torch.testing.assert_close(by_scale.rgb, by_hand.rgb, rtol=0, atol=1e-4)


def test_covariances_replace_quaternions_and_scales(backend: str) -> None:
    cloud = random_cloud(3)
    rotations = torch.from_numpy(quaternion_to_matrix(cloud.quats.numpy()))
    factor = rotations * cloud.scales[:, None, :].double()
    other = GaussianCloud(
        cloud.means, cloud.quats.roll(1, 0), cloud.scales * 3, cloud.opacities, cloud.sh
    )
    given = look([Instance(other, TURN, covars=(factor @ factor.mT).float())], backend)
    expected = look([Instance(cloud, TURN)], backend)
    torch.testing.assert_close(given.rgb, expected.rgb, rtol=0, atol=1e-4)


def test_antialiasing_preserves_the_light_of_a_small_gaussian(backend: str) -> None:
    cloud = cloud_of((100.0, 0.9, (1, 1, 1)))
    sharp = (FOCAL * 0.2 / 100) ** 2
    classic = look([Instance(cloud)], backend).alpha[0, CENTRE, CENTRE]
    compensated = look([Instance(cloud)], backend, rasterize_mode="antialiased")
    expected = 0.9 * sharp / (sharp + 0.3)
    assert float(classic) == pytest.approx(0.9, abs=1e-4)
    assert float(compensated.alpha[0, CENTRE, CENTRE]) == pytest.approx(expected, abs=1e-4)


def test_gaussians_outside_the_clip_planes_are_not_drawn(backend: str) -> None:
    cloud = cloud_of((1.0, 0.9, (1, 1, 1)), (10.0, 0.9, (1, 1, 1)), (5.0, 0.4, (1, 1, 1)))
    out = look([Instance(cloud)], backend, near_plane=2.0, far_plane=8.0)
    assert float(out.alpha[0, CENTRE, CENTRE]) == pytest.approx(0.4, abs=1e-5)


def test_radius_clip_drops_small_gaussians(backend: str) -> None:
    cloud = cloud_of((4.0, 0.9, (1, 1, 1)), (100.0, 0.9, (1, 1, 1)))
    far_only = cloud.select(torch.tensor([1]))
    assert float(look([Instance(far_only)], backend, radius_clip=4.0).alpha.max()) == 0
    assert float(look([Instance(cloud)], backend, radius_clip=4.0).alpha.max()) > 0.8


def test_an_empty_scene_shows_the_background(backend: str) -> None:
    out = look([], backend, background=(0.1, 0.2, 0.3))
    assert out.rgb.shape == (1, SIZE, SIZE, 3)
    torch.testing.assert_close(out.rgb[0, 5, 7], torch.tensor([0.1, 0.2, 0.3]))
    assert float(out.alpha.max()) == 0


def test_sky_is_sampled_along_world_directions(backend: str) -> None:
    sky = Sky(torch.rand(6, 7, 7, 3, generator=torch.Generator().manual_seed(3)))
    for seed in range(6):
        quaternion = np.random.default_rng(seed).normal(size=4)
        T_world_camera = transform_from([1.0, 2, 3], quaternion)
        out = look([], backend, viewmat=invert_transform(T_world_camera), sky=sky)
        y, x = np.mgrid[:SIZE, :SIZE] + 0.5
        rays = np.stack([(x - K[0, 2]) / FOCAL, (y - K[1, 2]) / FOCAL, np.ones_like(x)], -1)
        directions = torch.from_numpy(rays @ T_world_camera[:3, :3].T)
        expected = sky.sample(directions).float()
        difference = (out.rgb[0] - expected).abs().amax(-1)
        # Cube faces are not blended, so a ray at an edge may sample either.
        assert float((difference > 1e-4).float().mean()) < 0.01


def test_sky_is_weighted_by_transmittance(backend: str) -> None:
    out = look([Instance(cloud_of((4.0, 0.7, (1, 0, 0))))], backend, sky=Sky.uniform((0, 0, 1)))
    assert out.rgb[0, CENTRE, CENTRE].tolist() == pytest.approx([0.7, 0, 0.3], abs=1e-5)
    assert out.rgb[0, 0, 0].tolist() == pytest.approx([0, 0, 1])


def test_time_varying_colours_are_evaluated_at_the_instance_time(backend: str) -> None:
    cloud = random_cloud(8)
    coefficients = torch.randn(120, 3, 3, generator=torch.Generator().manual_seed(9)) * 0.3
    colour = TimeColour(coefficients, "cosine", 0, 1000)
    for t_us in (0, 300, 1000):
        shown = look([Instance(cloud, TURN, colour=colour, t_us=t_us)], backend)
        baked = look([Instance(colour.at(cloud, t_us), TURN)], backend)
        torch.testing.assert_close(shown.rgb, baked.rgb, atol=2e-5, rtol=0)
        assert torch.equal(shown.alpha, baked.alpha)


def test_invalid_time_colours_are_refused(backend: str) -> None:
    few = TimeColour(torch.zeros(3, 2, 3), "cosine", 0, 1000)
    with pytest.raises(RenderError, match=r"instances\[0\].colour has 3 rows for a cloud of 120"):
        look([Instance(random_cloud(8), TURN, colour=few)], backend)
    broken = TimeColour(torch.full((120, 2, 3), torch.nan), "cosine", 0, 1000)
    with pytest.raises(RenderError, match="not finite"):
        look([Instance(random_cloud(8), TURN, colour=broken)], backend)


def test_partial_tiles_are_filled_to_the_edge(backend: str) -> None:
    for width, height in ((1, 1), (17, 5), (16, 33)):
        out = rasterize(
            [],
            np.eye(4)[None],
            K[None],
            width,
            height,
            options=RasterOptions(background=(1, 1, 1)),
            backend=backend,
        )
        assert out.rgb.shape == (1, height, width, 3)
        assert float(out.rgb.min()) == 1


def test_gradients_of_the_reference_match_finite_differences() -> None:
    cloud = random_cloud(4, count=6)
    # Wide enough that no pixel crosses the cutoff at 1/255.
    cloud = replace(cloud, means=cloud.means * 0.4, scales=cloud.scales + 1.5)

    def light(means: torch.Tensor, opacities: torch.Tensor) -> torch.Tensor:
        leaf = GaussianCloud(means, cloud.quats, cloud.scales, opacities, cloud.sh)
        return look([Instance(leaf, TURN)], "reference").rgb.double().square().sum()

    means = cloud.means.clone().requires_grad_()
    opacities = (cloud.opacities * 0.5 + 0.3).requires_grad_()
    light(means, opacities).backward()  # type: ignore[no-untyped-call]
    assert means.grad is not None
    assert opacities.grad is not None
    with torch.no_grad():
        for tensor, step in ((means, 2e-3), (opacities, 2e-3)):
            flat, grad = tensor.view(-1), tensor.grad.view(-1)
            for k in range(min(len(flat), 6)):
                value = float(flat[k])
                flat[k] = value + step
                more = light(means, opacities)
                flat[k] = value - step
                less = light(means, opacities)
                flat[k] = value
                expected = float(more - less) / (2 * step)
                assert float(grad[k]) == pytest.approx(expected, rel=0.01, abs=0.01)
