"""Kernels of a step against plain NumPy implementations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba.core.dispatcher import Dispatcher
from scipy.spatial import cKDTree

from real2sim_proto.operations import Translate
from real2sim_proto.plans import Control, PoseCommand, TrajectoryPlan
from real2sim_server import geometry
from real2sim_server.edit import tracks
from real2sim_server.geometry import (
    box_penetration,
    quaternion_yaw,
    transform_from,
    yaw_quaternion,
)
from real2sim_server.world import boxes as world_boxes
from real2sim_server.world import path, warm_up
from real2sim_server.world.driving import entries
from real2sim_server.world.plan import PlannedTrajectory
from real2sim_server.world.scoring import comfort, instant, road
from real2sim_server.world.scoring.comfort import ComfortAccumulator, plans_agree
from real2sim_server.world.warm_up import warm_up_planning

NOW, SECOND = 4_000_000, 1_000_000
SIZE = (4.6, 1.85, 1.6)
seeds = st.integers(0, 10_000)
compiling = settings(deadline=None)
"""No deadline: the first example compiles the kernel."""


def some_boxes(rng: np.random.Generator, count: int, *, spread: float):
    """Positions, quaternions, velocities and sizes of boxes around the origin."""
    return (
        rng.normal(scale=(spread, spread, 0.5), size=(count, 3)),
        yaw_quaternion(rng.uniform(-7, 7, count)),
        rng.normal(scale=5.0, size=(count, 3)) * rng.integers(0, 2, (count, 1)),
        rng.uniform(0.5, 5.0, (count, 3)),
    )


# --- along the path ---------------------------------------------------------------------------


def some_path(rng: np.random.Generator) -> np.ndarray:
    """Knots of a winding path."""
    yaws = np.cumsum(rng.normal(scale=0.1, size=60))
    steps = rng.uniform(0.1, 3.0, 60) * np.exp(1j * yaws)
    plane = np.concatenate([[0], np.cumsum(steps)[:-1]])
    knots = np.zeros((60, path.KNOT))
    lengths = np.abs(np.diff(plane))
    knots[1:, 0] = np.cumsum(lengths)
    knots[:, 1], knots[:, 2], knots[:, 3] = plane.real, plane.imag, rng.normal(size=60)
    knots[:, 4], knots[:, 5:8] = yaws, rng.normal(size=(60, 3), loc=(0, 0, 9))
    turns = np.diff(plane).conj() / lengths**2
    knots[:-1, 8], knots[:-1, 9], knots[:-1, 10] = turns.real, turns.imag, lengths**2
    return knots


@compiling
@given(seed=seeds, x=st.floats(-50, 100), y=st.floats(-50, 50))
def test_the_nearest_point_matches_a_fine_sampling(seed, x, y):
    knots = some_path(np.random.default_rng(seed))
    s, offset, (px, py, pz), yaw, up = path.nearest_point(knots, x, y, math.nan)
    at = np.arange(0.0, knots[-1, 0], 0.01)
    east, north = np.interp(at, knots[:, 0], knots[:, 1]), np.interp(at, knots[:, 0], knots[:, 2])
    distances = np.hypot(east - x, north - y)

    distance = math.hypot(px - x, py - y)
    assert distances.min() - 0.01 <= distance <= distances.min() + 1e-9
    if 0.0 < s < knots[-1, 0]:
        assert abs(offset) == pytest.approx(distance, abs=1e-9)
    else:
        assert abs(offset) <= distance + 1e-9
    expected = [np.interp(s, knots[:, 0], knots[:, c]) for c in (1, 2, 3, 4)]
    np.testing.assert_allclose([px, py, pz, yaw], expected, atol=1e-9)
    assert math.hypot(*up) == pytest.approx(1.0)


@compiling
@given(seed=seeds, s=st.floats(-5, 120), reach=st.floats(0, 60))
def test_the_sharpest_turn_uses_headings_4_metres_apart(seed, s, reach):
    knots = some_path(np.random.default_rng(seed))
    at = s + np.arange(0.0, max(reach, 8.0) + 4.0, 4.0)
    expected = np.abs(np.diff(np.interp(at, knots[:, 0], knots[:, 4]))).max() / 4

    assert path.sharpest_turn(knots, s, reach) == pytest.approx(expected, abs=1e-12)


def leader_by_numpy(knots, s, box, bodies, own) -> tuple[float, float]:
    offset, length, width = box
    at = s + np.arange(80.0)
    x, y, yaw = (np.interp(at, knots[:, 0], knots[:, c]) for c in (1, 2, 4))
    beyond = at - np.clip(at, 0, knots[-1, 0])
    points = np.stack([x + beyond * np.cos(yaw), y + beyond * np.sin(yaw)], axis=1)
    points += offset * np.stack([-np.sin(yaw), np.cos(yaw)], axis=1)
    _, rows = cKDTree(points).query(bodies[:, :2])
    ways = bodies[:, :2] - points[rows]
    ahead = np.stack([np.cos(yaw[rows]), np.sin(yaw[rows])], axis=1)
    along = rows + (ways * ahead).sum(axis=1)
    aside = ahead[:, 0] * ways[:, 1] - ahead[:, 1] * ways[:, 0]
    c, n = np.abs(np.cos(bodies[:, 2] - yaw[rows])), np.abs(np.sin(bodies[:, 2] - yaw[rows]))
    gaps = along - length / 2 - (bodies[:, 3] * c + bodies[:, 4] * n) / 2
    blocks = np.abs(aside) < width / 2 + (bodies[:, 3] * n + bodies[:, 4] * c) / 2 + 0.3
    blocks &= (along > 0.5) & (rows < 79) & (np.arange(len(bodies)) != own)
    if not blocks.any():
        return math.inf, 0.0
    k = np.flatnonzero(blocks)[gaps[blocks].argmin()]
    return gaps[k], bodies[k, 5:] @ ahead[k]


@compiling
@given(seed=seeds, count=st.integers(1, 12), s=st.floats(0, 80), offset=st.floats(-2, 2))
def test_the_leader_is_the_nearest_object_in_the_strip(seed, count, s, offset):
    rng = np.random.default_rng(seed)
    knots = some_path(rng)
    on_it = rng.integers(0, len(knots), count)
    bodies = np.empty((count, 7))
    bodies[:, :2] = knots[on_it, 1:3] + rng.normal(scale=3.0, size=(count, 2))
    bodies[:, 2] = rng.uniform(-7, 7, count)
    bodies[:, 3:5] = rng.uniform(0.5, 6.0, (count, 2))
    bodies[:, 5:] = rng.normal(scale=5.0, size=(count, 2))
    box = (offset, 4.5, 1.8)

    found = path.next_in_strip(knots, s, box, bodies, 0)
    assert found == pytest.approx(leader_by_numpy(knots, s, box, bodies, 0), abs=1e-9)


@compiling
@given(seed=seeds, s=st.floats(-5, 120))
def test_waypoints_are_path_points_in_the_vehicle_frame(seed, s):
    rng = np.random.default_rng(seed)
    knots, (x, y, yaw) = some_path(rng), rng.normal(scale=5.0, size=3).tolist()
    found = path.waypoints(knots, s, (x, y, yaw), 20, 2.0)

    at = s + 2.0 * np.arange(1, 21)
    beyond = np.maximum(at - knots[-1, 0], 0.0) * np.exp(1j * knots[-1, 4])
    plane = np.interp(at, knots[:, 0], knots[:, 1]) + 1j * np.interp(at, knots[:, 0], knots[:, 2])
    local = (plane + beyond - complex(x, y)) * np.exp(-1j * yaw)
    np.testing.assert_allclose(found, np.stack([local.real, local.imag], axis=1), atol=1e-9)


# --- contact ----------------------------------------------------------------------------------


def overlapping(box: np.ndarray, transforms: np.ndarray, sizes: np.ndarray) -> list[int]:
    pairs = enumerate(zip(transforms, sizes, strict=True))
    return [k for k, (T, size) in pairs if box_penetration(box, SIZE, T, size) > 0]


@compiling
@given(seed=seeds, count=st.integers(0, 30))
def test_overlapping_boxes_are_within_reach(seed, count):
    rng = np.random.default_rng(seed)
    positions, _, _, sizes = some_boxes(rng, count, spread=4.0)
    transforms = transform_from(positions, rng.normal(size=(count, 4)))
    box = transform_from(rng.normal(size=3), rng.normal(size=4))

    near = world_boxes.within_reach(box, SIZE, transforms, sizes)
    distances = np.linalg.norm(positions - box[:3, 3], axis=1)
    balls = (np.linalg.norm(sizes, axis=1) + np.linalg.norm(SIZE)) / 2
    np.testing.assert_array_equal(near, np.flatnonzero(distances < balls))
    assert set(overlapping(box, transforms, sizes)) <= set(near.tolist())


@compiling
@given(seed=seeds)
def test_may_overlap_finds_boxes_that_overlap_after_the_step(seed):
    rng = np.random.default_rng(seed)
    positions, quaternions, velocities, sizes = some_boxes(rng, 5, spread=6.0)
    ego = (0.0, 0.0, float(rng.uniform(-7, 7)), 8.0, 0.0, 0.0)
    ahead = 8.0 * 0.1 * np.array([math.cos(ego[2]), math.sin(ego[2]), 0.0])
    positions[:, 2] = 0.0
    box = transform_from(ahead, yaw_quaternion(ego[2]))
    meets = overlapping(box, transform_from(positions, quaternions), sizes)

    may = world_boxes.may_overlap(ego, SIZE, 0.1, positions, quaternions, velocities, sizes)
    assert may or not meets


def test_may_overlap_excludes_distant_boxes():
    boxes = some_boxes(np.random.default_rng(0), 20, spread=3.0)
    boxes[0][:, 0] += 60.0

    assert not world_boxes.may_overlap((0.0, 0.0, 0.0, 8.0, 0.0, 0.0), SIZE, 0.1, *boxes)
    nobody = [b[:0] for b in boxes]
    assert not world_boxes.may_overlap((0.0, 0.0, 0.0, 8.0, 0.0, 0.0), SIZE, 0.1, *nobody)


def test_headings_match_quaternion_yaw():
    quaternions = np.random.default_rng(0).normal(size=(50, 4))

    found = world_boxes.headings(quaternions)
    np.testing.assert_allclose(found, quaternion_yaw(quaternions), atol=1e-12)


# --- the road ---------------------------------------------------------------------------------


def some_lines(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    lines = [
        rng.normal(scale=20.0, size=2) + np.cumsum(rng.uniform(-0.17, 0.17, (n, 2)), axis=0)
        for n in rng.integers(1, 400, count)
    ]
    return np.vstack([np.zeros((0, 2)), *lines]), np.cumsum([len(n) for n in lines], dtype=np.int64)


@compiling
@given(seed=seeds, lanes=st.integers(0, 4), far=st.sampled_from([1.0, 20.0, 2000.0]))
def test_off_road_distance_subtracts_the_half_widths_of_lanes(seed, lanes, far):
    rng = np.random.default_rng(seed)
    route, others = some_lines(rng, 1), some_lines(rng, lanes)
    x, y, yaw = (rng.normal(scale=far, size=3)).tolist()
    found, quarters = road.off_road((x, y, yaw), SIZE, route, others, (3.5, 1.75))

    signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
    turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    corners = signs * np.array(SIZE[:2]) / 2 @ turn + [x, y]
    points = np.vstack([corners, (corners + np.array([x, y])) / 2])
    beyond = cKDTree(route[0]).query(points)[0] - 3.5
    if lanes:
        beyond = np.minimum(beyond, cKDTree(others[0]).query(points)[0] - 1.75)
    if beyond[:4].max() > 0:
        assert found == pytest.approx(beyond[:4].max(), abs=1e-9)
    else:
        assert found <= 1e-9
    assert quarters == np.count_nonzero(beyond[4:] <= 0)


# --- time to collision ------------------------------------------------------------------------


def first_meeting_by_sampling(ego, everywhere: bool, others) -> int:
    """Reference: move all boxes step by step, at the ego's height and within its bearings."""
    x, y, yaw, forward, lateral, z = ego
    heading = np.array([math.cos(yaw), math.sin(yaw)])
    velocity = forward * heading + lateral * np.array([-heading[1], heading[0]])
    for step in range(31):
        T = transform_from(
            [*(np.array([x, y]) + 1.35 * heading + 0.1 * step * velocity), 0.0], yaw_quaternion(yaw)
        )
        for centre, turn, size, v in zip(*others, strict=True):
            seen = math.atan2(centre[1] - y, centre[0] - x) - yaw
            bearing = abs(math.degrees(math.remainder(seen, math.tau)))
            level = centre[2] - size[2] / 2 < z + SIZE[2] and centre[2] + size[2] / 2 > z
            if not level or not (bearing < 30 or (everywhere and bearing <= 150)):
                continue
            moved = [*(centre[:2] + 0.1 * step * v), 0.0]
            if box_penetration(T, SIZE, transform_from(moved, yaw_quaternion(turn)), size) > 0:
                return step
    return -1


