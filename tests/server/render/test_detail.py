"""Small images from merged Gaussians: quality and independence of the batch."""

from __future__ import annotations

import numba
import numpy as np
import pytest
import torch

from real2sim_server.demo.street import SHIPPED
from real2sim_server.edit import ScenarioState, instances_at
from real2sim_server.geometry import transform_from
from real2sim_server.render import (
    Instance,
    RasterOptions,
    RenderError,
    View,
    WorldViews,
    rasterize,
    rasterize_batch,
    rasterize_worlds,
)
from real2sim_server.render._cpu.detail_levels import hierarchy_of
from real2sim_server.render.rasterize import views_of
from real2sim_server.render.types import SMALL_IMAGE_PIXELS
from real2sim_server.scene import GaussianCloud, Scene, Sky, TimeColour
from real2sim_server.scene.io import read_packed

SIZE, FOCAL = 84, 60.0
K = np.array([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
FULL = RasterOptions(depth=False, instance=False)
AUTO = RasterOptions(depth=False, instance=False, detail="auto")
EVERYTHING = RasterOptions(detail="auto")
LARGER = 4
"""Supersampling factor of the ground truth."""


@pytest.fixture(scope="module")
def street() -> Scene:
    return read_packed(SHIPPED)


def views(street: Scene, camera: str = "front") -> list[View]:
    """84x84 views of a camera at two times of the recorded drive."""
    state = ScenarioState.of(street)
    times = [street.start_us + t for t in (0, 5_000_000)]
    rig = street.rig[camera]
    return [
        View(instances_at(street, state, t), rig.viewmat(street.ego.transform(t)), K) for t in times
    ]


def drawn(view: View, street: Scene, *, options: RasterOptions, times: int = 1) -> np.ndarray:
    enlarged = np.diag([times, times, 1.0]) @ np.asarray(view.K)
    size = SIZE * times
    matrices = np.asarray(view.viewmat)[None], enlarged[None]
    output = rasterize(
        view.instances, *matrices, size, size, sky=street.sky, options=options, backend="cpu"
    )
    return output.rgb[0].numpy().clip(0, 1)


def psnr(image: np.ndarray, truth: np.ndarray) -> float:
    return float(-10 * np.log10(((image - truth) ** 2).mean()))


@pytest.mark.parametrize("camera", ["front", "front_left", "front_right"])
def test_merged_gaussians_match_supersampling_like_all_gaussians(
    street: Scene, camera: str
) -> None:
    for view in views(street, camera):
        large = drawn(view, street, options=FULL, times=LARGER)
        truth = large.reshape(SIZE, LARGER, SIZE, LARGER, 3).mean((1, 3))
        reduced = psnr(drawn(view, street, options=AUTO), truth)
        assert reduced > psnr(drawn(view, street, options=FULL), truth) - 1.5
        assert reduced > 22


def test_batched_images_equal_single_images(street: Scene) -> None:
    given = views(street)
    batch = rasterize_batch(given, SIZE, SIZE, sky=street.sky, options=EVERYTHING, backend="cpu")
    assert batch.depth is not None
    assert batch.instance is not None
    for k, view in enumerate(given):
        alone = rasterize(
            view.instances,
            np.asarray(view.viewmat)[None],
            K[None],
            SIZE,
            SIZE,
            sky=street.sky,
            options=EVERYTHING,
            backend="cpu",
        )
        assert alone.depth is not None
        assert alone.instance is not None
        assert torch.equal(batch.rgb[k], alone.rgb[0])
        assert torch.equal(batch.depth[k], alone.depth[0])
        assert torch.equal(batch.instance[k], alone.instance[0])


def worlds_of_three() -> WorldViews:
    """Two worlds with two cameras: a wall, a wall with time-varying colour, and an empty cloud."""
    far = np.stack([transform_from([x, 0, 2.0], [1.0, 0, 0, 0]) for x in (-1.0, 0.0, 1.0)])
    poses = np.stack([far, far[::-1]])
    poses[1, 0] = np.nan
    cloud = wall(300)
    colour = TimeColour(torch.full((300, 2, 3), 0.4), "cosine", 0, 1_000_000)
    return WorldViews(
        things=(
            Instance(wall(200), instance_id=1),
            Instance(cloud, instance_id=2, scale=(0.5, 1.0, 1.0), colour=colour),
            Instance(GaussianCloud.empty()),
        ),
        poses=poses,
        shown=np.array([[True, True, True], [False, True, True]]),
        times_us=np.array([100_000, 700_000]),
        viewmats=np.tile(
            np.stack([np.eye(4), transform_from([1.0, 0, 0], [1.0, 0, 0, 0])]), (2, 1, 1, 1)
        ),
        Ks=np.stack([K, K * [[0.5], [0.5], [1.0]]]),
    )


def test_batched_worlds_equal_their_separate_views() -> None:
    worlds, sky = worlds_of_three(), Sky.uniform((0.2, 0.4, 0.6))
    one, many = (
        draw(given, 40, 30, sky=sky, options=EVERYTHING, backend="cpu")
        for draw, given in ((rasterize_batch, views_of(worlds)), (rasterize_worlds, worlds))
    )
    assert one.rgb.shape == (4, 30, 40, 3)
    for part in ("rgb", "alpha", "depth", "instance"):
        assert torch.equal(getattr(one, part), getattr(many, part)), part
    assert not torch.equal(many.rgb[0], many.rgb[2])


def test_any_backend_draws_worlds() -> None:
    small = rasterize_worlds(worlds_of_three(), 20, 16, backend="reference")
    assert small.rgb.shape == (4, 16, 20, 3)


def test_a_non_rigid_world_pose_is_refused_with_its_index() -> None:
    worlds = worlds_of_three()
    worlds.poses[1, 2] = np.nan
    with pytest.raises(RenderError, match=r"poses\[1, 2\]"):
        rasterize_worlds(worlds, 20, 16, backend="cpu")


def test_images_do_not_depend_on_the_number_of_threads(street: Scene) -> None:
    threads = numba.get_num_threads()
    images = []
    try:
        for count in (1, threads):
            numba.set_num_threads(count)
            images.append(rasterize_batch(views(street), SIZE, SIZE, backend="cpu").rgb)
    finally:
        numba.set_num_threads(threads)
    assert torch.equal(images[0], images[-1])


def test_auto_detail_does_not_change_large_images(street: Scene) -> None:
    view = views(street)[0]
    side = int(SMALL_IMAGE_PIXELS**0.5) + 1
    images = [
        rasterize(
            view.instances,
            np.asarray(view.viewmat)[None],
            K[None],
            side,
            side,
            sky=street.sky,
            options=options,
            backend="cpu",
        ).rgb
        for options in (FULL, AUTO)
    ]
    assert torch.equal(*images)


def test_depth_and_instance_of_a_small_image(street: Scene) -> None:
    full = RasterOptions()
    for view in views(street):
        arguments = (view.instances, np.asarray(view.viewmat)[None], K[None], SIZE, SIZE)
        every, reduced = (
            rasterize(*arguments, options=options, backend="cpu") for options in (full, EVERYTHING)
        )
        assert every.depth is not None
        assert reduced.depth is not None
        assert every.instance is not None
        assert reduced.instance is not None
        solid = (every.alpha > 0.9) & (reduced.alpha > 0.9)
        error = ((every.depth - reduced.depth).abs() / every.depth)[solid]
        assert float(error.median()) < 0.03
        same = every.instance.int() == reduced.instance.int()
        assert float(same.float().mean()) > 0.93


def wall(gaussians: int = 20_000, *, colour: float = 0.8, opacity: float = 0.9) -> GaussianCloud:
    """An 8 x 8 m wall, 10 m ahead of a camera at the origin."""
    random = torch.Generator().manual_seed(3)
    means = torch.rand(gaussians, 3, generator=random) * 8 - 4
    means[:, 2] = 10.0
    sh = torch.full((gaussians, 1, 3), (colour - 0.5) / 0.2820947917738781)
    return GaussianCloud(
        means=means,
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(gaussians, 1),
        scales=torch.tensor([[0.06, 0.06, 0.002]]).repeat(gaussians, 1),
        opacities=torch.full((gaussians,), opacity),
        sh=sh,
    )


def centre(instance: Instance, options: RasterOptions = AUTO, *, times: int = 1) -> np.ndarray:
    """Mean colour at the image centre of one instance, at ``times`` the resolution."""
    enlarged = np.diag([times, times, 1.0]) @ K
    size = SIZE * times
    output = rasterize(
        [instance], np.eye(4)[None], enlarged[None], size, size, options=options, backend="cpu"
    )
    middle = slice(30 * times, 54 * times)
    return output.rgb[0, middle, middle].mean((0, 1)).numpy()


def large_centre(instance: Instance) -> np.ndarray:
    return centre(instance, FULL, times=LARGER)


def test_a_merged_wall_keeps_its_colour() -> None:
    assert centre(Instance(wall())) == pytest.approx([0.8] * 3, abs=0.06)


def test_merged_transparent_gaussians_keep_their_transmittance() -> None:
    thin = Instance(wall(4_000, opacity=0.05))
    assert centre(thin) == pytest.approx(large_centre(thin), abs=0.02)


def test_invisible_gaussians_are_not_merged_into_others() -> None:
    cloud = wall()
    cloud.opacities[::2] = 0.0
    cloud.sh[::2] = -10.0
    assert centre(Instance(cloud)) == pytest.approx([0.8] * 3, abs=0.06)


def test_pose_and_scale_apply_to_merged_gaussians() -> None:
    pose = transform_from([0, 0, 5.0], np.array([1.0, 0, 0, 0]))
    small = Instance(wall(), pose, 7, scale=(0.1, 0.1, 0.5))
    output = rasterize(
        [small], np.eye(4)[None], K[None], SIZE, SIZE, options=EVERYTHING, backend="cpu"
    )
    assert output.instance is not None
    assert output.depth is not None
    inside = output.instance[0].int() == 7
    # 0.8 m at 10 m with a focal length of 60 px is 4.8 px.
    assert 3 <= int(inside.any(0).sum()) <= 7
    assert output.depth[0, 42, 42] == pytest.approx(10.0, abs=0.01)


def test_merged_gaussians_have_time_varying_colours() -> None:
    cloud = wall()
    coefficients = torch.full((len(cloud), 1, 3), 0.5)
    colour = TimeColour(coefficients, "cosine", 0, 1_000_000)
    for t_us in (0, 400_000, 1_000_000):
        instance = Instance(cloud, colour=colour, t_us=t_us)
        assert centre(instance) == pytest.approx(large_centre(instance), abs=0.06)


def test_deformed_clouds_use_their_covariances() -> None:
    cloud = wall(2_000)
    covars = (0.2**2 * torch.eye(3)).repeat(len(cloud), 1, 1)
    instance = Instance(cloud, covars=covars)
    assert centre(instance) == pytest.approx(large_centre(instance), abs=5e-3)


def test_an_empty_view_shows_the_sky() -> None:
    sky = Sky.uniform((0.2, 0.4, 0.6))
    empty = View([Instance(GaussianCloud.empty())], np.eye(4), K)
    image = rasterize_batch([empty], SIZE, SIZE, sky=sky, backend="cpu").rgb
    assert image[0, 5, 5].numpy() == pytest.approx([0.2, 0.4, 0.6], abs=1e-5)


def test_a_hierarchy_is_cached() -> None:
    cloud = wall(100)
    assert hierarchy_of(cloud) is hierarchy_of(cloud)


def test_other_backends_draw_batches() -> None:
    given = [View([Instance(wall(50))], np.eye(4), K)] * 2
    batch = rasterize_batch(given, 20, 16, backend="reference")
    assert batch.rgb.shape == (2, 16, 20, 3)
    assert batch.depth is None


def test_an_empty_batch_is_refused() -> None:
    with pytest.raises(RenderError, match="at least one view"):
        rasterize_batch([], SIZE, SIZE)


def test_an_unknown_detail_is_refused() -> None:
    options = RasterOptions(detail="some")  # type: ignore[arg-type]
    with pytest.raises(RenderError, match="detail"):
        rasterize([], np.eye(4)[None], K[None], SIZE, SIZE, options=options)
