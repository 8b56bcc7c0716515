"""Shadows and shading of edited objects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_proto.operations import Rotate, Translate
from real2sim_server.edit import ScenarioState, apply_operations, instances_at
from real2sim_server.edit.light import cast_shadow, shaded
from real2sim_server.geometry import transform_from, yaw_quaternion
from real2sim_server.scene import GaussianCloud, Ground, Scene, SceneObject, Sunlight, Trajectory
from real2sim_server.scene.cloud import SH_C0, TimeColour
from real2sim_server.scene.sunlight import LightMap

SIZE = (4.0, 2.0, 2.0)
SUN = Sunlight(np.array([-0.6, 0.0, 0.8]), np.array([0.5, 0.5, 0.5]))
ONE = (1.0, 1.0, 1.0)


def block() -> GaussianCloud:
    """Grey Gaussians on the faces of a box of SIZE."""
    half = torch.tensor(SIZE) / 2
    faces = []
    for axis in range(3):
        others = [a for a in range(3) if a != axis]
        grid = torch.cartesian_prod(*(torch.arange(-1.0, 1.01, 0.1) for _ in others))
        for sign in (-1.0, 1.0):
            face = torch.full((len(grid), 3), sign)
            face[:, others] = grid
            faces.append(face * half)
    return painted(torch.cat(faces), 0.4)


def painted(means: torch.Tensor, grey: float | torch.Tensor) -> GaussianCloud:
    colours = torch.as_tensor(grey).expand(len(means))[:, None].repeat(1, 3)
    return GaussianCloud(
        means=means,
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(means), 1),
        scales=torch.full((len(means), 3), 0.05),
        opacities=torch.full((len(means),), 0.9),
        sh=((colours - 0.5) / SH_C0)[:, None],
    )


def darkness(shadow, x: float, y: float) -> float:
    """Share of the light that a shadow takes at a place, seen from above."""
    level = shadow.T_world_object
    means = shadow.cloud.means.double().numpy() @ level[:3, :3].T + level[:3, 3]
    squares = ((means[:, :2] - [x, y]) ** 2).sum(axis=1)
    spread = float(shadow.cloud.scales[0, 0])
    hidden = shadow.cloud.opacities.double().numpy() * np.exp(-0.5 * squares / spread**2)
    return float(1 - np.prod(1 - hidden))


def sunny(lit: float = 1.0) -> LightMap:
    """Ground that is sunlit for y < 20 m, or in the shade there."""
    x, y = np.meshgrid(np.arange(-20, 20, 0.2), np.arange(-20, 40, 0.2), indexing="ij")
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    bright = np.where((places[:, 1] < 20) == (lit > 0), 0.5, 0.25)
    return LightMap(SUN, places, np.repeat(bright[:, None], 3, axis=1).astype(np.float32))


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_shadows_fall_away_from_the_sun_however_an_object_is_turned(yaw):
    pose = transform_from([0.0, 0.0, 1.0], yaw_quaternion(yaw))
    shadow = cast_shadow(pose, block(), ONE, SIZE, Ground.level(0.0), light_map=sunny())

    # The edge of the top, 2 m high, lands 1.5 m further along x.
    edge = min(2 / np.cos(yaw), 1 / np.sin(yaw) if yaw else np.inf)
    assert darkness(shadow, edge + 1.2, 0) == pytest.approx(0.5, abs=0.05)
    assert darkness(shadow, edge + 2.0, 0) < 0.02
    assert darkness(shadow, -edge - 0.8, 0) < 0.02


def test_shadows_of_flying_objects_are_away_from_them():
    pose = transform_from([0.0, 0.0, 5.0], [1.0, 0.0, 0.0, 0.0])
    shadow = cast_shadow(pose, block(), ONE, SIZE, Ground.level(0.0), light_map=sunny())

    assert darkness(shadow, 3.0 + 0.75, 0) == pytest.approx(0.5, abs=0.05)
    assert darkness(shadow, 0.0, 0) < 0.02


def test_objects_in_the_shade_cast_only_a_contact_shadow():
    pose = transform_from([0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0])
    ground = Ground.level(0.0)
    shade = cast_shadow(pose, block(), ONE, SIZE, ground, light_map=sunny(lit=0.0))
    overcast = cast_shadow(pose, block(), ONE, SIZE, ground)

    for x in (0.0, 2.2, 3.2):
        assert darkness(shade, x, 0) == pytest.approx(darkness(overcast, x, 0), abs=0.01)
    assert darkness(overcast, 0, 0) == pytest.approx(0.5, abs=0.05)
    assert darkness(overcast, 3.2, 0) < 0.02


def test_shadows_lie_on_kerbs():
    heights = np.zeros((40, 40), np.float32)
    heights[:, 21:] = 0.12
    ground = Ground(np.array([-10.0, -10.0]), 0.5, heights, np.ones((40, 40), np.bool_))
    pose = transform_from([0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0])
    shadow = cast_shadow(pose, block(), ONE, SIZE, ground, light_map=sunny())

    places = shadow.cloud.means.double().numpy()
    above = places[:, 2] - ground.height_at(places[:, :2])
    np.testing.assert_allclose(above, 0.03, atol=1e-6)


@pytest.fixture(scope="module")
def street(tiny_scene) -> Scene:
    """A parked block at the origin whose recorded shadow is in the ground."""
    x, y = (torch.arange(-8.0, 8.0, 0.1), torch.arange(-6.0, 6.0, 0.1))
    plane = torch.cartesian_prod(x, y)
    means = torch.cat([plane, torch.zeros(len(plane), 1)], dim=1)
    pose = transform_from([0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0])
    dark = SUN.hidden_by(pose, SIZE, means.double().numpy())
    times = np.array([0, 1_000_000])
    ego = Trajectory(times, np.array([[-6.0, 0, 0], [6.0, 0, 0]]), np.tile([1.0, 0, 0, 0], (2, 1)))
    stands = Trajectory(times, np.tile([0.0, 0, 1.0], (2, 1)), np.tile([1.0, 0, 0, 0], (2, 1)))
    car = SceneObject("car", "car", SIZE, block(), stands)
    return Scene(
        name="street",
        background=painted(means, torch.where(torch.from_numpy(dark), 0.25, 0.5).float()),
        objects={"car": car},
        sky=None,
        rig=tiny_scene.rig,
        ego=ego,
        frame_times_us=times,
        stored_ground=Ground.level(0.0),
        sunlight=SUN,
    )


def colours(cloud: GaussianCloud) -> np.ndarray:
    return (cloud.sh[:, 0, 0] * SH_C0 + 0.5).numpy()


def edited(scene: Scene, operation):
    state = apply_operations(ScenarioState.of(scene), [operation]).state
    return instances_at(scene, state, 0)


def test_a_moved_object_leaves_no_shadow_behind(street):
    background, _, shadow = edited(street, Translate(object_id="car", y=-4.5))

    np.testing.assert_allclose(colours(background.cloud), 0.5, atol=0.02)
    assert darkness(shadow, 3.2, -4.5) == pytest.approx(0.5, abs=0.05)


def test_a_turned_object_gets_the_light_of_its_new_direction(street):
    _, car, _ = edited(street, Rotate(object_id="car", angle=np.pi))
    before, after = colours(street.objects["car"].cloud), colours(car.cloud)
    middle = street.objects["car"].cloud.means[:, 1:].abs().amax(dim=1).numpy() < 0.7
    x = street.objects["car"].cloud.means[:, 0].numpy()

    # The tail was in the sun, and the nose is now.
    assert (after < 0.9 * before)[middle & (x < -1.9)].all()
    assert (after > 1.1 * before)[middle & (x > 1.9)].all()


def test_an_object_at_the_edge_of_the_shade_is_half_dark(street):
    car = street.objects["car"]
    across = transform_from([0.0, 20.0, 1.0], yaw_quaternion(np.pi / 2))
    cloud, _ = shaded(car, across, 0, sunny())
    before, after = colours(car.cloud), colours(cloud)
    x, y, z = car.cloud.means.numpy().T
    roof = (z > 0.99) & (np.abs(y) < 0.7)

    np.testing.assert_allclose(after[roof & (x > -1.7) & (x < -1.2)], before[0], atol=0.02)
    np.testing.assert_allclose(after[roof & (x > 1.2) & (x < 1.7)], before[0] / 2, atol=0.02)


def test_a_brief_shade_that_the_colours_do_not_follow_changes_nothing(street):
    x, y = np.meshgrid(np.arange(-20, 20, 0.2), np.arange(-20, 40, 0.2), indexing="ij")
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    bright = np.where(np.abs(places[:, 1] - 20) < 2, 0.25, 0.5).astype(np.float32)
    striped = LightMap(SUN, places, np.repeat(bright[:, None], 3, axis=1))
    times = np.array([0, 50_000_000])
    heading = np.tile(yaw_quaternion(np.pi / 2), (2, 1))
    path = Trajectory(times, np.array([[0.0, -15, 1], [0.0, 35, 1]]), heading)
    cloud = street.objects["car"].cloud
    slow = TimeColour(torch.full((len(cloud), 2, 3), 0.01), "cosine", *times.tolist())
    car = replace(street.objects["car"], trajectory=path, colour=slow)

    elsewhere, _ = shaded(car, path.transform(10_000_000), 35_000_000, striped)

    np.testing.assert_allclose(colours(elsewhere), colours(cloud), rtol=0.12)


def test_the_shading_of_an_object_that_waits_does_not_depend_on_earlier_calls(street):
    times = np.arange(0, 50_000_000, 10_000_000)
    positions = np.zeros((len(times), 3))
    positions[:, 1], positions[:, 2] = [0, 18, 18, 18, 36], 1
    path = Trajectory(times, positions, np.tile([1.0, 0, 0, 0], (len(times), 1)))
    colour = TimeColour(torch.full((len(block()), 2, 3), 0.01), "cosine", 0, int(times[-1]))
    turned, light_map = transform_from([0.0, 18, 1], yaw_quaternion(np.pi)), sunny()

    def shade(cloud: GaussianCloud, *moments: int) -> np.ndarray:
        car = replace(street.objects["car"], cloud=cloud, trajectory=path, colour=colour)
        return [colours(shaded(car, turned, t_us, light_map)[0]) for t_us in moments][-1]

    late = shade(block(), 29_000_000)

    np.testing.assert_array_equal(shade(block(), 11_000_000, 29_000_000), late)
    assert np.abs(shade(block(), 11_000_000) - late).max() > 0.01


def test_colours_of_an_edited_parked_object_do_not_change_over_time(street):
    car = street.objects["car"]
    coefficients = torch.full((len(car.cloud), 2, 3), 0.1)
    flickering = replace(car, colour=TimeColour(coefficients, "cosine", 0, 1_000_000))

    _, colour = shaded(flickering, transform_from([5.0, 0, 1], yaw_quaternion(1.0)), 0, sunny())

    assert colour is None


def test_scenes_with_the_same_object_shade_it_each_in_its_own_light(street):
    car = street.objects["car"]
    turned = transform_from([0.0, 0.0, 1.0], yaw_quaternion(np.pi))
    in_sun, in_shade = (colours(shaded(car, turned, 0, sunny(lit))[0]) for lit in (1.0, 0.0))

    assert np.abs(in_sun - in_shade).max() > 0.05


def test_unedited_objects_and_scenes_without_sun_keep_their_colours(street):
    state = ScenarioState.of(street)
    assert instances_at(street, state, 0)[1].cloud is street.objects["car"].cloud

    overcast = replace(street, sunlight=None)
    car = edited(overcast, Rotate(object_id="car", angle=np.pi))[1]
    assert car.cloud is overcast.objects["car"].cloud