@pytest.mark.parametrize("everywhere", [False, True])
@pytest.mark.parametrize("seed", range(15))
def test_the_first_overlap_matches_a_step_by_step_search(seed, everywhere):
    rng = np.random.default_rng(seed)
    positions, quaternions, velocities, sizes = some_boxes(rng, seed % 6, spread=15.0)
    planar = np.ascontiguousarray(velocities[:, :2])
    others = (positions, quaternion_yaw(quaternions), sizes, planar)
    ego = (0.3, -0.2, float(rng.uniform(-4, 4)), 6.0, 0.2, -0.8)

    nobody = np.zeros(len(sizes), np.bool_)
    found = instant.first_overlap_step(ego, SIZE, 1.35, everywhere, others, nobody)
    assert found == first_meeting_by_sampling(ego, everywhere, others)


def test_ignored_objects_do_not_overlap():
    others = (np.array([[8.0, 0, 0]]), np.zeros(1), np.full((1, 3), 2.0), np.zeros((1, 2)))
    ego = (0.0, 0.0, 0.0, 5.0, 0.0, -0.5)

    found = [
        instant.first_overlap_step(ego, SIZE, 1.35, False, others, np.array([ignored]))
        for ignored in (False, True)
    ]
    assert found == [7, -1]


# --- comfort ----------------------------------------------------------------------------------


