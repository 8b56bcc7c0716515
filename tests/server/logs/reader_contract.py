"""The contract of log readers, as a class of tests.

Derive a test class from :class:`ReaderContract` and define a fixture ``folder``: a drive in the
reader's layout with at least two frames, a roof LiDAR and boxes.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from real2sim_server.logs import DrivingLog, LogError, open_log
from real2sim_server.logs.readers import READERS


def told_about(folder: Path) -> tuple[bool, str]:
    """Whether a log is refused, and all that is said about what cannot be used."""
    try:
        log = open_log(folder)
    except LogError as error:
        return True, str(error)
    return False, "\n".join(text for texts in log.left_out.values() for text in texts)


class ReaderContract:
    """Tests of a reader with a folder in its layout."""

    @pytest.fixture
    def log(self, folder: Path) -> DrivingLog:
        return open_log(folder)

    def test_exactly_one_reader_recognises_the_folder(self, folder: Path) -> None:
        assert sum(reader.recognises(folder) for reader in READERS) == 1

    def test_world_is_the_vehicle_frame_of_the_first_frame(self, log: DrivingLog) -> None:
        first = log.ego.transform(int(log.frame_times_us[0]))
        np.testing.assert_allclose(first, np.eye(4), atol=1e-6)

    def test_ego_poses_cover_all_frames(self, log: DrivingLog) -> None:
        assert (np.diff(log.frame_times_us) > 0).all()
        assert all(log.ego.covers(int(t)) for t in log.frame_times_us)

    def test_images_have_the_size_of_their_camera(self, log: DrivingLog) -> None:
        for camera in log.rig:
            image = log.image(camera.name, log.frame_count - 1)
            assert image.shape == (camera.height, camera.width, 3)
            assert image.dtype == np.uint8

    def test_sweeps_are_complete(self, log: DrivingLog) -> None:
        sweep = log.lidar(log.frame_count - 1)
        n = len(sweep.points)
        assert n > 1000
        assert sweep.points.shape == (n, 3)
        assert sweep.points.dtype == sweep.intensity.dtype == sweep.origin.dtype == np.float32
        assert sweep.offset_us.dtype == np.int32
        assert len(sweep.intensity) == len(sweep.offset_us) == n
        assert np.isfinite(sweep.points).all()
        assert sweep.intensity.min() >= 0
        assert sweep.intensity.max() <= 1
        # Within one revolution. Its start relative to the timestamp depends on the data set.
        assert np.abs(sweep.offset_us).max() <= 110_000
        assert np.ptp(sweep.offset_us) <= 110_000

    def test_sensor_is_above_the_ground_and_the_ground_is_at_zero(self, log: DrivingLog) -> None:
        sweep = log.lidar(0)
        assert 1.5 < sweep.origin[2] < 2.3
        x, y, z = sweep.points.T
        road = z[(np.hypot(x, y) < 9) & (np.abs(y) < 1.2) & (x > 2.5) & (z < 0.4)]
        assert len(road) > 50
        assert abs(np.median(road)) < 0.1

    def test_tracks_are_named_by_category_and_number(self, log: DrivingLog) -> None:
        ids = [track.object_id for track in log.tracks]
        assert len(set(ids)) == len(ids) > 0
        for track in log.tracks:
            category, number = track.object_id.rsplit("_", 1)
            assert category == track.category == category.lower()
            assert number.isdecimal()
            assert min(track.size) > 0

    def test_provenance_is_plain_json(self, log: DrivingLog) -> None:
        assert json.loads(json.dumps(dict(log.provenance)))["reader"]

    def test_opening_is_reproducible(self, folder: Path) -> None:
        one, two = open_log(folder), open_log(folder)
        camera = one.rig.names[0]
        assert (one.image(camera, 1) == two.image(camera, 1)).all()
        assert (one.lidar(1).points == two.lidar(1).points).all()
        assert (one.ego.positions == two.ego.positions).all()

    def test_frames_outside_the_log_are_refused(self, log: DrivingLog) -> None:
        with pytest.raises(LogError, match=r"has frames 0 to \d+, not"):
            log.lidar(log.frame_count)

    def test_unknown_sequence_is_refused(self, folder: Path) -> None:
        with pytest.raises(LogError, match="sequence"):
            open_log(folder, sequence="nowhere")
