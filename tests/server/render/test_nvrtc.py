"""The serving kernels, compiled for the CPU, match the reference."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_server.geometry import transform_from
from real2sim_server.render import (
    Instance,
    RasterOptions,
    RenderError,
    RenderOutput,
    WorldViews,
    rasterize,
    rasterize_worlds,
    render_cameras,
)
from real2sim_server.render._cuda import launcher
from real2sim_server.render._cuda import serving as backend_module
from real2sim_server.render._cuda.frame_memory import tables_of, tile_passes
from real2sim_server.render._cuda.needs import unmet_nvrtc_need
from real2sim_server.render._cuda.serving import NvrtcBackend
from real2sim_server.render.backend import RasterRequest
from real2sim_server.render.rasterize import checked_request, views_of
from real2sim_server.scene import Camera, GaussianCloud, Sky, TimeColour

from .kernel_twin import COMPILER, NEEDS_COMPILER, TwinLauncher, twin

pytestmark = pytest.mark.skipif(COMPILER is None, reason=NEEDS_COMPILER)

WIDTH, HEIGHT = 45, 37
K = np.array([[50.0, 0, 22], [0, 54, 19], [0, 0, 1]])
POSE = transform_from([0.5, 0.2, 6.0], np.array([0.9, 0.1, -0.3, 0.2]))
SECOND = transform_from([0.3, 0, 1], np.array([0.95, 0.1, 0.2, 0]))
SKY = Sky(torch.rand(6, 5, 5, 3, generator=torch.Generator().manual_seed(1)))


@pytest.fixture
def serving() -> NvrtcBackend:
    return NvrtcBackend(TwinLauncher())


def cloud(seed: int, *, bands: int = 16, count: int = 70) -> GaussianCloud:
    rng = np.random.default_rng(seed)
    parts = (
        rng.uniform((-4, -3, -1.5), (4, 3, 10), (count, 3)),
        rng.normal(size=(count, 4)),
        np.exp(rng.uniform(-3.5, -0.7, (count, 3))),
        rng.uniform(0, 1, count),
        rng.normal(0, 0.3, (count, bands, 3)),
    )
    return GaussianCloud(*(torch.from_numpy(part.astype(np.float32)) for part in parts))


def everything() -> list[Instance]:
    covars = torch.diag_embed(torch.rand(70, 3, generator=torch.Generator().manual_seed(1)) * 0.02)
    colour = TimeColour(torch.full((70, 2, 3), 0.1), "cosine", 0, 100)
    return [
        Instance(cloud(0)),
        Instance(cloud(1, bands=4), POSE, 3, scale=(0.5, 0.2, 0.4), colour=colour, t_us=30),
        Instance(cloud(2, bands=1), POSE @ POSE, 65_535, covars=covars),
    ]


def shifted(instances: list[Instance], offset: np.ndarray) -> list[Instance]:
    """The scene translated by ``offset``."""
    moved = []
    for instance in instances:
        if instance.T_world_object is None:
            means = (instance.cloud.means.double() + torch.from_numpy(offset)).float()
            moved.append(replace(instance, cloud=replace(instance.cloud, means=means)))
        else:
            pose = np.array(instance.T_world_object)
            pose[:3, 3] += offset
            moved.append(replace(instance, T_world_object=pose))
    return moved


def viewmats_at(offset: np.ndarray) -> np.ndarray:
    back = np.eye(4)
    back[:3, 3] = -offset
    return np.stack([back, SECOND @ back])


def draw(
    backend: NvrtcBackend | str, instances: list[Instance], options: RasterOptions, at: np.ndarray
) -> RenderOutput:
    Ks = np.repeat(K[None], 2, 0)
    return rasterize(
        instances, viewmats_at(at), Ks, WIDTH, HEIGHT, sky=SKY, options=options, backend=backend
    )


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("kilometres", [0, 2, 10])
def test_images_match_the_reference(serving: NvrtcBackend, kilometres: float, mode: str) -> None:
    at = np.array([0.8, -0.6, 0]) * 1e3 * kilometres
    instances, options = shifted(everything(), at), RasterOptions(rasterize_mode=mode)
    given, expected = (draw(b, instances, options, at) for b in (serving, "reference"))
    # The kernels differ from the float64 reference only by rounding.
    torch.testing.assert_close(given.rgb, expected.rgb, rtol=0, atol=1e-4)
    torch.testing.assert_close(given.alpha, expected.alpha, rtol=0, atol=1e-4)
    assert given.depth is not None
    assert expected.depth is not None
    solid = expected.alpha > 0.1
    torch.testing.assert_close(given.depth[solid], expected.depth[solid], rtol=1e-4, atol=1e-4)
    assert given.instance is not None
    assert expected.instance is not None
    assert torch.equal(given.instance, expected.instance)
    assert len(set(expected.instance.int().unique().tolist())) > 1


@pytest.mark.gpu
@pytest.mark.skipif(
    unmet_nvrtc_need() is not None, reason="no GPU that the kernels can be compiled for"
)
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_gpu_images_equal_cpu_images(serving: NvrtcBackend, mode: str) -> None:
    options = RasterOptions(rasterize_mode=mode)
    instances = [Instance(cloud(7, count=2500, bands=1)), *everything()]
    on_gpu, on_cpu = (
        draw(backend, instances, options, np.zeros(3)) for backend in (NvrtcBackend(), serving)
    )
    for name in ("rgb", "alpha", "depth", "instance"):
        assert torch.equal(getattr(on_gpu, name).cpu(), getattr(on_cpu, name))


def requests_of(
    sizes: list[tuple[int, int]], instances: list[Instance], options: RasterOptions | None = None
) -> list[RasterRequest]:
    return [
        checked_request(
            instances,
            np.stack([np.eye(4), SECOND]),
            np.repeat(K[None], 2, 0),
            size,
            sky=SKY,
            options=options or RasterOptions(),
        )
        for size in sizes
    ]


def test_cameras_of_several_sizes_share_launches() -> None:
    launcher = TwinLauncher()
    serving = NvrtcBackend(launcher)
    requests = requests_of([(45, 37), (20, 50), (70, 16)], everything())
    alone = [serving.frames([request], ["rgb", "depth", "instance"])[0] for request in requests]
    launcher.launches.clear()
    together = serving.frames(requests, ["rgb", "depth", "instance"])
    assert sum(launcher.launches.values()) <= 25
    for one, other in zip(alone, together, strict=True):
        for name in one:
            np.testing.assert_array_equal(one[name], other[name])


def test_finished_frames_match_the_raw_output(serving: NvrtcBackend) -> None:
    [request] = requests_of([(45, 37)], everything())
    [finished] = serving.frames([request], ["rgb", "depth", "instance"])
    output = serving.rasterize(request)
    assert output.depth is not None
    assert output.instance is not None
    levels = (output.rgb.clamp(0, 1) * 255 + 0.5).to(torch.uint8)
    np.testing.assert_array_equal(finished["rgb"], levels.numpy())
    solid = output.depth.where(output.alpha >= 0.5, 0.0)
    np.testing.assert_array_equal(finished["depth"], solid.numpy())
    np.testing.assert_array_equal(finished["instance"], output.instance.numpy())


def test_images_do_not_depend_on_block_and_thread_order(serving: NvrtcBackend) -> None:
    backwards = NvrtcBackend(TwinLauncher(backwards=True))
    instances = [Instance(cloud(7, count=2500, bands=1)), *everything()]
    one, other = (draw(b, instances, RasterOptions(), np.zeros(3)) for b in (serving, backwards))
    for name in ("rgb", "alpha", "depth", "instance"):
        assert torch.equal(getattr(one, name), getattr(other, name))


def test_sessions_share_the_background(serving: NvrtcBackend) -> None:
    background = cloud(0)
    worlds = [[Instance(background), Instance(cloud(seed, bands=4), POSE, seed)] for seed in (3, 4)]
    requests = [requests_of([(45, 37)], world)[0] for world in worlds]
    tables = tables_of(requests, serving._device_scene, serving._launcher)
    assert tables.objects["cameras"].tolist() == [4, 2, 2]
    for request, images in zip(requests, serving.frames(requests, ["rgb"]), strict=True):
        [alone] = serving.frames([request], ["rgb"])
        np.testing.assert_array_equal(images["rgb"], alone["rgb"])


def sheet(depths: list[float], opacity: float, side: float) -> GaussianCloud:
    """Gaussians one behind the other. A large ``side`` covers the image."""
    n = len(depths)
    return GaussianCloud(
        torch.tensor([[0.0, 0.0, depth] for depth in depths]),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        torch.full((n, 3), side),
        torch.full((n,), opacity),
        torch.zeros(n, 1, 3),
    )


def test_equal_depths_keep_the_instance_order(serving: NvrtcBackend) -> None:
    worlds = [
        [Instance(sheet([5.0], 0.9, 2.0), None, k) for k in order] for order in ((1, 2), (2, 1))
    ]
    found = [serving.frames(requests_of([(45, 37)], w), ["instance"])[0] for w in worlds]
    assert [images["instance"][0, 19, 22] for images in found] == [1, 2]


def test_a_frame_that_exceeds_its_buffers_is_redrawn(serving: NvrtcBackend) -> None:
    large = Instance(sheet(np.linspace(3, 9, 1100).tolist(), 0.02, 50.0))
    output = draw(serving, [large], RasterOptions(), np.zeros(3))
    assert serving._launcher.launches["blend"] > 1
    assert serving._memory.pair_capacity >= 2 * 1100 * 9
    # The 456th layer would reduce the transmittance below 1e-4.
    assert float(output.alpha[0, 19, 22]) == pytest.approx(1 - 0.98**455, abs=1e-5)
    drawn_once = draw(serving, [large], RasterOptions(), np.zeros(3))
    assert torch.equal(output.rgb, drawn_once.rgb)


def test_an_empty_scene_shows_the_background(serving: NvrtcBackend) -> None:
    options = RasterOptions(background=(0.1, 0.2, 0.3))
    output = rasterize([], np.eye(4)[None], K[None], 20, 10, options=options, backend=serving)
    assert output.rgb[0, 3, 4].tolist() == pytest.approx([0.1, 0.2, 0.3])
    assert float(output.alpha.max()) == 0


def test_cameras_beyond_the_frame_limit_are_split(
    serving: NvrtcBackend, monkeypatch: pytest.MonkeyPatch
) -> None:
    requests = requests_of([(16, 16), (20, 18), (16, 16)], everything())
    whole = serving.frames(requests, ["rgb"])
    for name, limit in (("MAX_CAMERAS", 1), ("MAX_PIXELS", 700)):
        with monkeypatch.context() as changed:
            changed.setattr(backend_module, name, limit)
            parts = serving.frames(requests, ["rgb"])
        for one, other in zip(whole, parts, strict=True):
            np.testing.assert_array_equal(one["rgb"], other["rgb"])


def test_small_images_of_many_worlds_are_batched() -> None:
    launcher = TwinLauncher()
    street, car = Instance(cloud(0, bands=4)), Instance(cloud(3, bands=4), POSE, 3)
    poses = np.stack([np.stack([np.eye(4), POSE]), np.stack([np.eye(4), POSE @ POSE])])
    worlds = WorldViews(
        things=(street, car),
        poses=np.concatenate([poses, poses[:1]]),
        shown=np.array([[True, True], [True, True], [True, False]]),
        viewmats=np.repeat(np.stack([np.eye(4), SECOND])[None], 3, 0),
        Ks=np.repeat(K[None], 2, 0),
        times_us=np.zeros(3, np.int64),
    )
    serving = NvrtcBackend(launcher)
    together = rasterize_worlds(worlds, 30, 20, sky=SKY, backend=serving)
    assert launcher.launches["find_seen"] == launcher.launches["blend"] == 1
    for k, view in enumerate(views_of(worlds)):
        alone = rasterize(
            view.instances, view.viewmat[None], view.K[None], 30, 20, sky=SKY, backend=serving
        )
        assert torch.equal(together.rgb[k], alone.rgb[0])


def test_median_depth_and_class_come_from_the_median_gaussian(
    serving: NvrtcBackend,
) -> None:
    world = [
        Instance(sheet([4.0], 0.3, 9.0), None, 1, semantic=7),
        Instance(sheet([8.0], 0.8, 9.0), None, 2, semantic=9),
    ]
    [images] = serving.frames(requests_of([(45, 37)], world), ["median_depth", "semantic"])
    assert images["median_depth"][0, 19, 22] == 8.0
    assert images["semantic"][0, 19, 22] == 9


def test_classes_and_median_depths_match_other_backends(serving: NvrtcBackend) -> None:
    world = [
        Instance(cloud(0), semantic=4),
        Instance(cloud(1), transform_from([1.0, 0, 0], np.eye(4)[0]), 3, semantic=26),
    ]
    K = np.array([[40.0, 0, 24], [0, 40, 15], [0, 0, 1]])
    cameras = [Camera("front", 48, 30, K, np.eye(4))]
    given, reference, cpu = (
        render_cameras(world, cameras, np.eye(4), sky=SKY, modalities=modalities, backend=backend)[
            0
        ].images
        for backend in (serving, "reference", "cpu")
        for modalities in [("semantic", "median_depth")]
    )
    assert set(np.unique(reference["semantic"])) == {4, 23, 26}
    for images in (given, cpu):
        np.testing.assert_array_equal(images["semantic"], reference["semantic"])
        np.testing.assert_allclose(images["median_depth"], reference["median_depth"], atol=1e-4)
    assert given["semantic"].dtype == cpu["semantic"].dtype == np.uint8


def test_gradients_are_refused_with_an_alternative(serving: NvrtcBackend) -> None:
    trained = cloud(0)
    trained.means.requires_grad_()
    with pytest.raises(RenderError, match="--backend cuda"):
        draw(serving, [Instance(trained)], RasterOptions(), np.zeros(3))


@pytest.mark.parametrize(
    ("name", "exact", "low", "high"),
    [("exponential", lambda x: math.exp(-x), 0, 6), ("logarithm", math.log, 1, 260)],
)
def test_kernel_functions_have_single_precision(
    name: str, exact: Callable[[float], float], low: float, high: float
) -> None:
    values = [float(v) for v in np.linspace(low, high, 2000, dtype=np.float32)]
    function = getattr(twin(), name)
    error = max(abs(function(v) - exact(v)) / max(abs(exact(v)), 1e-3) for v in values)
    assert error < 3e-7


def test_structures_match_the_kernel_source() -> None:
    sizes = (ctypes.c_uint32 * 4)()
    twin().sizes(sizes)
    types = (launcher.OBJECT, launcher.PLACEMENT, launcher.CAMERA, launcher.FRAME)
    assert list(sizes) == [kind.itemsize for kind in types]


@pytest.mark.parametrize(
    ("tiles", "passes"), [(1, 1), (256, 1), (257, 2), (65_536, 2), (65_537, 3)]
)
def test_sort_passes_depend_on_the_number_of_tiles(tiles: int, passes: int) -> None:
    assert tile_passes(tiles) == passes
