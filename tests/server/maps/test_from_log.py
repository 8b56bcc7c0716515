"""Lanes from a drive alone, against the true ones of the synthetic street."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from real2sim_server.logs.driving_log import DrivingLog, LidarSweep
from real2sim_server.maps import MapError, lanes_from_log
from real2sim_server.scene import Trajectory
from real2sim_server.synthetic import SyntheticConfig, generate_log


class Sparse:
    """A log's source whose sweeps have no points: ways alone."""

    def lidar(self, _frame):
        empty = np.zeros((0, 3), np.float32)
        return LidarSweep(empty, empty[:, 0], empty[:, 0].astype(np.int32), empty[0:1].sum(axis=0))


@pytest.fixture(scope="module")
def street():
    return generate_log(SyntheticConfig(seed=1, frames=40))


def errors(found, truth):
    poses = np.column_stack([found.centre[:, :2], found.headings])
    index, values = truth.nearest_many(poses)
    return {truth.lane_ids[i] for i in index}, np.abs(values[:, 1])


@pytest.mark.slow
def test_lanes_of_the_street_lie_within_a_third_of_a_metre(street):
    graph = lanes_from_log(street)
    assert graph.source == "log"
    assert graph.accuracy <= 0.4
    for lane in graph.lanes.values():
        names, error = errors(lane, street.lanes)
        assert len(names) == 1
        assert np.median(error) < 0.3
        assert lane.widths[0] == pytest.approx(3.4, abs=0.3)


def test_ways_alone_tell_both_lanes_and_say_how_well(street):
    log = replace(street, source=Sparse())
    assert isinstance(log, DrivingLog)
    graph = lanes_from_log(log)
    found = {name for lane in graph.lanes.values() for name in errors(lane, street.lanes)[0]}
    assert found == {"lane_right", "lane_left"}
    assert all(np.median(errors(v, street.lanes)[1]) < 0.3 for v in graph.lanes.values())
    assert graph.accuracy == 0.4
    own = graph.lane("log.0")
    assert own.opposite is not None
    assert graph.lane(own.opposite).opposite == "log.0"


def test_a_log_in_which_nobody_drives_is_refused_by_name(street):
    still = Trajectory.from_transforms([0, 10_000_000], np.tile(np.eye(4), (2, 1, 1)))
    log = replace(street, source=Sparse(), ego=still, tracks=())
    with pytest.raises(MapError, match=r"synthetic_1.*no vehicle drives"):
        lanes_from_log(log)
