"""Lenses and rolling shutters: CPU kernels against plain torch and closed forms."""

from dataclasses import replace

import numba
import numpy as np
import pytest
import torch

from real2sim_server.geometry import transform_from, yaw_quaternion
from real2sim_server.render import (
    Instance,
    RasterOptions,
    RenderError,
    rasterize,
    render_cameras,
    select_backend,
)
from real2sim_server.render._cpu.drawing import Drawing
from real2sim_server.render._cpu.ray_drawing import RayDrawing
from real2sim_server.render._cpu.records import EXTENT_X, EXTENT_Y
from real2sim_server.render._reference import ReferenceBackend
from real2sim_server.render.lens import LensView
from real2sim_server.scene import (
    BrownConrady,
    Camera,
    CameraMotion,
    Fisheye,
    FTheta,
    GaussianCloud,
    Omnidirectional,
    Shutter,
    Sky,
)
from real2sim_server.scene.camera import T_VEHICLE_OPTICAL

SIZE = 48, 32
WIDE = np.array([[14.0, 0, 24], [0, 14, 16], [0, 0, 1]])
K = np.array([[35.0, 0, 24], [0, 35, 16], [0, 0, 1]])
POSE = transform_from([0.3, -0.2, 1.5], yaw_quaternion(0.2)) @ T_VEHICLE_OPTICAL
EVERYTHING = RasterOptions(median_depth=True)
MOTION = CameraMotion.about(POSE, np.array([12.0, 5, 0.5]), np.array([0.1, -0.2, 0.5]), 0.03)
CAMERAS = {
    "brown": (K, BrownConrady((-0.2, 0.05, 0, 0, 0, 0), (0.002, -0.001)), Shutter()),
    "fisheye": (WIDE, Fisheye((0.02, -0.01, 0.001, 0), 1.66), Shutter()),
    "omni": (WIDE * [[1.5], [1.5], [1]], Omnidirectional(1.1, (-0.1, 0.02)), Shutter()),
    "f_theta": (WIDE, FTheta((0, 1, 0.01, -0.02), linear=(1.01, 0.01, 0)), Shutter()),
    "down": (K, None, Shutter("top_to_bottom", 30_000)),
    "up": (WIDE, Fisheye(), Shutter("bottom_to_top", 30_000)),
    "right": (K, BrownConrady((-0.2, 0.05, 0, 0, 0, 0)), Shutter("left_to_right", 30_000)),
    "left": (K, None, Shutter("right_to_left", 30_000)),
}


def camera(name):
    k, lens, shutter = CAMERAS[name]
    return Camera(name, *SIZE, k, POSE, lens, shutter)


def cloud(count, spread, sizes, *, seed):
    generator = torch.Generator().manual_seed(seed)
    low, high = sizes
    scales = low * (high / low) ** torch.rand(count, 3, generator=generator)
    return GaussianCloud(
        means=torch.randn(count, 3, generator=generator) * torch.tensor(spread),
        quats=torch.randn(count, 4, generator=generator),
        scales=scales,
        opacities=torch.rand(count, generator=generator) * 0.9 + 0.05,
        sh=torch.randn(count, 4, 3, generator=generator) * 0.4,
    )


@pytest.fixture(scope="module")
def instances():
    """Gaussians of many shapes around the camera, a moving car and a deformed object."""
    world = cloud(80, (9.0, 9.0, 2.0), (0.03, 0.9), seed=1)
    car = cloud(40, (0.8, 0.5, 0.4), (0.02, 0.2), seed=2)
    bent = cloud(20, (0.5, 0.5, 0.5), (0.1, 0.2), seed=3)
    root = torch.randn(20, 3, 3, generator=torch.Generator().manual_seed(4)) * 0.15
    return [
        Instance(world),
        Instance(
            car,
            transform_from([5.0, 0.5, 1.0], yaw_quaternion(0.6)),
            instance_id=1,
            twist=np.array([8.0, -6, 0, 0, 0, 2.0]),
        ),
        Instance(
            bent,
            transform_from([3.0, 1.5, 1.2], yaw_quaternion(0.0)),
            instance_id=2,
            covars=root @ root.mT + 1e-4 * torch.eye(3),
        ),
    ]


@pytest.fixture(scope="module")
def sky():
    return Sky(torch.rand(6, 4, 4, 3, generator=torch.Generator().manual_seed(5)))


