from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from real2sim_server.logs import DrivingLog
from real2sim_server.reconstruct.logged_view import sky_mask, sky_of_image, still_surfaces
from real2sim_server.synthetic import CameraSpec, SyntheticConfig, SyntheticLog, generate_log

from .conftest import sweep_of

RANGE = 80.0
BLUE, WHITE, BRICK, LEAVES = (140, 170, 220), (225, 235, 250), (120, 80, 70), (30, 50, 20)


@pytest.fixture(scope="module")
def street() -> SyntheticLog:
    config = SyntheticConfig(
        seed=3, frames=3, width=320, height=214, samples=1, lidar_columns=1200, lidar_range=RANGE,
        cameras=(CameraSpec("front"),),
    )  # fmt: skip
    return generate_log(config)


def seen(street: SyntheticLog, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Front camera image, and its true depth [m], 0 in the sky."""
    camera, t_us = street.rig["front"], int(street.frame_times_us[frame])
    pose = camera.pose(street.ego.transform(t_us))
    _, depth, _ = street.render(pose, camera.K, camera.width, camera.height, t_us)
    return street.image("front", frame), depth


@pytest.mark.parametrize("frame", [0, 2])
def test_the_mask_finds_the_sky_and_excludes_facades_above_the_beams(street, frame):
    image, depth = seen(street, frame)
    mask = sky_mask(street, street.rig["front"], frame, image)
    assert (mask & (depth == 0)).sum() > 0.8 * (depth == 0).sum()
    # A pale roof beyond LiDAR range may be mistaken for sky.
    assert (mask & (depth > 0)).sum() < 0.02 * mask.sum()
    assert (mask & (depth > 0) & (depth < RANGE)).sum() < 0.004 * mask.sum()


def test_still_surfaces_exclude_sky_and_boxes(street):
    camera, image = street.rig["front"], seen(street, 0)[0]
    mask, still = (f(street, camera, 0, image) for f in (sky_mask, still_surfaces))
    assert not (mask & still).any()
    boxless = still_surfaces(replace(street, tracks=()), camera, 0, image)
    assert still.sum() < boxless.sum()
    assert (still <= boxless).all()


def test_the_mask_scales_with_the_image(street):
    camera, image = street.rig["front"], seen(street, 0)[0]
    large = np.repeat(np.repeat(image, 3, 0), 3, 1)
    wide = replace(camera, width=960, height=642, K=camera.K * [[3], [3], [1]])
    mask = sky_mask(street, wide, 0, large)
    assert mask.shape == (642, 960)
    assert mask.mean() == pytest.approx(sky_mask(street, camera, 0, image).mean(), rel=0.05)


@dataclass(frozen=True)
class WithoutLidar:
    log: DrivingLog

    def image(self, camera: str, frame: int) -> np.ndarray:
        return self.log.image(camera, frame)

    def lidar(self, frame: int) -> object:
        return sweep_of(np.zeros((0, 3)))


def test_without_lidar_the_mask_is_empty(street):
    blind = replace(street, source=WithoutLidar(street))
    assert not sky_mask(blind, street.rig["front"], 0, seen(street, 0)[0]).any()


def painted(*parts: tuple[slice, slice, tuple[int, int, int]]) -> np.ndarray:
    image = np.full((90, 120, 3), BRICK, np.uint8)
    for rows, columns, colour in parts:
        image[rows, columns] = colour
    return image


TOP, LOW, ALL = slice(0, 40), slice(40, 90), slice(None)
OPEN = np.arange(120) < 60
NOTHING = np.zeros((90, 120), np.bool_)


def test_the_sky_ends_at_a_strong_edge_and_spreads_to_other_columns():
    mask = sky_of_image(painted((TOP, ALL, BLUE)), NOTHING, OPEN)
    # The edge has the width of its filter.
    assert mask[:38].all()
    assert not mask[40:].any()


def test_the_sky_does_not_spread_across_a_vertical_edge():
    pale = tuple(c - 25 for c in BLUE)
    image = painted((TOP, ALL, BLUE), (TOP, slice(70, None), pale))
    mask = sky_of_image(image, NOTHING, OPEN)
    assert mask[:38, :68].all()
    assert not mask[:, 72:].any()


def test_sky_under_a_bridge_is_found_in_open_columns():
    bridge = (slice(20, 26), ALL, LEAVES)
    mask = sky_of_image(painted((TOP, ALL, BLUE), bridge), NOTHING, OPEN)
    assert mask[28:38, :59].all()
    assert not mask[28:, 60:].any()


def test_dark_regions_are_not_sky():
    assert not sky_of_image(painted((TOP, ALL, LEAVES)), NOTHING, OPEN).any()


def test_blocked_pixels_are_not_sky():
    blocked = NOTHING.copy()
    blocked[10:, :20] = True
    mask = sky_of_image(painted((TOP, ALL, WHITE)), blocked, OPEN)
    assert mask[:10, :20].all()
    assert not mask[10:, :20].any()
