"""Selections of frames and cameras of a log."""

from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.logs import DrivingLog, LogError, LogSelection, same_part, select_from_log
from real2sim_server.synthetic import SyntheticLog


def test_a_selection_keeps_images_sweeps_and_poses(tiny_log: SyntheticLog) -> None:
    part = select_from_log(tiny_log, LogSelection(first=1, every=2))
    assert part.frame_times_us.tolist() == tiny_log.frame_times_us[1::2].tolist()
    camera = tiny_log.rig.names[0]
    for frame, whole in enumerate(range(1, tiny_log.frame_count, 2)):
        assert np.array_equal(part.image(camera, frame), tiny_log.image(camera, whole))
        assert np.array_equal(part.lidar(frame).points, tiny_log.lidar(whole).points)
        t_us = part.image_time_us(camera, frame)
        assert t_us == tiny_log.image_time_us(camera, whole)
        assert np.allclose(part.ego.transform(t_us), tiny_log.ego.transform(t_us), atol=1e-12)


def test_ego_and_tracks_are_cut_to_the_selection(tiny_log: SyntheticLog) -> None:
    part = select_from_log(tiny_log, LogSelection(first=1, stop=3))
    taken = [part.image_time_us(c, f) for c in part.rig.names for f in range(part.frame_count)]
    instants = [*taken, *part.frame_times_us.tolist()]
    assert (part.ego.start_us, part.ego.end_us) == (min(instants), max(instants))
    for track in part.tracks:
        assert part.ego.start_us <= track.trajectory.start_us
        assert track.trajectory.end_us <= part.ego.end_us
        (whole,) = [t for t in tiny_log.tracks if t.object_id == track.object_id]
        t_us = track.trajectory.start_us
        assert np.allclose(track.trajectory.transform(t_us), whole.trajectory.transform(t_us))


def test_selected_cameras_keep_the_order_of_the_log(tiny_log: SyntheticLog) -> None:
    names = tiny_log.rig.names
    part = select_from_log(tiny_log, LogSelection(cameras=(names[-1], names[0])))
    assert part.rig.names == ((names[0], names[-1]) if len(names) > 1 else names)
    assert set(part.image_times_us) <= set(part.rig.names)


def test_nested_selections_use_frame_numbers_of_the_whole_log(tiny_log: SyntheticLog) -> None:
    part = select_from_log(tiny_log, LogSelection(first=1))
    second = select_from_log(part, LogSelection(first=1, every=2))
    again = same_part(tiny_log, second.provenance)
    assert again.frame_times_us.tolist() == second.frame_times_us.tolist()
    assert again.provenance["selection"] == second.provenance["selection"]


def test_same_part_returns_the_log_itself_when_it_matches(tiny_log: SyntheticLog) -> None:
    part = select_from_log(tiny_log, LogSelection(first=1))
    assert same_part(part, part.provenance) is part
    assert same_part(tiny_log, tiny_log.provenance) is tiny_log


@pytest.mark.parametrize(
    ("selection", "reason"),
    [
        (LogSelection(first=3, stop=3), "frames 3:3 are not part"),
        (LogSelection(first=-1), "frames -1: are not part"),
        (LogSelection(stop=10_000), "which has frames 0:"),
        (LogSelection(every=0), "every is at least 1"),
        (LogSelection(cameras=("roof",)), "has cameras"),
        (LogSelection(cameras=()), "has cameras"),
    ],
)
def test_invalid_selections_are_refused(
    tiny_log: DrivingLog, selection: LogSelection, reason: str
) -> None:
    with pytest.raises(LogError, match=reason):
        select_from_log(tiny_log, selection)
