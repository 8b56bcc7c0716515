"""The recovery bench: start poses, success criterion, and equal numbers of training frames."""

from __future__ import annotations

import numpy as np
import pytest

from real2sim.planners import FollowRoute
from real2sim.planners.learned import PolicyShape
from real2sim_bench import recovery
from real2sim_proto.plans import TrajectoryPlan
from real2sim_server.datasets.drive import ScenarioDrive
from real2sim_server.datasets.plan import Variant, planned_shards
from real2sim_server.edit import ScenarioState

OPTIONS = recovery.RecoveryBenchOptions(
    episodes=2, seconds=1.0, plan_s=0.0, lateral=0.2, heading=0.02
)


class Straight:
    """Continues straight in its initial direction."""

    def reset(self, obs) -> None:
        """Has no state."""

    def plan(self, obs) -> TrajectoryPlan:
        delays = np.arange(1, 7) * 0.5
        poses = [(float(obs.ego.speed * delay), 0.0, 0.0) for delay in delays]
        times = [obs.t_us + round(delay * 1e6) for delay in delays]
        return TrajectoryPlan(times_us=times, poses=poses)


def test_a_planner_that_follows_the_route_recovers(tiny_scene):
    ends = recovery.drive_all(tiny_scene, [FollowRoute(speed=5.0) for _ in range(4)], OPTIONS)
    assert [end.success for end in ends] == [True] * 4


def test_a_planner_that_drives_straight_does_not_recover(tiny_scene):
    options = recovery.RecoveryBenchOptions(
        seconds=1.0, plan_s=0.0, lateral=2.0, heading=0.01, seed=1
    )
    ends = recovery.drive_all(tiny_scene, [Straight() for _ in range(4)], options)
    assert not any(end.success for end in ends)
    assert min(abs(end.offset) for end in ends) > recovery.OFFSET_M


def test_results_are_deterministic(tiny_scene):
    one, two = (recovery.drive_all(tiny_scene, [Straight(), Straight()], OPTIONS) for _ in range(2))
    assert one == two


def test_starts_are_displaced_and_turned_within_limits(tiny_scene):
    worlds = recovery.displaced_worlds(tiny_scene, 3, OPTIONS)
    assert all(0.15 <= abs(world.sampled["start.lateral"]) <= 0.2 for world in worlds)
    assert all(0.015 <= abs(world.sampled["start.heading"]) <= 0.02 for world in worlds)


def test_both_data_sets_have_the_same_number_of_frames(tiny_scene):
    plans = recovery._plans(PolicyShape(camera="front"), OPTIONS)
    drive = ScenarioDrive(tiny_scene, ScenarioState.of(tiny_scene))
    frames = {
        name: sum(len(clip.times_us) for clip in planned_shards([Variant(drive)], plan))
        for name, plan in plans.items()
    }
    assert frames["path"] + frames["beside"] == pytest.approx(frames["dense"], abs=5)


@pytest.mark.slow
def test_recovery_data_increases_the_success_from_displaced_starts():
    figures = recovery.run()
    assert figures["gain"] >= 0.15
    assert figures["given the route"]["success"] > 0.9