@compiling
@given(seed=seeds, count=st.integers(0, 12), window=st.integers(1, 9))
def test_a_window_keeps_the_last_values(seed, count, window):
    values = np.random.default_rng(seed).normal(size=(count, 2))
    kept, total = comfort.windowed_sum(values[:, 0].copy(), 3.0, window)
    np.testing.assert_array_equal(kept, np.append(values[:, 0], 3.0)[-window:])
    assert total == pytest.approx(kept.sum())


def test_derivatives_are_weighted_sums():
    rng = np.random.default_rng(0)
    weights, samples = rng.normal(size=(3, 15)), rng.normal(size=(15, 2))
    (speed, _), (acceleration, rate), (jerk, yaw_acceleration) = weights @ samples

    found = comfort.derivatives(weights, samples)
    np.testing.assert_allclose(found, [speed, acceleration, jerk, rate, yaw_acceleration])


@pytest.mark.parametrize("history", [0, 3, 40])
def test_shared_comfort_updates_match_separate_ones(history):
    dt, numbers = 0.1, np.random.default_rng(history).normal(size=(60 + history, 2))
    with_history = ComfortAccumulator()
    for speed, yaw in numbers[:history].tolist():
        with_history = with_history.updated(speed, yaw, dt)
    shared = alone = (ComfortAccumulator(), with_history)
    for speed, yaw in numbers[history:].tolist():
        shared = shared[0].updated_with(shared[1], speed, yaw, dt)
        alone = tuple(comfort.updated(speed, yaw, dt) for comfort in alone)
        for one, other in zip(shared, alone, strict=True):
            assert (one.samples == other.samples).all()
            assert (one.newest, one.worst, one.comfortable) == (
                other.newest,
                other.worst,
                other.comfortable,
            )
    assert shared[0].samples is shared[1].samples


