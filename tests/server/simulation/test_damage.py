"""What crashes leave on vehicles: folds, broken parts, fragments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_server.edit.state import ScenarioState
from real2sim_server.geometry import quaternion_to_matrix
from real2sim_server.physics.body import box_particles
from real2sim_server.scene import GaussianCloud
from real2sim_server.simulation.breakage import (
    BreakageLog,
    fragment_cloud,
    in_wheels,
    parts_of,
    with_underside,
)
from real2sim_server.simulation.damage import (
    BRIGHTEST,
    CLEARANCE,
    FLATTER,
    HANGS_STILL,
    HEIGHTS,
    SH_0,
    DamagedVehicle,
    crumple,
)
from real2sim_server.simulation.particles import Embedding, deform_cloud
from real2sim_server.simulation.result import ObjectResult, Playback, SimulationResult
from real2sim_server.simulation.rollout import find_breakages

SIZE = (4.6, 1.8, 1.5)
SPACING = 0.15
PARTICLES = box_particles(SIZE, spacing=SPACING, density=1.0).positions
CRUSHED = 0.3
"""Of the front, in the tests."""


def skin(count: int = 40) -> GaussianCloud:
    """Gaussians on the left side and on top of a box of SIZE."""
    x = np.linspace(-2.2, 2.2, count)
    side = np.stack([x, np.full(count, 0.9), np.full(count, -0.1)], axis=1)
    top = np.stack([x, np.zeros(count), np.full(count, 0.75)], axis=1)
    means = torch.from_numpy(np.concatenate([side, top]).astype(np.float32))
    n = len(means)
    return GaussianCloud(
        means,
        torch.tensor((1.0, 0, 0, 0)).repeat(n, 1),
        torch.full((n, 3), 0.05),
        torch.full((n,), 0.9),
        torch.full((n, 1, 3), 0.7),
    )


def crushed_front(by: float = CRUSHED) -> np.ndarray:
    """[N, 3] displacements that shorten the front third by a fraction."""
    moved = np.zeros_like(PARTICLES)
    begins = SIZE[0] / 2 - SIZE[0] / 3
    moved[:, 0] = -by * np.maximum(PARTICLES[:, 0] - begins, 0.0)
    return moved


@pytest.fixture(scope="module")
def vehicle():
    cloud = skin()
    made = DamagedVehicle(
        cloud, PARTICLES, spacing=SPACING, category="car", size=SIZE, object_id="car_1"
    )
    return cloud, made


def drawn(vehicle, displacements, broken=None):
    cloud, made = vehicle
    return cloud, made.cloud(displacements, made.shortening(displacements), broken or {})


def smooth(displacements):
    """The same without folds."""
    cloud = skin()
    points = cloud.means.numpy().astype(np.float64)
    return deform_cloud(cloud, Embedding(PARTICLES, points, spacing=SPACING).follow(displacements))


def length(cloud: GaussianCloud, first: int, last: int) -> float:
    steps = np.diff(cloud.means.numpy()[first:last].astype(np.float64), axis=0)
    return float(np.linalg.norm(steps, axis=1).sum())


def test_shortened_sheet_metal_folds_and_keeps_most_of_its_length(vehicle):
    rest, folded = drawn(vehicle, crushed_front())
    first, last = 29, 40
    shortened = length(smooth(crushed_front()), first, last) / length(rest, first, last)
    assert shortened == pytest.approx(1 - CRUSHED, abs=0.06)
    assert length(folded, first, last) / length(rest, first, last) > shortened + 0.1


def test_folds_change_orientation_and_shading(vehicle):
    rest, folded = drawn(vehicle, crushed_front())
    light = folded.sh[29:40, 0, 0] / rest.sh[29:40, 0, 0]
    assert float(light.max() - light.min()) > 0.15


def dented_side(depth: float = 0.2) -> np.ndarray:
    """[N, 3] displacements of a trough in the left side, as a bumper leaves."""
    moved = np.zeros_like(PARTICLES)
    left = PARTICLES[:, 1] > 0.3
    moved[left, 1] = -depth * np.exp(-((PARTICLES[left, 0] / 0.7) ** 2))
    return moved


def lights(rest, drawn):
    """[40] brightness of the side's Gaussians relative to before."""
    colour = [0.5 + SH_0 * cloud.sh[:40, 0].mean(dim=1) for cloud in (drawn, rest)]
    return (colour[0] / colour[1]).numpy()


def test_a_side_dent_shows_in_the_shading(vehicle):
    rest, dented = drawn(vehicle, dented_side())
    pressed = slice(13, 27)
    light = lights(rest, dented)[pressed]
    assert light.max() - light.min() > 0.3
    assert light.min() < 0.85