def draw(seen_by, instances, sky=None, backend="cpu", options=EVERYTHING, motion=MOTION):
    motion = motion if seen_by.shutter.rolls else CameraMotion.still(POSE)
    optics = LensView(seen_by, motion)
    return rasterize(
        instances,
        optics.viewmat[None],
        seen_by.K[None],
        seen_by.width,
        seen_by.height,
        sky=sky,
        options=options,
        backend=backend,
        optics=optics,
    )


def difference(a, b):
    return float((a - b).abs().max())


@pytest.mark.parametrize("name", CAMERAS)
def test_cpu_kernels_match_plain_torch(name, instances, sky):
    ours = draw(camera(name), instances, sky)
    truth = draw(camera(name), instances, sky, backend="reference")
    assert difference(ours.rgb, truth.rgb) < 2 / 255
    assert float((ours.rgb - truth.rgb).abs().mean()) < 0.05 / 255
    assert difference(ours.alpha, truth.alpha) < 2 / 255
    solid = truth.alpha[0] > 0.5
    far = (ours.depth[0] - truth.depth[0]).abs()[solid] / truth.depth[0][solid]
    assert float(far.max()) < 0.02
    assert (ours.instance != truth.instance).float().mean() < 0.003
    assert ((ours.median_depth - truth.median_depth).abs() > 1e-3).float().mean() < 0.003


@pytest.mark.parametrize("name", ["right"])
def test_antialiased_images_match_plain_torch(name, instances):
    options = RasterOptions(rasterize_mode="antialiased")
    ours = draw(camera(name), instances, options=options)
    truth = draw(camera(name), instances, options=options, backend="reference")
    assert difference(ours.rgb, truth.rgb) < 2 / 255


@pytest.mark.parametrize("name", ["fisheye", "down"])
def test_images_do_not_depend_on_the_number_of_threads(name, instances, sky):
    before = numba.get_num_threads()
    several = draw(camera(name), instances, sky)
    try:
        numba.set_num_threads(1)
        one = draw(camera(name), instances, sky)
    finally:
        numba.set_num_threads(before)
    for image in ("rgb", "alpha", "depth", "instance", "median_depth"):
        assert torch.equal(getattr(several, image), getattr(one, image)), image


def test_a_lens_without_distortion_matches_the_pinhole(instances, sky):
    small = [
        replace(i, cloud=cloud(400, (6.0, 6, 2), (0.01, 0.05), seed=k), covars=None)
        for k, i in enumerate(instances)
    ]
    plain = rasterize(
        small, np.linalg.inv(POSE)[None], K[None], *SIZE, sky=sky, options=EVERYTHING, backend="cpu"
    )
    same = draw(Camera("none", *SIZE, K, POSE, BrownConrady()), small, sky)
    assert float((plain.rgb - same.rgb).abs().mean()) < 0.2 / 255
    assert float((plain.depth - same.depth).abs().median()) < 1e-3


def test_a_lens_without_distortion_has_no_larger_footprints_than_the_pinhole(
    instances, monkeypatch
):
    far = transform_from([15.0, 3.0, 1.5], [1.0, 0, 0, 0])
    things = [Instance(cloud(400, (1.5, 1.5, 0.8), (0.05, 0.3), seed=7), far)]
    looked_at = []

    def note(drawing, records, lists, starts, tiles, behind):
        used = records.values[np.unique(lists[: starts[tiles[1]]])]
        looked_at.append((used[:, EXTENT_X] * used[:, EXTENT_Y]).sum())

    for kind in (Drawing, RayDrawing):
        monkeypatch.setattr(kind, "_blend_tiles", note)
    view = np.linalg.inv(POSE)[None]
    rasterize(things, view, K[None], *SIZE, backend="cpu")
    draw(Camera("none", *SIZE, K, POSE, BrownConrady()), things, options=RasterOptions())
    pinhole, lens = looked_at
    assert lens < 1.1 * pinhole


def test_pixels_outside_the_lens_are_black_and_unlabelled(instances, sky):
    [frame] = render_cameras(
        instances,
        [replace(camera("fisheye"), T_vehicle_camera=T_VEHICLE_OPTICAL)],
        np.eye(4),
        sky=sky,
        modalities=["rgb", "depth", "semantic", "instance"],
        backend="cpu",
    )
    blind = ~camera("fisheye").unproject(np.array([[0.5, 0.5]]))[1][0]
    assert blind
    assert not frame.rgb[0, 0].any()
    assert frame.depth[0, 0] == frame.instance[0, 0] == frame.images["semantic"][0, 0] == 0
    assert frame.rgb[16, 24].any()


