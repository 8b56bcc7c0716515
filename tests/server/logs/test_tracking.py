from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from real2sim_server.geometry import apply_transform
from real2sim_server.logs import DrivingLog, LidarSweep, ObjectTrack, open_log
from real2sim_server.logs.association import SweepRays, find_sweep_ground, smooth
from real2sim_server.logs.drawing import points_in_box
from real2sim_server.logs.tracking import TrackingOptions, track_moving_objects
from real2sim_server.synthetic import SyntheticConfig, generate_log

NEAR = 30.0
SEEN = 20
DRIVE = SyntheticConfig(
    seed=0, frames=18, moving_cars=5, width=32, height=32, lidar_beams=48, lidar_columns=768
)


@pytest.fixture(scope="module")
def drive() -> DrivingLog:
    return generate_log(DRIVE)


@pytest.fixture(scope="module")
def found(drive: DrivingLog) -> tuple[ObjectTrack, ...]:
    return track_moving_objects(dataclasses.replace(drive, tracks=()))


@dataclasses.dataclass(frozen=True)
class _Score:
    """Accuracy of tracks against the visible moving objects of a log.

    Attributes:
        seen: number of sightings: moving objects within NEAR with at least SEEN points, per frame.
        recall: fraction of the sightings with a track within 2.5 m.
        errors, turns: position errors [m] and heading errors [rad] of the matched sightings.
        matched: ids of the matched tracks.
    """

    seen: int
    recall: float
    errors: np.ndarray
    turns: np.ndarray
    matched: set[str]


def _score(log: DrivingLog, tracks: tuple[ObjectTrack, ...], *, near: float = NEAR) -> _Score:
    seen, errors, turns, matched = 0, [], [], set()
    for frame, t_us in enumerate(log.frame_times_us.tolist()):
        here = log.ego.transform(t_us)
        points = apply_transform(here, log.lidar(frame).points.astype(np.float64))
        placed = [(t, t.trajectory.transform(t_us)) for t in tracks if t.trajectory.covers(t_us)]
        for truth in log.tracks:
            if not truth.trajectory.moves or not truth.trajectory.covers(t_us):
                continue
            pose = truth.trajectory.transform(t_us)
            too_far = np.hypot(*(pose[:2, 3] - here[:2, 3])) > near
            if too_far or points_in_box(points, pose, truth.size) < SEEN:
                continue
            seen += 1
            apart = [float(np.hypot(*(p[:2, 3] - pose[:2, 3]))) for _, p in placed]
            if apart and min(apart) < 2.5:
                track, best = placed[int(np.argmin(apart))]
                errors.append(min(apart))
                turns.append(np.arccos(np.clip(best[:2, 0] @ pose[:2, 0], -1, 1)))
                matched.add(track.object_id)
    return _Score(seen, len(errors) / max(seen, 1), np.array(errors), np.array(turns), matched)


def test_moving_vehicles_nearby_are_found(
    drive: DrivingLog, found: tuple[ObjectTrack, ...]
) -> None:
    score = _score(drive, found)
    assert score.seen > 30
    assert score.recall > 0.95
    assert np.median(score.errors) < 0.5
    assert np.median(score.turns) < np.radians(2)


def test_stationary_objects_are_not_tracked(
    drive: DrivingLog, found: tuple[ObjectTrack, ...]
) -> None:
    score = _score(drive, found, near=100)
    assert {t.object_id for t in found} == score.matched


def test_boxes_rest_on_the_road_and_have_names(found: tuple[ObjectTrack, ...]) -> None:
    assert len(found) >= 3
    for track in found:
        category, number = track.object_id.rsplit("_", 1)
        assert (category, number.isdecimal()) == (track.category, True)
        bottom = track.trajectory.positions[:, 2] - track.size[2] / 2
        assert np.abs(bottom).max() < 0.25


@pytest.mark.slow
def test_tracking_is_reproducible(drive: DrivingLog) -> None:
    short = dataclasses.replace(drive, frame_times_us=drive.frame_times_us[:8])
    options = TrackingOptions(min_distance=1.0)
    one, two = (track_moving_objects(short, options) for _ in range(2))
    assert [t.object_id for t in one] == [t.object_id for t in two]
    for a, b in zip(one, two, strict=True):
        assert (a.trajectory.positions == b.trajectory.positions).all()


def test_log_without_points_has_no_tracks(drive: DrivingLog) -> None:
    @dataclasses.dataclass(frozen=True)
    class Dark:
        def image(self, camera: str, frame: int) -> np.ndarray:
            raise AssertionError("images are not needed")

        def lidar(self, frame: int) -> LidarSweep:
            empty = np.zeros((0, 3), np.float32)
            return LidarSweep(empty, empty[:, 0], np.zeros(0, np.int32), np.zeros(3, np.float32))

    assert track_moving_objects(dataclasses.replace(drive, source=Dark())) == ()


@pytest.mark.slow
def test_sample_jam_is_tracked(test_data: Path) -> None:
    """The reference boxes come from scan registration with manually selected regions."""
    path = test_data / "kitti_jam"
    if not path.is_dir():
        pytest.skip(f"no sample drive at {path}")
    log = open_log(path)
    score = _score(log, track_moving_objects(dataclasses.replace(log, tracks=())))
    assert score.recall > 0.95
    assert np.median(score.errors) < 0.4
    assert len(score.matched) == 5


def test_ground_follows_a_slope_below_a_truck() -> None:
    x, y = np.meshgrid(np.linspace(-20, 20, 200), np.linspace(-20, 20, 200))
    slope = 0.03 * x
    on_truck = (np.abs(x - 8) < 5) & (np.abs(y) < 1.3)
    z = np.where(on_truck, slope + 2.5, slope)
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    ground = find_sweep_ground(points, 20.0)
    places = np.array([[8.0, 0.0], [-10.0, 5.0], [0.0, 0.0]])
    np.testing.assert_allclose(ground.at(places), 0.03 * places[:, 0], atol=0.15)


def test_smoother_recovers_straight_motion_across_a_gap() -> None:
    times = np.arange(20) * 0.1
    way = np.stack([3 + 8 * times, 1 - 2 * times], axis=1)
    noise = np.random.default_rng(0).normal(0, 0.1, way.shape)
    places: list[np.ndarray | None] = list(way + noise)
    places[8:12] = [None] * 4
    states = smooth(times, places, 0.1)
    assert np.abs(states[:, :2] - way).max() < 0.2
    assert np.abs(states[5:15, 2:] - [8, -2]).max() < 0.5


def test_rays_distinguish_free_space_from_occlusion() -> None:
    """A wall at 20 m, with a board at 10 m in front of its centre."""
    y, z = (v.ravel() for v in np.meshgrid(np.linspace(-8, 8, 400), np.linspace(-1, 1, 40)))
    board = np.abs(y) < 2
    distance = np.where(board, 10.0, 20.0)
    points = np.stack([distance, y * distance / 20, z * distance / 20], axis=1)
    rays = SweepRays(points.astype(np.float32), np.zeros(3))
    line = np.linspace(-0.2, 0.2, 50)
    free_air = np.stack([np.full(50, 15.0), 5 + line, 0 * line], axis=1)
    on_wall = np.stack([np.full(50, 20.0), 6 + line, 0 * line], axis=1)
    behind_board = np.stack([np.full(50, 15.0), line, 0 * line], axis=1)
    assert rays.count(free_air) == (50, 0)
    assert rays.count(on_wall) == (0, 50)
    assert rays.count(behind_board) == (0, 0)
