from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from real2sim_server.edit import PackedTracks
from real2sim_server.edit.tracks import sample


@settings(deadline=None)
@given(t_us=st.integers(-200_000, 5_200_000))
def test_a_joint_lookup_agrees_with_each_trajectory(state, t_us):
    placed = state.tracks.at(t_us)

    covering = [o for o in state.visible if o.trajectory.covers(t_us)]
    assert list(placed.objects) == covering
    for k, subject in enumerate(covering):
        position, quaternion = subject.trajectory.pose(t_us)
        np.testing.assert_allclose(placed.positions[k], position, atol=1e-12)
        np.testing.assert_allclose(placed.quaternions[k], quaternion, atol=1e-12)
        np.testing.assert_allclose(placed.velocities[k], subject.trajectory.velocity(t_us))
        np.testing.assert_allclose(
            placed.transforms[k], subject.trajectory.transform(t_us), atol=1e-12
        )


@pytest.mark.parametrize("t_us", [0, 2_000_000, 3_900_000, 4_900_000])
def test_poses_at_timestamps_are_exactly_the_recorded_ones(state, t_us):
    placed = state.tracks.at(t_us)

    for k, subject in enumerate(placed.objects):
        position, quaternion = subject.trajectory.pose(t_us)
        assert placed.positions[k].tobytes() == position.tobytes()
        assert placed.quaternions[k].tobytes() == quaternion.tobytes()


def test_no_objects_give_no_poses():
    placed = PackedTracks(()).at(0)

    assert placed.objects == ()
    assert placed.transforms.shape == (0, 4, 4)


def test_sampling_agrees_with_single_lookups(state):
    trajectory = state.objects["late"].trajectory
    times = np.arange(0, 5_000_000, 70_000)
    transforms, covered = sample(trajectory, times)

    for t_us, transform, known in zip(times.tolist(), transforms, covered, strict=True):
        assert known == trajectory.covers(t_us)
        if known:
            np.testing.assert_allclose(transform, trajectory.transform(t_us), atol=1e-12)