def test_a_wide_lens_sees_beyond_90_degrees_and_gives_ranges():
    ball = cloud(1, (0.0, 0, 0), (0.3, 0.3001), seed=0)
    ball = replace(ball, opacities=torch.tensor([0.99]))
    beside = POSE @ [3.0, 0, -0.1, 1.0]  # 92 degrees from the axis
    placed = Instance(ball, transform_from(beside[:3], [1.0, 0, 0, 0]), instance_id=7)
    seen = draw(camera("fisheye"), [placed])
    (row,), (column,) = (axis[:1] for axis in np.nonzero(seen.instance[0].numpy() == 7))
    assert column > 41
    assert abs(row - 16) < 8
    np.testing.assert_allclose(seen.depth[0, row, column], np.hypot(3.0, 0.1), rtol=1e-4)


def test_lens_gradients_match_finite_differences(instances):
    given = instances[1].cloud
    means = given.means[:3].clone().requires_grad_()
    small = GaussianCloud(
        means, given.quats[:3], given.scales[:3] * 3, given.opacities[:3], given.sh[:3]
    )
    placed = replace(instances[1], cloud=small)

    exact = ReferenceBackend(image_dtype=torch.float64)
    sharp = RasterOptions(eps2d=0.0)  # Gradients treat the blur width as constant.

    def brightness(offset):
        moved = replace(placed, cloud=replace(small, means=means.detach() + offset))
        return draw(camera("brown"), [moved], backend=exact, options=sharp).rgb.sum()

    draw(camera("brown"), [placed], backend=exact, options=sharp).rgb.sum().backward()
    step = torch.zeros(3, 3)
    step[0, 1] = 1e-3
    slope = float(brightness(step) - brightness(-step)) / 2e-3
    np.testing.assert_allclose(float(means.grad[0, 1]), slope, rtol=0.05)


def test_a_backend_without_lenses_names_an_alternative(instances):
    class Plain:
        name = "plain"

    with pytest.raises(RenderError, match=r"'plain' draws pinhole .* 'fisheye' .*use the backend"):
        draw(camera("fisheye"), instances, backend=Plain())


def test_lens_gradients_on_the_cpu_are_refused(instances):
    given = replace(
        instances[0].cloud, opacities=instances[0].cloud.opacities.clone().requires_grad_()
    )
    with pytest.raises(RenderError, match="no gradients through lenses"):
        draw(camera("fisheye"), [Instance(given)])


@pytest.mark.parametrize(
    "change", [{"K": K * 2 - np.diag([0, 0, 1])}, {"width": 95}], ids=["K", "width"]
)
def test_optics_of_another_camera_are_refused(instances, change):
    other = replace(camera("brown"), **change)
    optics = LensView(camera("brown"), CameraMotion.still(POSE))
    with pytest.raises(RenderError, match="optics require one camera"):
        rasterize(
            instances,
            optics.viewmat[None],
            other.K[None],
            other.width,
            other.height,
            backend="cpu",
            optics=optics,
        )


def test_a_rolling_shutter_leans_a_pole_by_speed_and_readout(instances):
    points = torch.zeros(200, 3)
    points[:, 2] = torch.linspace(-3, 3, 200)
    pole = GaussianCloud(
        points,
        torch.tensor([[1.0, 0, 0, 0]]).repeat(200, 1),
        torch.full((200, 3), 0.1),
        torch.full((200,), 0.95),
        torch.ones(200, 1, 3),
    )
    stands = T_VEHICLE_OPTICAL.copy()
    placed = Instance(pole, transform_from([6.0, 0, 0], [1.0, 0, 0, 0]), instance_id=1)
    rolling = Camera("roll", *SIZE, K, np.eye(4), None, Shutter("top_to_bottom", 30_000))
    motion = CameraMotion.about(stands, np.array([0.0, 15, 0]), np.zeros(3), 0.03)
    seen = draw(rolling, [placed], motion=motion).alpha[0].numpy()
    columns = np.arange(SIZE[0]) + 0.5
    middles = (seen * columns).sum(1) / seen.sum(1)
    # The camera moves left by 15 * 0.03 m from the first to the last row.
    expected = 24 + 35 * 15 * 0.03 * (np.arange(SIZE[1]) / (SIZE[1] - 1) - 0.5) / 6
    np.testing.assert_allclose(middles[4:-4], expected[4:-4], atol=0.03)
    assert select_backend("cpu").draws_lenses
