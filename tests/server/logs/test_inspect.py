from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from real2sim_server.logs import DrivingLog, LidarSweep, inspect_log, log_of_frames, open_log
from real2sim_server.logs.drawing import draw_frame
from real2sim_server.logs.driving_log import NO_SWEEP
from real2sim_server.logs.images import read_image
from real2sim_server.scene import Trajectory
from real2sim_server.synthetic import SyntheticLog


@dataclasses.dataclass(frozen=True)
class _Moved:
    """A source whose sweeps are shifted, as with a wrong calibration."""

    source: object
    shift: tuple[float, float, float]

    def image(self, camera: str, frame: int) -> np.ndarray:
        return np.zeros((80, 120, 3), np.uint8)

    def lidar(self, frame: int) -> LidarSweep:
        sweep = self.source.lidar(frame)  # type: ignore[attr-defined]
        moved = sweep.points + np.array(self.shift, np.float32)
        return dataclasses.replace(sweep, points=moved)


def _moved(log: DrivingLog, *shift: float) -> DrivingLog:
    return dataclasses.replace(log, source=_Moved(log.source, shift))  # type: ignore[arg-type]


def test_report_describes_the_log(tiny_log: SyntheticLog) -> None:
    report = inspect_log(tiny_log)
    assert (report.frames, report.rate) == (3, pytest.approx(10))
    assert report.duration == pytest.approx(0.2)
    assert [(c.name, c.width, c.height) for c in report.cameras] == [
        ("front", 120, 80), ("front_left", 120, 80), ("front_right", 120, 80)
    ]  # fmt: skip
    assert report.cameras[0].fov == pytest.approx(np.radians(70))
    assert report.lidar_points[2] == max(len(tiny_log.lidar(f).points) for f in range(3))
    assert sum(report.tracks.values()) == len(tiny_log.tracks)
    assert report.ego_distance == pytest.approx(
        np.linalg.norm(np.diff(tiny_log.ego.positions, axis=0), axis=1).sum()
    )
    assert report.questions == report.problems == report.gaps == report.drawings == ()


def test_report_is_available_as_json_and_text(tiny_log: SyntheticLog) -> None:
    report = inspect_log(tiny_log)
    assert json.loads(json.dumps(report.as_json()))["name"] == tiny_log.name
    text = "\n".join(report.lines())
    assert "camera    front_left: 120x80, 70 degrees wide" in text
    assert "3 in 0.2 s, 10 a second" in text


def test_gaps_are_found(tiny_log: SyntheticLog) -> None:
    times = np.array([0, 100_000, 200_000, 400_000, 500_000])
    still = Trajectory(times, np.zeros((5, 3)), np.tile([1.0, 0, 0, 0], (5, 1)))
    repeating = _Repeating(tiny_log.source)
    report = inspect_log(
        dataclasses.replace(tiny_log, frame_times_us=times, ego=still, source=repeating)
    )
    assert report.gaps == ((2, pytest.approx(0.2)),)
    assert "0.20 s pass after frame 2: are frames missing?" in report.questions


@dataclasses.dataclass(frozen=True)
class _Repeating:
    source: object

    def image(self, camera: str, frame: int) -> np.ndarray:
        return self.source.image(camera, 0)  # type: ignore[attr-defined,no-any-return]

    def lidar(self, frame: int) -> LidarSweep:
        return self.source.lidar(0)  # type: ignore[attr-defined,no-any-return]


def test_jumping_ego_is_found(tiny_log: SyntheticLog) -> None:
    positions = tiny_log.ego.positions.copy()
    positions[2, 0] += 20
    ego = dataclasses.replace(tiny_log.ego, positions=positions)
    questions = inspect_log(dataclasses.replace(tiny_log, ego=ego)).questions
    assert any("the ego jumps after frame 1" in p for p in questions)


def test_lidar_at_the_wrong_height_is_found(tiny_log: SyntheticLog) -> None:
    questions = inspect_log(_moved(tiny_log, 0, 0, 1.2)).questions
    assert any(p.startswith("the road near the vehicle is at z = +1.2 m") for p in questions)


def test_boxes_in_another_frame_are_found(tiny_log: SyntheticLog) -> None:
    questions = inspect_log(_moved(tiny_log, 0, 60, 0)).questions
    assert any("hold LiDAR points" in p for p in questions)


def test_missing_parts_are_named(tiny_log: SyntheticLog, written_argoverse2: Path) -> None:
    log = dataclasses.replace(tiny_log, tracks=())
    assert any("no boxes" in p for p in inspect_log(log).questions)
    report = inspect_log(open_log(written_argoverse2))
    assert not report.questions
    assert report.left_out == {"cameras": ("camera 'ring_rear_left': has no images",)}


@dataclasses.dataclass(frozen=True)
class _OnlyImages:
    source: object

    def image(self, camera: str, frame: int) -> np.ndarray:
        return self.source.image(camera, frame)  # type: ignore[attr-defined,no-any-return]

    def lidar(self, frame: int) -> LidarSweep:
        return NO_SWEEP


def test_a_log_without_lidar_is_told_what_works(tiny_log: SyntheticLog) -> None:
    log = dataclasses.replace(tiny_log, source=_OnlyImages(tiny_log.source))
    (question,) = inspect_log(log).questions
    assert "reconstruct takes depths from features that images have in common" in question
    one = log_of_frames(log, [0])
    assert any("the ego drives 0.0 m: without LiDAR" in q for q in inspect_log(one).questions)


def test_drawings_are_written(tiny_log: SyntheticLog, tmp_path: Path) -> None:
    report = inspect_log(tiny_log, tmp_path / "out")
    names = [Path(f).name for f in report.drawings]
    assert names == ["frame_000000.jpg", "frame_000001.jpg", "frame_000002.jpg", "top.png"]
    assert read_image(tmp_path / "out/frame_000001.jpg").shape == (80, 360, 3)
    assert read_image(tmp_path / "out/top.png").std() > 10


def test_drawn_boxes_enclose_visible_vehicles(tiny_log: SyntheticLog) -> None:
    """All ground truth pixels of a vehicle lie within the drawn outline."""
    camera, frame = tiny_log.rig["front"], 1
    t_us = int(tiny_log.frame_times_us[frame])
    pose = tiny_log.ego.transform(t_us) @ camera.T_vehicle_camera
    _, _, instance = tiny_log.render(pose, camera.K, camera.width, camera.height, t_us)
    number = int(np.bincount(instance.ravel())[1:].argmax()) + 1
    only = dataclasses.replace(_moved(tiny_log, 0, 0, -1e3), tracks=(tiny_log.tracks[number - 1],))
    lines = draw_frame(only, "front", frame).max(axis=2) > 60
    rows, columns = np.nonzero(instance == number)
    drawn_rows, drawn_columns = np.nonzero(lines)
    assert drawn_rows.min() <= rows.min() + 1
    assert drawn_rows.max() >= rows.max() - 1
    assert drawn_columns.min() <= columns.min() + 1
    assert drawn_columns.max() >= columns.max() - 1
