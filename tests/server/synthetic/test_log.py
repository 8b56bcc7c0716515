from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from real2sim_server.geometry import Float, apply_transform, invert_transform
from real2sim_server.logs import DrivingLog, ObjectTrack, open_log
from real2sim_server.scene import Camera, Trajectory
from real2sim_server.synthetic import (
    CameraSpec,
    SyntheticConfig,
    SyntheticLog,
    generate_log,
    synthesize,
)
from real2sim_server.synthetic.traffic import DrivePlan, plan_drive
from real2sim_server.synthetic.vehicles import SHAPES

SEED = 3
SMALL = SyntheticConfig(seed=SEED, frames=4, width=192, height=128, lidar_columns=720)


@pytest.fixture(scope="module")
def log() -> SyntheticLog:
    return generate_log(SMALL)


@pytest.fixture(scope="module")
def exact_log() -> SyntheticLog:
    """The same drive with a LiDAR that makes no error in range."""
    return generate_log(replace(SMALL, lidar_noise=0.0))


def _render(
    log: SyntheticLog, frame: int, camera: str = "front"
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.uint16]]:
    lens, t_us = log.rig[camera], int(log.frame_times_us[frame])
    pose = log.ego.transform(t_us) @ lens.T_vehicle_camera
    return log.render(pose, lens.K, lens.width, lens.height, t_us)


def _moves(track: ObjectTrack) -> bool:
    return bool(np.ptp(track.trajectory.positions, axis=0).max() > 0.01)


def test_same_seed_gives_the_same_bits(log: SyntheticLog) -> None:
    again = generate_log(SMALL)
    assert (log.image("front_left", 2) == again.image("front_left", 2)).all()
    assert (log.lidar(1).points == again.lidar(1).points).all()
    assert (log.ego.positions == again.ego.positions).all()


def test_other_seed_gives_another_street(log: SyntheticLog) -> None:
    other = generate_log(replace(SMALL, seed=SEED + 1))
    differs = (log.image("front", 0) != other.image("front", 0)).any(axis=2)
    assert differs.mean() > 0.5
    assert log.tracks[0].trajectory.positions[0, 0] != other.tracks[0].trajectory.positions[0, 0]


def test_images_are_the_truth_from_the_camera(log: SyntheticLog) -> None:
    assert (_render(log, 1, "front_right")[0] == log.image("front_right", 1)).all()


def test_pictures_hold_light_and_shade_and_colour(log: SyntheticLog) -> None:
    image = log.image("front", 0).astype(np.float64)
    brightness = image.mean(axis=2)
    assert brightness.std() > 30
    assert np.percentile(brightness, 1) < 45
    assert np.percentile(brightness, 99) > 190
    sky = image[:10, 70:120].mean(axis=(0, 1))
    assert sky[2] > sky[0]