def test_paint_is_scraped_only_where_metal_was_pushed_in():
    x, z = (a.ravel() for a in np.meshgrid(np.linspace(-2.2, 2.2, 89), np.linspace(-0.4, 0.3, 15)))
    side = np.stack([x, np.full(len(x), 0.9), z], axis=1).astype(np.float32)
    red = skin(len(x)).select(torch.arange(len(x)))
    sh = red.sh * torch.tensor([1.0, -2.0, -2.0])
    red = replace(red, means=torch.from_numpy(side), sh=sh)
    made = DamagedVehicle(
        red, PARTICLES, spacing=SPACING, category="car", size=SIZE, object_id="car_1"
    )
    moved = dented_side()
    shown = 0.5 + SH_0 * made.cloud(moved, made.shortening(moved), {}).sh[:, 0].numpy()
    painted = 0.5 + SH_0 * sh[0, 0].numpy()
    scraped = shown[:, 1] / shown[:, 0] - painted[1] / painted[0]
    assert 0.1 < (scraped[np.abs(x) < 0.5] > 0.05).mean() < 0.7
    assert np.abs(scraped[np.abs(x) > 1.8]).max() < 1e-4


@pytest.mark.parametrize("depth", [0.1, 0.2, 0.4])
def test_dent_shading_and_height_are_bounded(vehicle, depth):
    rest, dented = drawn(vehicle, dented_side(depth))
    light = lights(rest, dented)
    assert light.min() >= 0.3
    assert light.max() <= BRIGHTEST + 1e-6
    bare = (0.5 + SH_0 * dented.sh[:, 0]).min()
    assert 0.0 < float(bare) < 1.0
    apart = (dented.means - smooth(dented_side(depth)).means)[:40].norm(dim=1)
    assert float(apart.max()) < FLATTER * sum(HEIGHTS) + 0.1


@pytest.mark.parametrize("moved", ["towards", "aside", "turned"])
def test_rigid_motion_does_not_change_the_shading(vehicle, moved):
    """For bodies whose particles moved along with what pushed them, without any dent."""
    cloud, made = vehicle
    turn = np.eye(3)
    if moved == "turned":
        turn[:2, :2] = [[np.cos(0.02), -np.sin(0.02)], [np.sin(0.02), np.cos(0.02)]]
    shift = {"towards": (0.0, -0.02, 0.0), "aside": (0.3, 0.0, 0.0)}.get(moved, (0.0, 0.0, 0.0))
    displaced = PARTICLES @ turn.T + shift - PARTICLES
    went = made.cloud(displaced, made.shortening(displaced), {})
    np.testing.assert_array_equal(went.sh.numpy()[:40], cloud.sh.numpy()[:40])


def test_uncrushed_parts_are_unchanged(vehicle):
    rest, folded = drawn(vehicle, crushed_front())
    behind = slice(0, 20)
    for name in ("means", "quats", "scales", "sh"):
        assert torch.equal(getattr(folded, name)[behind], getattr(rest, name)[behind])


def test_folds_remain_after_springback(vehicle):
    cloud, made = vehicle
    most = made.shortening(crushed_front())
    back = made.cloud(np.zeros_like(PARTICLES), most, {})
    assert float((back.means - cloud.means)[29:40].abs().max()) > 0.01


def test_crumpled_metal_is_flat_between_ridges_and_never_torn():
    t = np.linspace(0.0, 1.0, 20_001)
    line = np.stack([t, 0.3 * t, 0.9 + 0.1 * t], axis=1)
    height, slope = crumple(line, seed=7)
    along = slope @ (line[1] - line[0])
    steps = np.diff(height)
    assert np.abs(steps).max() < 1e-4
    kinks = np.abs(np.diff(steps)) > 1e-9
    assert 8 < kinks.sum() < 200
    flat = ~kinks
    np.testing.assert_allclose(steps[1:][flat], along[1:-1][flat], atol=1e-9)


def test_inward_leaning_side_windows_go_dark_up_to_the_roof():
    glass = torch.full((3, 1, 3), -1.0)
    row = np.array([[0.0, 0.85, 0.3], [0.0, 0.55, 0.5], [0.0, 0.2, 0.5]], dtype=np.float32)
    cloud = replace(skin(2).select(torch.arange(3)), means=torch.from_numpy(row), sh=glass)
    cloud = GaussianCloud.concatenate([skin(), cloud])
    made = DamagedVehicle(
        cloud, PARTICLES, spacing=SPACING, category="car", size=SIZE, object_id="car_1"
    )
    still = np.zeros_like(PARTICLES)
    dark = made.cloud(still, made.shortening(still), {"left windows": 1.0}).sh != cloud.sh
    assert dark[-3:].all(dim=(1, 2)).tolist() == [True, True, False]
    assert not dark[:-3].any()


