"""Lenses and rolling shutters of the shipped street against ray-cast truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from real2sim_server import demo
from real2sim_server.edit import posed_instances
from real2sim_server.render import rasterize
from real2sim_server.render.lens_view import LensView
from real2sim_server.scene import BrownConrady, CameraMotion, Shutter
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


def test_rays_through_a_pinhole_lose_nothing(street):
    scene, log = street
    camera, t_us = scene.rig["front"], int(log.frame_times_us[FRAME])
    still = CameraMotion.still(camera.pose(log.ego.transform(t_us)))
    truth = log.render_through(camera, still, t_us)[0]
    by_rays = drawn(scene, replace(camera, lens=BrownConrady()), still, t_us)
    assert psnr(by_rays, truth) > psnr(drawn(scene, camera, still, t_us), truth) - 0.3


def test_a_rolling_shutter_at_15_metres_a_second_is_worth_drawing(street):
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