def test_every_ray_below_the_horizon_hits_something(log: SyntheticLog) -> None:
    for camera in log.rig.names:
        depth = _render(log, 0, camera)[1]
        assert (depth[depth.shape[0] // 2 :] > 0).all()


def test_road_lies_at_height_zero(log: SyntheticLog) -> None:
    _, depth, instance = _render(log, 0)
    points = _lift(log.rig["front"], depth)
    road = points[(instance == 0) & (points[..., 0] < 15) & (np.abs(points[..., 1]) < 1.5)]
    ground = road[(road[:, 2] < 0.5)]
    assert len(ground) > 500
    assert np.abs(ground[:, 2]).max() < 1e-3


def _lift(camera: Camera, depth: NDArray[np.float32]) -> Float:
    """Points [H, W, 3] of a depth image, vehicle frame."""
    v, u = np.indices(depth.shape) + 0.5
    k = camera.K
    x, y = (u - k[0, 2]) / k[0, 0] * depth, (v - k[1, 2]) / k[1, 1] * depth
    flat = np.stack([x, y, depth], axis=-1).reshape(-1, 3)
    return apply_transform(camera.T_vehicle_camera, flat).reshape(*depth.shape, 3)


def test_boxes_contain_exactly_the_pixels_of_their_vehicles(log: SyntheticLog) -> None:
    seen = 0
    for frame in (0, 3):
        t_us = int(log.frame_times_us[frame])
        for camera in log.rig.names:
            _, depth, instance = _render(log, frame, camera)
            points = _lift(log.rig[camera], depth)
            for index, track in enumerate(log.tracks):
                local = _in_box(log, track, t_us, points.reshape(-1, 3))
                inside = _inside(local, track, margin=0.005).reshape(depth.shape) & (depth > 0)
                own = instance == index + 1
                assert inside[own].all()
                # What else is inside a box can only be the road it stands on.
                height = local[:, 2].reshape(depth.shape)[inside & ~own]
                assert (height < 0.01 - track.size[2] / 2).all()
                seen += own.sum()
    assert seen > 2000


def _in_box(log: DrivingLog, track: ObjectTrack, t_us: int, points: Float) -> Float:
    to_object = invert_transform(track.trajectory.transform(t_us)) @ log.ego.transform(t_us)
    return apply_transform(to_object, points)


def _inside(local: Float, track: ObjectTrack, *, margin: float) -> NDArray[np.bool_]:
    inside: NDArray[np.bool_] = (np.abs(local) < np.array(track.size) / 2 + margin).all(axis=1)
    return inside


@pytest.mark.parametrize("seed", [0, 1])
def test_vehicles_fill_their_boxes(seed: int) -> None:
    """Seen from all around, a vehicle reaches every face of its box."""
    log = generate_log(replace(SMALL, seed=seed, frames=1, moving_cars=1, parked_cars=0))
    track, t_us = log.tracks[0], 0
    size = np.array(track.size)
    reached = np.zeros((2, 3))
    for direction in ([1, 0, 0.15], [-1, 0, 0.15], [0, 1, 0.15], [0, -1, 0.15], [0.01, 0, 1]):
        pose = _facing_origin(5.5 * np.array(direction, float))
        k = np.array([[120.0, 0, 150], [0, 120, 150], [0, 0, 1]])
        T_world_object = track.trajectory.transform(t_us)
        _, depth, instance = log.render(T_world_object @ pose, k, 300, 300, t_us)
        camera = Camera("probe", 300, 300, k, pose)
        own = _lift(camera, depth)[instance == 1]
        reached[0] = np.minimum(reached[0], own.min(axis=0))
        reached[1] = np.maximum(reached[1], own.max(axis=0))
    np.testing.assert_allclose(reached, [-size / 2, size / 2], atol=0.06)


def _facing_origin(position: Float) -> Float:
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = position
    return pose


def test_lidar_measures_what_cameras_see(exact_log: SyntheticLog) -> None:
    """Points measured within a millisecond of the image lie on the depth image's surfaces."""
    log = exact_log
    sweep = log.lidar(2)
    t_us = int(log.frame_times_us[2])
    beams = sweep.points[np.abs(sweep.offset_us) < 4000].astype(np.float64)
    aim = beams - sweep.origin
    distance = np.linalg.norm(aim, axis=1)
    checked = 0
    for point, reach, ray in zip(beams[::47], distance[::47], aim[::47], strict=True):
        # A camera at the sensor, one pixel wide, looking along the beam.
        T_vehicle_probe = _facing_origin(-ray)
        T_vehicle_probe[:3, 3] = sweep.origin
        pose = log.ego.transform(t_us) @ T_vehicle_probe
        k = np.array([[1000.0, 0, 0.5], [0, 1000, 0.5], [0, 0, 1]])
        _, depth, instance = log.render(pose, k, 1, 1, t_us)
        if instance[0, 0] == 0:
            assert depth[0, 0] == pytest.approx(reach, abs=0.02), point
            checked += 1
    assert checked > 30


def test_lidar_noise_has_the_asked_spread(log: SyntheticLog) -> None:
    sweep = log.lidar(0)
    x, y, z = sweep.points.T
    # On the road an error along the beam shows as height, by the beam's slope.
    road = (np.abs(y) < 1.0) & (x > 3) & (x < 8) & (np.abs(z) < 0.12)
    reach = np.linalg.norm(sweep.points - sweep.origin, axis=1)
    error = z[road] * reach[road] / sweep.origin[2]
    assert road.sum() > 300
    assert error.std() == pytest.approx(SMALL.lidar_noise, rel=0.15)
    assert abs(error.mean()) < 0.005


def test_sweeps_end_at_the_range_limit(log: SyntheticLog) -> None:
    sweep = log.lidar(0)
    reach = np.linalg.norm(sweep.points - sweep.origin, axis=1)
    assert reach.max() < SMALL.lidar_range + 0.2
    possible = SMALL.lidar_beams * SMALL.lidar_columns
    assert 0.6 * possible < len(sweep.points) < 0.99 * possible


def test_points_of_parked_vehicles_stay_in_their_boxes_in_all_sweeps(
    exact_log: SyntheticLog,
) -> None:
    log, found = exact_log, 0
    for frame in (0, 3):
        points = log.lidar(frame).points.astype(np.float64)
        for track in (t for t in log.tracks if not _moves(t)):
            local = _points_near(log, track, points, int(log.frame_times_us[frame]))
            assert _outside(local, track) <= 0.01 * len(local)
            found += len(local)
    assert found > 2000


def test_points_of_moving_vehicles_move_with_their_boxes(exact_log: SyntheticLog) -> None:
    log, found = exact_log, 0
    movers = [t for t in log.tracks if _moves(t)]
    for frame in (1, 2):
        t_us, sweep = int(log.frame_times_us[frame]), log.lidar(frame)
        for track in movers:
            still = _points_near(log, track, sweep.points.astype(np.float64), t_us)
            velocity = log.ego.transform(t_us)[:3, :3].T @ track.trajectory.velocity(t_us)
            shift = velocity * (sweep.offset_us * 1e-6)[:, None]
            moved = _points_near(log, track, sweep.points - shift, t_us)
            assert _outside(moved, track) <= 0.01 * len(moved)
            found += len(moved)
            assert len(moved) >= 0.9 * len(still)
    assert len(movers) == SMALL.moving_cars
    assert found > 500


def _points_near(log: DrivingLog, track: ObjectTrack, points: Float, t_us: int) -> Float:
    local = _in_box(log, track, t_us, points)
    above = local[:, 2] > 0.3 - track.size[2] / 2
    return local[above & _inside(local, track, margin=0.25)]


def _outside(local: Float, track: ObjectTrack) -> int:
    return int((~_inside(local, track, margin=0.02)).sum())


def test_vehicles_keep_clear_of_each_other() -> None:
    for seed in range(12):
        config = replace(SMALL, seed=seed, frames=60, moving_cars=6, parked_cars=20)
        drive = plan_drive(config)
        for t_us in drive.frame_times_us[::8]:
            _assert_clear(drive, int(t_us))


def _assert_clear(drive: DrivePlan, t_us: int) -> None:
    ego = drive.ego.transform(t_us)
    boxes = [(ego[:2, 3] + 1.4 * ego[:2, 0], ego, DrivingLog.ego_size)]
    for vehicle in drive.vehicles:
        pose = vehicle.trajectory.transform(t_us)
        boxes.append((pose[:2, 3], pose, SHAPES[vehicle.shape].size))
    for i, (centre, pose, size) in enumerate(boxes):
        for other, _, other_size in boxes[i + 1 :]:
            along, across = pose[:2, :2].T @ (other - centre)
            apart = abs(along) > (size[0] + other_size[0]) / 2 + 0.3
            assert apart or abs(across) > (size[1] + other_size[1]) / 2 + 0.1


def test_asked_numbers_of_vehicles_are_there(log: SyntheticLog) -> None:
    assert sum(_moves(t) for t in log.tracks) == SMALL.moving_cars
    assert len(log.tracks) == SMALL.moving_cars + SMALL.parked_cars
    headings = [t.trajectory.transform(0)[0, 0] for t in log.tracks if _moves(t)]
    assert min(headings) < -0.9
    assert max(headings) > 0.9


def test_street_without_vehicles_or_lidar() -> None:
    config = replace(SMALL, frames=1, moving_cars=0, parked_cars=0, lidar_beams=0)
    log = generate_log(config)
    assert log.tracks == ()
    assert log.image("front", 0).shape == (128, 192, 3)
    assert len(log.lidar(0).points) == 0


def test_shifted_lane_shows_the_same_street(log: SyntheticLog) -> None:
    """Depth from two metres to the left agrees with the points seen from the lane."""
    lens = log.rig["front"]
    _, depth, instance = _render(log, 0)
    points = _lift(lens, depth)
    _, other, _ = log.render(_shifted(lens), lens.K, lens.width, lens.height, 0)
    wanted = (instance == 0) & (depth > 0) & (depth < 25)
    local = apply_transform(invert_transform(_shifted(lens)), points[wanted])
    u = np.floor(lens.K[0, 0] * local[:, 0] / local[:, 2] + lens.K[0, 2]).astype(int)
    v = np.floor(lens.K[1, 1] * local[:, 1] / local[:, 2] + lens.K[1, 2]).astype(int)
    inside = (u >= 0) & (u < lens.width) & (v >= 0) & (v < lens.height)
    error = np.abs(other[v[inside], u[inside]] - local[inside, 2]) / local[inside, 2]
    assert np.mean(error < 0.05) > 0.8


def _shifted(lens: Camera) -> Float:
    pose = lens.T_vehicle_camera.copy()
    pose[1, 3] += 2.0
    return pose


def test_finer_sampling_changes_edges_only(log: SyntheticLog) -> None:
    finer = generate_log(replace(SMALL, samples=4)).image("front", 0).astype(int)
    difference = np.abs(finer - log.image("front", 0).astype(int)).max(axis=2)
    assert difference.mean() < 3
    assert (difference == 0).mean() > 0.5


def test_synthesize_writes_a_native_log(tmp_path: Path) -> None:
    config = replace(SMALL, frames=2, width=48, height=32, lidar_beams=8, lidar_columns=90)
    path = synthesize(config, tmp_path / "drive")
    log = open_log(path)
    assert log.frame_count == 2
    assert log.provenance["config"]["seed"] == SEED


def test_own_cameras_make_the_rig() -> None:
    rear = CameraSpec("rear", yaw=np.pi, position=(-0.5, 0.0, 1.5))
    log = generate_log(replace(SMALL, frames=1, cameras=(rear,)))
    assert log.rig.names == ("rear",)
    assert log.image("rear", 0).std() > 20


BAD_VALUES: dict[str, dict[str, Any]] = {
    "frames": {"frames": 0},
    "hz": {"hz": 0.0},
    "speed": {"speed": float("nan")},
    "width": {"width": 0},
    "cameras": {"cameras": ()},
    "fov": {"cameras": (CameraSpec("front", fov=4.0),)},
    "parked_cars": {"parked_cars": -1},
}


@pytest.mark.parametrize("name", BAD_VALUES)
def test_values_that_give_no_drive_are_refused_by_name(name: str) -> None:
    make: Callable[..., SyntheticConfig] = SyntheticConfig
    with pytest.raises(ValueError, match=name):
        make(**BAD_VALUES[name])


def test_the_truth_of_an_edited_street_has_the_given_vehicles_alone(log):
    camera, pose = log.rig["front"], log.rig["front"].pose(log.ego.transform(0))
    places = np.stack([np.eye(4)] * 2)
    places[:, :3, 3] = [(14.0, 2.0, 0.8), (14.0, -2.0, 0.8)]
    size = (camera.width, camera.height)
    _, _, instance = log.render_placed(pose, camera.K, size, [1, 1], places)
    columns = [np.flatnonzero((instance == number).any(axis=0)) for number in (1, 2)]
    assert np.unique(instance).tolist() == [0, 1, 2]
    assert columns[0].mean() < camera.width / 2 < columns[1].mean()


def test_the_truth_of_a_street_that_is_not_edited_is_what_was_recorded(log):
    camera, t_us = log.rig["front"], int(log.frame_times_us[0])
    pose = camera.pose(log.ego.transform(t_us))
    places = np.stack([track.trajectory.transform(t_us) for track in log.tracks])
    every = range(len(log.tracks))
    size = (camera.width, camera.height)
    rgb, _, _ = log.render_placed(pose, camera.K, size, every, places)
    np.testing.assert_array_equal(rgb, log.image("front", 0))


def test_a_street_without_a_vehicle_is_the_street_with_all_others(log):
    camera, t_us = log.rig["front"], int(log.frame_times_us[0])
    pose = camera.pose(log.ego.transform(t_us))
    size = (camera.width, camera.height)
    places = np.stack([track.trajectory.transform(t_us) for track in log.tracks])
    others = range(1, len(log.tracks))
    expected = log.render_placed(pose, camera.K, size, others, places[1:])
    without = log.with_vehicles({log.tracks[0].object_id: None})
    assert [t.object_id for t in without.tracks] == [t.object_id for t in log.tracks[1:]]
    for found, image in zip(without.render(pose, camera.K, *size, t_us), expected, strict=True):
        np.testing.assert_array_equal(found, image)
    assert "config" not in without.provenance


def test_a_vehicle_on_another_trajectory_keeps_its_place_among_the_tracks(log):
    name, t_us = log.tracks[1].object_id, int(log.frame_times_us[0])
    away = np.eye(4)
    away[:3, 3] = (14.0, 2.0, 0.8)
    moved = log.with_vehicles({name: Trajectory.from_transforms([t_us], [away])})
    camera, pose = log.rig["front"], log.rig["front"].pose(log.ego.transform(t_us))
    _, _, instance = moved.render(pose, camera.K, camera.width, camera.height, t_us)
    columns = np.flatnonzero((instance == 2).any(axis=0))
    assert [track.object_id for track in moved.tracks] == [t.object_id for t in log.tracks]
    assert 0 < columns.mean() < camera.width / 2


def test_only_vehicles_can_be_changed_on_a_street(log):
    with pytest.raises(ValueError, match="no vehicles: nothing_7; vehicles are"):
        log.with_vehicles({"nothing_7": None})