def test_the_bonnet_buckles_up_in_the_middle(vehicle):
    x = np.linspace(1.5, 2.25, 16)
    row = np.stack([x, np.zeros(16), np.full(16, 0.3)], axis=1).astype(np.float32)
    bonnet = replace(skin(8), means=torch.from_numpy(row))
    low = PARTICLES[PARTICLES[:, 2] < 0.3]
    made = DamagedVehicle(
        bonnet, low, spacing=SPACING, category="car", size=SIZE, object_id="car_1"
    )
    moved = crushed_front()[PARTICLES[:, 2] < 0.3]
    rise = (made.cloud(moved, made.shortening(moved), {}).means - bonnet.means)[:, 2].numpy()
    assert 0.1 < rise[5:11].max() < 0.45
    assert rise[5:11].max() > max(rise[0], rise[-1]) + 0.05


def test_no_gaussian_becomes_needle_shaped(vehicle):
    pulled = np.zeros_like(PARTICLES)
    pulled[:, 0] = 6.0 * np.maximum(PARTICLES[:, 0] - 1.5, 0.0)
    rest, torn = drawn(vehicle, pulled)
    assert len(torn) > len(rest)
    assert float(torn.scales.max()) < 1.45 * float(rest.scales.max())
    assert float(smooth(pulled).scales.max()) > 1.9 * float(rest.scales.max())


def test_damage_is_reproducible(vehicle):
    one, two = (drawn(vehicle, crushed_front(), {"front bumper": 0.2})[1] for _ in range(2))
    for name in ("means", "quats", "scales", "sh"):
        assert torch.equal(getattr(one, name), getattr(two, name))


def test_a_loose_bumper_sags_and_comes_to_rest_above_the_road():
    y = np.linspace(-0.88, 0.88, 30)
    row = np.stack([np.full(30, 2.25), y, np.full(30, -0.55)], axis=1).astype(np.float32)
    cloud = replace(skin(15), means=torch.from_numpy(row))
    made = DamagedVehicle(
        cloud, PARTICLES, spacing=SPACING, category="car", size=SIZE, object_id="car_1"
    )
    still = np.zeros_like(PARTICLES)

    def height(age):
        means = made.cloud(still, made.shortening(still), {"front bumper": age}).means
        return means[:, 2] + SIZE[2] / 2

    assert float((height(0.1) - height(0.3)).max()) > 0.02
    assert torch.equal(height(HANGS_STILL), height(2 * HANGS_STILL))
    assert float(height(HANGS_STILL).min()) == pytest.approx(CLEARANCE, abs=1e-5)


def test_a_crushed_front_breaks_the_parts_there():
    log = BreakageLog("car", SIZE, PARTICLES, spacing=SPACING)
    assert log.follow(np.zeros_like(PARTICLES)) == []
    broken = {part.name for part in log.follow(crushed_front())}
    assert broken >= {"front bumper", "front left lamp", "front right lamp"}
    assert not any(name.startswith("rear") for name in broken)
    assert log.follow(crushed_front()) == []


def test_a_sheared_side_breaks_its_windows():
    moved = np.zeros_like(PARTICLES)
    left = PARTICLES[:, 1] > 0.4
    moved[left, 1] = -0.3 * np.exp(-((PARTICLES[left, 0] / 0.6) ** 2))
    log = BreakageLog("car", SIZE, PARTICLES, spacing=SPACING)
    broken = {part.name for part in log.follow(moved)}
    assert "left windows" in broken
    assert broken.isdisjoint({"right windows", "rear window", "front left lamp", "front bumper"})


def test_only_vehicles_have_parts():
    assert parts_of("pole", (0.3, 0.3, 3.0)) == ()
    names = [part.name for part in parts_of("van", (5.3, 2.0, 2.2))]
    assert len(set(names)) == len(names)


def crash_result(object_id: str, pose, breakages) -> SimulationResult:
    """Four frames; the front of an object is pushed in at the second."""
    shapes = np.array([crushed_front()], dtype=np.float16)
    own = ObjectResult(
        object_id,
        1500.0,
        SPACING,
        PARTICLES.astype(np.float32),
        np.tile(pose, (4, 1)),
        np.tile((1.0, 0, 0, 0), (4, 1)),
        np.zeros((4, 3)),
        np.zeros((4, 3)),
        np.full(4, 2, np.uint8),
        np.array([-1, 0, 0, 0], np.int32),
        shapes,
        np.zeros((0, 3), np.float32),
        np.zeros((4, 0), np.float32),
    )
    return SimulationResult(
        {object_id: own},
        np.arange(4) * 2.0,
        0,
        np.zeros((4, 6)),
        (),
        np.zeros((4, 0, 3)),
        figures={"preset": "vehicle"},
        breakages=breakages,
    )


