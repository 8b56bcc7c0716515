from __future__ import annotations

import pytest

from real2sim_server.cli.logs import track
from real2sim_server.logs import open_log
from real2sim_server.logs.tracking import same_object
from real2sim_server.synthetic import SyntheticConfig, synthesize


@pytest.mark.slow
def test_a_log_without_boxes_gets_tracks_of_moving_objects(tmp_path):
    config = SyntheticConfig(frames=24, width=96, height=64, moving_cars=3, parked_cars=4)
    log = open_log(synthesize(config, tmp_path / "log"))
    track(log=tmp_path / "log", out=tmp_path / "tracked")
    tracked = open_log(tmp_path / "tracked")
    assert tracked.frame_count == log.frame_count
    assert any(same_object(found, truth) for found in tracked.tracks for truth in log.tracks)