@compiling
@given(yaws=st.lists(st.floats(-20, 20) | st.just(math.pi), min_size=1, max_size=10))
def test_continuous_yaws_match_unwrap(yaws):
    poses = np.zeros((len(yaws), 3))
    poses[:, 2] = yaws
    comfort.make_continuous(poses)

    np.testing.assert_allclose(poses[:, 2], np.unwrap(yaws), atol=1e-9)


def plans_alike_by_numpy(before: PlannedTrajectory, now: PlannedTrajectory) -> bool | None:
    times = [p.times_us * 1e-6 for p in (before, now)]
    first, last = max(t[0] for t in times), min(t[-1] for t in times)
    count = int((last - first) / 0.1 + 1e-6) + 1
    if count < 6:
        return None
    at = first + 0.1 * np.arange(count)
    felt = []
    for t, plan in zip(times, (before, now), strict=True):
        x, y, yaw = plan.poses.T
        poses = [np.interp(at, t, values) for values in (x, y, np.unwrap(yaw))]
        vx, vy, rate = np.diff(poses, axis=1) / 0.1
        acceleration = np.diff(np.hypot(vx, vy)) / 0.1
        felt.append([acceleration, np.diff(acceleration) / 0.1, rate, np.diff(rate) / 0.1])
    pairs = zip(*felt, (0.7, 0.5, 0.1, 0.1), strict=True)
    return all(math.sqrt(np.mean((a - b) ** 2)) <= bound for a, b, bound in pairs)