@pytest.fixture(scope="module")
def crash(tiny_scene):
    state = ScenarioState.of(tiny_scene)
    result = crash_result("car_red", (14.0, -3.0, 0.75), None)
    return state, replace(result, breakages=find_breakages(result, state.visible))


def test_parts_break_in_the_frame_that_crushes_them(crash):
    _, result = crash
    assert {b.time_s for b in result.breakages} == {2.0}
    lamp = next(b for b in result.breakages if b.part == "front left lamp")
    assert lamp.position[0] > 14.0 + 1.0
    assert lamp.position[1] > -3.0


def test_breakages_are_saved_with_the_result(crash, tmp_path):
    _, result = crash
    result.save(tmp_path / "kept")
    assert SimulationResult.load(tmp_path / "kept").breakages == result.breakages


def test_older_results_have_no_breakages_and_are_drawn_unchanged(crash, tiny_scene, tmp_path):
    state, result = crash
    replace(result, breakages=None).save(tmp_path / "old")
    old = SimulationResult.load(tmp_path / "old")
    assert old.breakages is None
    drawn = Playback(tiny_scene, state, old).instances(3)
    [_, red] = drawn
    source = tiny_scene.object("car_red").cloud_at(0)
    assert torch.equal(red.cloud.sh, source.sh)
    assert len(red.cloud) == len(source)


def test_fragments_appear_after_breakage_and_lie_on_the_road(crash, tiny_scene):
    state, result = crash
    playback = Playback(tiny_scene, state, result)
    before = len(playback.instances(0))
    assert len(playback.instances(1)) == before + 1
    last = playback.instances(3)[-1]
    assert last.instance_id == next(
        o.instance_id for o in state.visible if o.object_id == "car_red"
    )
    ground = tiny_scene.ground.height_at(last.cloud.means.numpy()[:, :2])
    above = last.cloud.means.numpy()[:, 2] - ground
    assert 0.0 < above.max() < 0.05
    assert above.min() > 0.0


def test_fragments_fly_then_land_and_stay(crash):
    _, result = crash
    flat = lambda places: np.zeros(len(places))  # noqa: E731
    flying, lying, later = (
        fragment_cloud(result.breakages, t, flat).means.numpy() for t in (2.1, 10.0, 11.0)
    )
    assert flying[:, 2].max() > 0.3
    np.testing.assert_array_equal(lying, later)
    assert fragment_cloud(result.breakages, 1.9, flat) is None


def test_an_overturned_vehicle_shows_a_floor_instead_of_its_shadow():
    x = np.linspace(-2.2, 2.2, 60)
    low = np.stack([x, np.zeros(60), np.full(60, 0.05 - SIZE[2] / 2)], axis=1).astype(np.float32)
    wheel = torch.tensor([[0.3 * SIZE[0], 0.8, 0.1 - SIZE[2] / 2]])
    shadow = replace(skin(30), means=torch.from_numpy(low))
    tyre = replace(skin(1).select(torch.arange(1)), means=wheel)
    shown = with_underside(GaussianCloud.concatenate([skin(), shadow, tyre]), SIZE)
    shown.check_values("underside")
    heights = shown.means[:, 2] + SIZE[2] / 2
    assert int((heights < 0.15).sum()) == 1
    floor = shown.means[(heights > 0.15) & (heights < 0.3)].numpy()
    assert (np.abs(floor).max(axis=0)[:2] < np.array(SIZE[:2]) / 2).all()
    assert (np.ptp(floor[:, :2], axis=0) > 0.85 * np.array(SIZE[:2])).all()
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert torch.equal(getattr(shown, name)[:80], getattr(skin(), name))
    assert in_wheels(shown.means.numpy().astype(float), SIZE).sum() >= 1


@pytest.mark.parametrize("over", [False, True])
def test_only_overturned_vehicles_get_a_floor(crash, tiny_scene, over):
    state, result = crash
    own = result.objects["car_red"]
    turned = np.tile((0.0, 1.0, 0.0, 0.0) if over else (0.99, 0.1, 0.0, 0.1), (4, 1))
    result = replace(result, objects={"car_red": replace(own, quaternions=turned)})
    [_, red, *_] = Playback(tiny_scene, state, result).instances(0)
    source = tiny_scene.object("car_red").cloud_at(0)
    same = len(red.cloud) == len(source) and torch.equal(red.cloud.means, source.means)
    assert same != over


def test_fragments_are_whole_gaussians(crash):
    _, result = crash
    cloud = fragment_cloud(result.breakages, 2.4, lambda places: np.zeros(len(places)))
    cloud.check_values("fragments")
    turned = quaternion_to_matrix(cloud.quats.numpy())
    np.testing.assert_allclose(np.linalg.det(turned), 1.0, atol=1e-5)
