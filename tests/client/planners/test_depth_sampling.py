from __future__ import annotations

import numpy as np
import pytest

from real2sim.images import Frame
from real2sim.planners import DepthSampling
from real2sim.planners.depth_sampling import obstacle_points

from .road import STRAIGHT, observation

HEIGHT, WIDTH, FOCAL, EYE = 80, 160, 90.0, 1.5
ROUTE = STRAIGHT[2:42:2]


def depth_frames(*boxes: tuple[float, float, float]):
    """Depth images of a camera 1.5 m above the rear axle, on a flat road with walls across it.

    Args:
        boxes: (x, y from, y to) of walls 1.5 m high, vehicle frame [m].
    """
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    aside, down = -(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL
    with np.errstate(divide="ignore"):
        depth = np.where(down > 0, EYE / down, 0.0)
    depth[depth > 60.0] = 0.0
    for x, right, left in boxes:
        height = EYE - down * x
        hit = (aside * x > right) & (aside * x < left) & (height > 0) & (height < 1.5)
        depth = np.where(hit & ((depth == 0) | (depth > x)), x, depth)
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    pose[2, 3] = EYE
    frame = Frame(
        data=depth.astype("<f4").tobytes(),
        codec="raw",
        modality="depth",
        dtype="float32",
        shape=(HEIGHT, WIDTH),
        sensor="front",
        t_us=0,
        T_world_sensor=pose,
        K=np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]),
    )
    return {"front": {"depth": frame}}


def plan_before(*boxes, speed: float = 8.0) -> np.ndarray:
    obs = observation(ROUTE, speed=speed, frames=depth_frames(*boxes))
    return np.array(DepthSampling(speed=8.0).plan(obs).poses)


def test_a_wall_is_an_obstacle_and_the_road_is_not():
    empty = observation(ROUTE, frames=depth_frames())
    assert len(obstacle_points(empty, heights=(0.35, 2.2), cell=0.4)) == 0
    seen = observation(ROUTE, frames=depth_frames((12.0, -2.0, 1.0)))
    points = obstacle_points(seen, heights=(0.35, 2.2), cell=0.4)
    assert points[:, 0] == pytest.approx(12.0, abs=0.4)
    assert points[:, 1].min() == pytest.approx(-2.0, abs=0.4)
    assert points[:, 1].max() == pytest.approx(1.0, abs=0.4)


def test_obstacles_are_in_the_vehicle_frame():
    here = observation(ROUTE, frames=depth_frames((12.0, -2.0, 1.0)))
    frame = depth_frames((12.0, -2.0, 1.0))["front"]["depth"]
    turn = np.array([[0, -1, 0, 50.0], [1, 0, 0, -7.0], [0, 0, 1, 0], [0, 0, 0, 1]])
    moved = Frame(**vars(frame) | {"T_world_sensor": turn @ frame.T_world_sensor})
    there = observation(
        ROUTE, position=(50.0, -7.0, 0.0), yaw=np.pi / 2, frames={"front": {"depth": moved}}
    )
    options = {"heights": (0.35, 2.2), "cell": 0.4}
    a, b = obstacle_points(here, **options), obstacle_points(there, **options)
    # Points on the edge of a cell may fall on either side of it.
    assert np.abs(a[:, None] - b[None]).max(axis=2).min(axis=1).max() < 0.41


def test_a_free_road_is_driven_at_cruising_speed():
    poses = plan_before()
    assert poses[-1, 0] == pytest.approx(24.0, abs=0.5)
    assert np.abs(poses[:, 1]).max() < 1e-6


def drive_towards(wall: tuple[float, float, float], *, steps: int) -> list[np.ndarray]:
    """(x, y, speed) after each plan, each driven exactly for 0.2 s."""
    planner, x, y, yaw, speed, states = DepthSampling(speed=8.0), 0.0, 0.0, 0.0, 8.0, []
    for _ in range(steps):
        box = (wall[0] - x, wall[1] - y, wall[2] - y)
        frames = depth_frames(box) if box[0] > 0.5 else depth_frames()
        c, s = np.cos(yaw), np.sin(yaw)
        route = (ROUTE - [0.0, y]) @ np.array([[c, -s], [s, c]])
        # The camera still looks along the road, so the vehicle's pose determines the points.
        obs = observation(route, speed=speed, yaw=yaw, frames=frames)
        dx, dy, turn = planner.plan(obs).poses[0]
        speed = max(2 * float(np.hypot(dx, dy)) / 0.2 - speed, 0.0)
        x, y, yaw = x + c * dx - s * dy, y + s * dx + c * dy, yaw + turn
        states.append(np.array([x, y, speed]))
    return states


def test_the_planner_stops_before_a_wall_across_the_road():
    x, y, speed = drive_towards((25.0, -8.0, 8.0), steps=50)[-1]
    assert speed < 0.1
    assert 25.0 - 9.0 < x < 25.0 - 0.75 * 4.6
    assert abs(y) < 2.0


def test_braking_is_harder_for_a_nearer_wall():
    gone = [plan_before((x, -8.0, 8.0))[5, 0] for x in (9.0, 13.0, 17.0, 40.0)]
    assert gone == sorted(gone)
    assert gone[0] < gone[-1] - 2.0


def test_an_obstacle_at_the_edge_of_the_road_is_passed_on_the_free_side():
    states = drive_towards((25.0, 0.6, 3.0), steps=30)
    beside = [y for x, y, _ in states if 25.0 - 3.5 < x < 25.0 + 1.1]
    assert beside
    assert all(y + 1.9 / 2 < 0.6 for y in beside)
    assert states[-1][0] > 30.0
