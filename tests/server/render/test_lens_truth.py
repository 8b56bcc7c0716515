"""Lenses and rolling shutters on the demo street against ray-cast ground truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from real2sim_server import demo
from real2sim_server.edit import posed_instances
from real2sim_server.render import rasterize
from real2sim_server.render.lens import LensView
from real2sim_server.scene import BrownConrady, Camera, CameraMotion, Fisheye, FTheta, Shutter
from real2sim_server.scene.camera import turned
from real2sim_server.scene.io.packed import read_packed
from real2sim_server.synthetic import SyntheticConfig, generate_log

pytestmark = pytest.mark.slow
FRAME = 20
ROLLING = Shutter("top_to_bottom", 30_000)


@pytest.fixture(scope="module")
def street():
    scene = read_packed(Path(demo.__file__).parent / "street.r2s.zip")
    log = generate_log(SyntheticConfig.from_values(scene.provenance["config"]))
    return scene, log


def drawn(scene, camera, motion, t_us):
    optics = None if camera.is_pinhole else LensView(camera, motion)
    output = rasterize(
        posed_instances(scene, t_us, {}),
        np.linalg.inv(motion.middle())[None],
        camera.K[None],
        camera.width,
        camera.height,
        sky=scene.sky,
        backend="cpu",
        optics=optics,
    )
    return output.rgb[0].clamp(0, 1).numpy() * 255


def psnr(image, truth):
    return 10 * np.log10(255**2 / ((image - truth) ** 2).mean())


def test_ray_rendering_is_as_accurate_as_the_pinhole(street):
    scene, log = street
    camera, t_us = scene.rig["front"], int(log.frame_times_us[FRAME])
    still = CameraMotion.still(camera.pose(log.ego.transform(t_us)))
    truth = log.render_through(camera, still, t_us)[0]
    by_rays = drawn(scene, replace(camera, lens=BrownConrady()), still, t_us)
    assert psnr(by_rays, truth) > psnr(drawn(scene, camera, still, t_us), truth) - 0.3


def squares_by_direction(scene, log, camera, pose, t_us):
    """Squared error integrated over solid angle, and the solid angle [sr], within 94.5 degrees of
    the front camera's axis."""
    place = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in (camera.width, camera.height))), -1)
    rays, seen = camera.unproject(place)
    across, down = (
        camera.unproject(place + half)[0] - camera.unproject(place - half)[0]
        for half in ([0.5, 0], [0, 0.5])
    )
    angle = np.linalg.norm(np.cross(across, down), axis=-1)
    axis = pose[:3, :3].T @ scene.rig["front"].pose(log.ego.transform(t_us))[:3, 2]
    angle *= seen & (rays @ axis > np.cos(np.radians(94.5)))
    still = CameraMotion.still(pose)
    ray_camera = replace(camera, lens=camera.lens or BrownConrady())
    truth = log.render_through(ray_camera, still, t_us, samples=2)[0].astype(float)
    error = ((drawn(scene, camera, still, t_us) - truth) ** 2).mean(-1)
    return np.array([(error * angle).sum(), angle.sum()])


@pytest.mark.parametrize(
    "lens",
    [Fisheye(max_angle=np.radians(95)), FTheta((0, 1, 0.01, -0.02), linear=(1.01, 0.01, 0))],
    ids=["fisheye", "f_theta"],
)
def test_wide_lenses_are_as_accurate_as_pinholes_of_equal_solid_angle(street, lens):
    # Five 90 degree pinholes cover all directions of the lens with the same number of pixels.
    scene, log = street
    focal, t_us = 60.0, int(log.frame_times_us[FRAME])
    pose = scene.rig["front"].pose(log.ego.transform(t_us))
    size = int(focal * np.radians(190))
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    wide = Camera("wide", size, size, K, np.eye(4), lens)
    sums = squares_by_direction(scene, log, wide, pose, t_us)
    edge = round(1.627 * focal)
    K = np.array([[edge / 2, 0, edge / 2], [0, edge / 2, edge / 2], [0, 0, 1]])
    flat = Camera("flat", edge, edge, K, np.eye(4))
    turns = [np.eye(3)]
    for angle in (np.pi / 2, -np.pi / 2):
        turns += [turned(np.array([angle, 0, 0])), turned(np.array([0, angle, 0]))]
    by_pinholes = np.zeros(2)
    for turn in turns:
        there = pose.copy()
        there[:3, :3] = pose[:3, :3] @ turn
        by_pinholes += squares_by_direction(scene, log, flat, there, t_us)
    np.testing.assert_allclose(sums[1], by_pinholes[1], rtol=0.01)
    assert 10 * np.log10(by_pinholes[0] / sums[0]) > -0.3


def test_rolling_shutter_is_accurate_at_15_metres_per_second(street):
    scene, log = street
    camera, t_us = scene.rig["front"], int(log.frame_times_us[FRAME])
    ego = log.ego.transform(t_us)
    pose, rolling = camera.pose(ego), replace(camera, shutter=ROLLING)
    motion = CameraMotion.about(pose, ego[:3, 0] * 15, np.zeros(3), 0.03)
    truth = log.render_through(rolling, motion, t_us, samples=1)[0]
    still = CameraMotion.still(pose)
    ignored = drawn(scene, camera, still, t_us)
    global_truth = log.render_through(camera, still, t_us, samples=1)[0]
    with_shutter = psnr(drawn(scene, rolling, motion, t_us), truth)
    assert with_shutter > psnr(ignored, global_truth) - 0.2
    assert with_shutter > psnr(ignored, truth) + 1
