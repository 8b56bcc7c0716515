"""Boxes that were found, put beside those that a log has."""

import numpy as np
import pytest

from real2sim_server.cli.track import merged, run, same_object
from real2sim_server.logs import ObjectTrack, open_log
from real2sim_server.logs.native_writer import write_native_log
from real2sim_server.scene import Trajectory
from real2sim_server.synthetic import SyntheticConfig, synthesize


def straight(object_id, *, start, speed, first_s=0.0, last_s=4.0, size=(4.4, 1.8, 1.5)):
    """A box that drives along x."""
    seconds = np.linspace(first_s, last_s, 9)
    positions = np.array(start) + np.outer(seconds, [speed, 0.0, 0.0])
    trajectory = Trajectory((seconds * 1e6).astype(np.int64), positions, np.eye(4)[[0] * 9])
    return ObjectTrack(object_id, object_id.rsplit("_", 1)[0], size, trajectory)


def test_a_box_that_the_log_has_is_not_added_again():
    given = straight("car_7", start=(10, 0, 0.7), speed=5)
    found = straight("car_0", start=(10.5, 0.3, 0.8), speed=5)
    assert same_object(found, given)
    assert merged([given], [found]) == (given,)


def test_what_the_log_lacks_is_added_under_an_id_of_its_own():
    given = straight("car_0", start=(10, 0, 0.7), speed=5)
    found = straight("car_0", start=(10, 4, 0.7), speed=5)
    ids = [track.object_id for track in merged([given], [found])]
    assert ids[0] == "car_0"
    assert len(set(ids)) == 2


def test_cars_that_pass_the_same_place_at_other_times_are_two():
    given = straight("car_0", start=(10, 0, 0.7), speed=5, last_s=1.0)
    found = straight("car_1", start=(10, 0, 0.7), speed=5, first_s=2.0)
    assert not same_object(found, given)


@pytest.mark.slow
def test_a_log_without_boxes_gets_those_of_what_moves(tmp_path):
    config = SyntheticConfig(frames=24, width=96, height=64, moving_cars=3, parked_cars=4)
    log = open_log(synthesize(config, tmp_path / "log"))
    run(
        log=tmp_path / "log",
        out=tmp_path / "tracked",
        options={},
        keep=False,
        image_format="jpg",
        log_format=None,
        sequence=None,
        json_path=None,
    )
    tracked = open_log(tmp_path / "tracked")
    assert tracked.frame_count == log.frame_count
    assert any(same_object(track, truth) for track in tracked.tracks for truth in log.tracks)
    assert write_native_log(tracked, tmp_path / "again").is_dir()
