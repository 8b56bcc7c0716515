"""Merging detected tracks with those of a log."""

import numpy as np

from real2sim_server.logs import ObjectTrack
from real2sim_server.logs.tracking import merge_tracks, same_object
from real2sim_server.scene import Trajectory


def straight(object_id, *, start, speed, first_s=0.0, last_s=4.0, size=(4.4, 1.8, 1.5)):
    """A box that drives along x."""
    seconds = np.linspace(first_s, last_s, 9)
    positions = np.array(start) + np.outer(seconds, [speed, 0.0, 0.0])
    trajectory = Trajectory((seconds * 1e6).astype(np.int64), positions, np.eye(4)[[0] * 9])
    return ObjectTrack(object_id, object_id.rsplit("_", 1)[0], size, trajectory)


def test_a_track_of_the_log_is_not_added_again():
    given = straight("car_7", start=(10, 0, 0.7), speed=5)
    found = straight("car_0", start=(10.5, 0.3, 0.8), speed=5)
    assert same_object(found, given)
    assert merge_tracks([given], [found]) == (given,)


def test_a_new_track_gets_a_unique_id():
    given = straight("car_0", start=(10, 0, 0.7), speed=5)
    found = straight("car_0", start=(10, 4, 0.7), speed=5)
    ids = [track.object_id for track in merge_tracks([given], [found])]
    assert ids[0] == "car_0"
    assert len(set(ids)) == 2


def test_cars_at_the_same_place_at_different_times_are_distinct():
    given = straight("car_0", start=(10, 0, 0.7), speed=5, last_s=1.0)
    found = straight("car_1", start=(10, 0, 0.7), speed=5, first_s=2.0)
    assert not same_object(found, given)
