"""Paint and lighting of vehicles, inferred from observed sides and from other vehicles."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from real2sim_server.reconstruct.initialise.surfels import GREY
from real2sim_server.reconstruct.initialise.vehicle_body import (
    VehicleSurface,
    fill_vehicles,
    fitted_body,
)
from real2sim_server.reconstruct.initialise.vehicle_parts import (
    FROM_ABOVE,
    PARTS,
    Part,
    default_palette,
    fit_light,
    light_on,
    palette_of,
    slope_light,
    with_paints,
)
from real2sim_server.reconstruct.initialise.vehicle_parts import LIGHT as LIGHT_KEY
from real2sim_server.scene import GaussianCloud, SceneObject, Trajectory
from real2sim_server.scene.sunlight import DISPLAY, relight

SALOON = (4.7, 1.82, 1.46)
GREEN = np.array([0.1, 0.4, 0.2], np.float32)
LIGHT = np.array([-0.3, 0.2, 0.35])


@pytest.fixture(scope="module")
def body():
    found = fitted_body(np.zeros((0, 3), np.float32), SALOON, "car")
    assert found is not None
    return found


def surface(body, paint, *, light, seen_from=(-1, 0, 0), turned=0.0) -> VehicleSurface:
    """A car of one paint, rotated by ``turned`` [rad] and observed from one side."""
    c, s = np.cos(turned), np.sin(turned)
    normals = body.unit_normals() @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
    colours = relight(np.tile(paint, (len(normals), 1)), slope_light(light, normals))
    seen = body.unit_normals() @ np.array(seen_from, float) > 0.4
    return VehicleSurface(body.points.astype(np.float32), normals, colours, seen, body)


def doors(body) -> np.ndarray:
    return body.is_paint & (np.abs(body.points[:, 0]) < 1) & (np.abs(body.points[:, 2]) < 0.2)


def test_light_is_fitted_from_vehicles_of_different_paint_and_heading(body):
    cars = [
        surface(body, paint, light=LIGHT, turned=turned, seen_from=side)
        for paint, turned, side in (
            (GREEN, 0.3, (-1, 0, 1)),
            (GREEN[::-1], 2.0, (0, 1, 1)),
            (np.full(3, 0.5, np.float32), 4.0, (0, -1, 1)),
        )
        for _ in range(4)
    ]
    painted = [c.seen_paint() for c in cars]
    found = fit_light(
        [c.normals[p] for c, p in zip(cars, painted, strict=True)],
        [c.colours[p] for c, p in zip(cars, painted, strict=True)],
    )
    # The prior (light from above) biases the fit.
    np.testing.assert_allclose(found, LIGHT, atol=0.06)


def test_without_vehicles_light_comes_from_above():
    np.testing.assert_array_equal(fit_light([], []), FROM_ABOVE)


def test_an_unobserved_flank_has_the_uniform_colour_of_the_tail(body):
    dark = np.zeros(3)
    [filled], _, _ = fill_vehicles([surface(body, GREEN, light=dark)])
    flank = filled[doors(body)]
    assert np.ptp(flank, axis=0).max() < 0.05
    np.testing.assert_allclose(flank.mean(0) / flank.mean(), GREEN / GREEN.mean(), atol=0.1)


def test_a_mirrored_flank_is_relit_for_its_side(body):
    towards = np.array([0.0, 0.8, 0.0])
    left = surface(body, GREEN, light=towards, seen_from=(0, 1, 0))
    cars = [left, *(surface(body, GREEN, light=towards, seen_from=(0, s, 0)) for s in (-1, 1) * 4)]
    filled, light, _ = fill_vehicles(cars)
    assert light[1] > 0.5
    near, far = (doors(body) & (side * body.points[:, 1] > 0) for side in (1, -1))
    bright = filled[0][far].mean() / filled[0][near].mean()
    assert bright < np.exp(-2 * 0.8 * 0.5)


def test_an_unobserved_vehicle_is_grey_with_average_brightness(body):
    dark = np.zeros(3)
    hidden = surface(body, GREEN, light=dark)
    hidden = VehicleSurface(
        hidden.points,
        hidden.normals,
        np.zeros_like(hidden.colours),
        np.zeros_like(hidden.seen),
        body,
    )
    filled, light, _ = fill_vehicles([surface(body, GREEN, light=dark), hidden])
    flank = doors(body)
    np.testing.assert_allclose(filled[1][flank].mean(1), filled[0][flank].mean(1), atol=0.04)
    assert np.ptp(filled[1][flank], axis=1).max() < 1e-6
    assert np.isfinite(light).all()


def test_glass_colour_is_learnt_from_the_log(body):
    dark, black = np.zeros(3), np.full(3, 0.04, np.float32)

    def glazed(seen: bool) -> VehicleSurface:
        car = surface(body, GREEN, light=dark)
        colours = np.where((body.parts == Part.GLASS)[:, None], black, car.colours)
        return VehicleSurface(
            car.points, car.normals, colours, car.seen if seen else car.seen & False, body
        )

    filled, _, palette = fill_vehicles([glazed(True)] * 8 + [glazed(False)])
    usual = default_palette()
    assert palette[Part.GLASS].max() < 0.1 < usual[Part.GLASS].min()
    # A vehicle with unobserved glass gets the glass of the others. Lamp colours are not learnt.
    glass = filled[-1][body.parts == Part.GLASS]
    np.testing.assert_allclose(glass.mean(0), palette[Part.GLASS], rtol=0.3)
    np.testing.assert_allclose(palette[Part.RED_LAMP], usual[Part.RED_LAMP], atol=0.01)


def test_a_scene_without_part_colours_uses_the_defaults(tiny_scene):
    np.testing.assert_array_equal(palette_of(tiny_scene), default_palette())
    kept = default_palette() * 0.5
    known = replace(tiny_scene, provenance={"reconstruction": {PARTS: kept.tolist()}})
    np.testing.assert_allclose(palette_of(known), kept)


def test_light_is_rotated_to_the_vehicle_frame_or_comes_from_above(tiny_scene):
    times = np.array([0, 1_000_000])
    pose = np.array([[0.0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    path = Trajectory.from_transforms(times, np.stack([pose, pose]))
    cloud = GaussianCloud(
        torch.zeros(1, 3),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.ones(1, 3),
        torch.ones(1),
        torch.zeros(1, 1, 3),
    )
    car = SceneObject("car", "car", SALOON, cloud, path)
    normals = np.eye(3)
    fitted = replace(tiny_scene, provenance={"reconstruction": {LIGHT_KEY: [0.0, 0.3, 0.2]}})
    np.testing.assert_allclose(
        light_on(car, fitted)(normals)[:, 0], np.exp(DISPLAY * np.array([0.3, 0, 0.2])), rtol=1e-5
    )
    np.testing.assert_allclose(
        light_on(car, tiny_scene)(normals)[:, 0], np.exp(DISPLAY * np.array(FROM_ABOVE)), rtol=1e-5
    )


def test_glass_is_darker_than_the_paint_of_dark_cars():
    paint = np.array([0.2, 0.15, 0.1], np.float32)
    dark = with_paints(default_palette(), {Part.PAINT: paint}, GREY)
    white = with_paints(default_palette(), {Part.PAINT: np.ones(3, np.float32)}, GREY)

    assert dark[Part.GLASS].mean() == pytest.approx(0.8 * 0.15)
    np.testing.assert_array_equal(white[Part.GLASS], default_palette()[Part.GLASS])


@pytest.mark.parametrize("level", [0.25, 1.0])
def test_unseen_lamps_have_their_usual_colour_in_the_light_of_any_log(body, level):
    car = surface(body, GREEN, light=np.zeros(3))
    even = partial(np.full, fill_value=level, dtype=np.float32)

    [filled], _, _ = fill_vehicles([car], [lambda normals: even((len(normals), 1))])

    lamps = filled[(body.parts == Part.WHITE_LAMP) & ~car.seen]
    np.testing.assert_allclose(lamps, 0.65, atol=0.01)
