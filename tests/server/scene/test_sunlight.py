"""Sunlight of a scene: shadows of boxes, sunlit ground, brightness of surfaces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from real2sim_server.geometry import transform_from
from real2sim_server.scene import Sunlight, Trajectory
from real2sim_server.scene.errors import SceneError
from real2sim_server.scene.io import load_scene, read_packed, save_scene, write_packed
from real2sim_server.scene.sunlight import LightMap, lasting_shadows, relight

SHADE = np.array([0.5, 0.55, 0.6])
SUN = Sunlight(np.array([-0.6, 0.0, 0.8]), SHADE)
BOX = transform_from([10.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("towards", "shade"),
    [((0, 0, 2), (0.5,) * 3), ((0, 0.8, -0.6), (0.5,) * 3), ((0, 0, 1), (0.5, 0.5, 1.0))],
)
def test_invalid_suns_are_refused(towards, shade):
    with pytest.raises(SceneError):
        Sunlight(np.array(towards), np.array(shade))


def test_bundles_and_packed_scenes_keep_the_sun(tiny_scene, tmp_path):
    scene = replace(tiny_scene, sunlight=SUN)
    save_scene(scene, tmp_path / "sunny.r2s")
    write_packed(scene, tmp_path / "sunny.r2s.zip")

    for loaded in (load_scene(tmp_path / "sunny.r2s"), read_packed(tmp_path / "sunny.r2s.zip")):
        np.testing.assert_array_equal(loaded.sunlight.towards, SUN.towards)
        np.testing.assert_array_equal(loaded.sunlight.shade, SUN.shade)


def test_a_box_shades_the_ground_away_from_the_sun():
    # The top edge, 2 m high, ends 1.5 m behind the box: cot of the sun's elevation times 2 m.
    x = np.array([7.9, 8.1, 12.0, 13.4, 13.6])
    points = np.stack([x, np.zeros(5), np.zeros(5)], axis=1)

    found = SUN.hidden_by(BOX, (4.0, 2.0, 2.0), points)

    assert found.tolist() == [False, True, True, True, False]


def ground(bright):
    """A LightMap on 40 m x 40 m of ground whose brightness depends on x, y."""
    x, y = np.meshgrid(np.arange(0, 40, 0.2), np.arange(0, 40, 0.2), indexing="ij")
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    colours = np.repeat(bright(places)[:, None], 3, axis=1).astype(np.float32)
    return LightMap(SUN, places, colours)


def test_dark_ground_is_in_the_shade_and_bright_ground_in_the_sun():
    half = ground(lambda places: np.where(places[:, 1] < 20, 0.5, 0.27))

    lit = half.lit(np.array([[20.0, 10.0], [20.0, 30.0]]))

    np.testing.assert_allclose(lit, [1, 0], atol=0.05)


def test_the_shade_of_the_ground_reaches_upwards_along_the_sun():
    half = ground(lambda places: np.where(places[:, 0] < 20, 0.5, 0.27))
    points = np.array([[18.0, 10.0, 7.0], [18.0, 10.0, 11.0]])

    # At 4 m, the ray to the sun passes the ground 3 m further along x.
    lit = half.lit_above(points, np.array([0.0, 4.0]))

    np.testing.assert_allclose(lit, [1, 0], atol=0.1)


def test_texture_is_not_shade():
    rng = np.random.default_rng(0)
    rough = ground(lambda places: 0.5 * rng.uniform(0.8, 1.2, len(places)))

    assert rough.lit(np.random.default_rng(1).uniform(1, 39, (100, 2))).min() == 1


def test_ground_without_its_shadow_is_as_bright_as_around():
    sunny = ground(lambda places: np.full(len(places), 0.5))
    places = np.full((3, 2), 20.0)
    colours = np.array([0.5 * SHADE, [0.5] * 3, [0.9] * 3])

    clear = sunny.without_shadow(colours, places)

    np.testing.assert_allclose(clear, [[0.5] * 3, [0.5] * 3, [0.9] * 3], atol=1e-6)


@pytest.mark.parametrize("dark", [0.3, 0.5, 0.7])
def test_ground_in_the_soft_edge_of_a_shadow_becomes_no_brighter_than_around(dark):
    deep = Sunlight(SUN.towards, np.array([0.25, 0.25, 0.25]))
    x, y = np.meshgrid(np.arange(0, 40, 0.2), np.arange(0, 40, 0.2), indexing="ij")
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    sunny = LightMap(deep, places, np.full((len(places), 3), 0.5, np.float32))

    clear = sunny.without_shadow(np.full((1, 3), 0.5 * 0.25**dark), np.full((1, 2), 20.0))

    assert 0.4 < clear.min() <= clear.max() <= 0.55 + 1e-6


def test_level_ground_has_light_one_in_the_sun_and_that_of_shadows_in_the_shade():
    sunny = ground(lambda places: np.full(len(places), 0.5))
    up, dark = np.array([[0.0, 0, 1]]), np.full((1, 3), 0.1)

    np.testing.assert_allclose(sunny.sun.on(up, 1.0), [[1.0] * 3], atol=1e-6)
    shade = relight(dark, sunny.sun.on(up, 0.0))
    np.testing.assert_allclose(shade, dark * SHADE, atol=1e-3)


def test_bright_colours_change_less_than_dark_ones_when_the_light_does():
    colours = np.array([[0.1] * 3, [0.5] * 3, [0.9] * 3])

    brighter, darker = relight(colours, 2.0), relight(colours, 0.5)

    assert (np.diff((brighter / colours)[:, 0]) < -0.02).all()
    assert (np.diff((darker / colours)[:, 0]) > 0.01).all()
    np.testing.assert_allclose(relight(colours, 1.0), colours, atol=1e-6)
    np.testing.assert_allclose(relight(brighter, 0.5), colours, atol=1e-6)


def test_the_side_towards_the_sun_is_brighter_only_in_the_sun():
    sunny = ground(lambda places: np.full(len(places), 0.5))
    sides = np.array([[-1.0, 0, 0], [1.0, 0, 0]])

    towards, away = sunny.sun.on(sides, 1.0)
    shaded = sunny.sun.on(sides, 0.0)

    assert (towards > 1.5 * away).all()
    np.testing.assert_allclose(shaded[0], shaded[1])


class Boxed:
    def __init__(self, speed):
        times = np.arange(0, 5_000_001, 500_000)
        positions = np.zeros((len(times), 3))
        positions[:, 0], positions[:, 2] = speed * times * 1e-6, 1.0
        self.size = (4.0, 2.0, 2.0)
        self.trajectory = Trajectory(times, positions, np.tile([1.0, 0, 0, 0], (len(times), 1)))


@pytest.mark.parametrize(("speed", "lasts"), [(0.0, True), (0.5, True), (10.0, False)])
def test_only_slow_and_parked_objects_leave_a_lasting_shadow(speed, lasts):
    place = np.array([[2.5, 0.0, 0.0]])

    assert lasting_shadows([Boxed(speed)], place, SUN).tolist() == [lasts]