@compiling
@given(seed=seeds, scale=st.sampled_from([0.0, 1e-4, 1e-3, 1e-2]))
def test_plans_agree_when_their_derivatives_agree(seed, scale):
    rng = np.random.default_rng(seed)
    notes = []
    for _ in range(2):
        times = NOW + np.cumsum(rng.integers(20_000, 200_000, rng.integers(1, 30)))
        t = (times - NOW) / SECOND
        poses = np.stack([8 * t, 0.1 * t, 3.0 + 0.1 * t], axis=1)
        poses += scale * rng.normal(size=poses.shape)
        poses[:, 2] = np.remainder(poses[:, 2] + np.pi, 2 * np.pi) - np.pi
        notes.append(PlannedTrajectory(times, poses))

    assert plans_agree(*notes) == plans_alike_by_numpy(*notes)


# --- all of them ------------------------------------------------------------------------------


DELAYED = {"dynamics": "dynamic_bicycle", "actuators": {"drive_delay_us": 50_000}}
EGOS = [{}, DELAYED, {"tracker": "lqr"}, {"tracker": "ilqr"}, {"tracker": "perfect"}]
PLANS = {
    "trajectory": lambda t_us: TrajectoryPlan(times_us=[t_us + SECOND], poses=[(10.0, 0.0, 0.1)]),
    "control": lambda _: Control(acceleration=1, steering=0),
    "pose": lambda t_us: PoseCommand(x=(t_us - NOW) // 100_000, y=0, yaw=0),
}


@pytest.mark.parametrize(
    ("action", "ego"),
    [*(("trajectory", ego) for ego in EGOS), ("control", {}), ("control", DELAYED), ("pose", {})],
)
@pytest.mark.parametrize(("on_collision", "default"), [("continue", "log"), ("terminate", "idm")])
def test_steps_and_edits_compile_nothing_after_the_warm_up(
    make_world, moving, action, ego, on_collision, default
):
    warm_up()
    if ego.get("tracker") == "ilqr":
        warm_up_planning()
    modules = (
        entries,
        geometry,
        tracks,
        path,
        world_boxes,
        road,
        instant,
        comfort,
    )
    kernels = [v for m in modules for v in vars(m).values() if isinstance(v, Dispatcher)]
    before = {k.__name__: len(k.signatures) for k in kernels}
    world = make_world(
        car=moving(25, 0, z=0.8),
        aside=moving(12, 3, z=0.8, speed=3.0),
        spec={
            "privileged": True,
            "action": action,
            "ego": ego,
            "on_collision": on_collision,
            "agents": {"default": default},
        },
    )
    assert world.apply([Translate(object_id="car", x=-11.0, y=2.0)]).warnings
    while not world.over:
        world.step(PLANS[action](world.t_us))
        world.observe()

    assert {k.__name__: len(k.signatures) for k in kernels} == before
