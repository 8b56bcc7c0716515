"""Planners that try to game the scores."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from real2sim_proto.plans import Control, PoseCommand, TrajectoryPlan
from real2sim_server.geometry import yaw_quaternion
from real2sim_server.scene import Trajectory

STEPS = 60
DT = 0.1
Pose = tuple[float, float, float]
Planner = Callable[[int], Pose]
SCORES = ("pdms", "nuplan_cls", "hugsim_hd", "neuroncap", "carla_ds", "alpasim")


@pytest.fixture(scope="module")
def pulling_away() -> Trajectory:
    """A drive that accelerates from rest at 2 m/s^2 to 10 m/s."""
    times = np.arange(121) * 100_000
    t = times * 1e-6
    positions = np.zeros((121, 3))
    positions[:, 0] = np.where(t < 5, t * t, 10 * t - 25)
    return Trajectory(times, positions, np.tile([1.0, 0.0, 0.0, 0.0], (121, 1)))


@pytest.fixture
def judged(make_world, pulling_away):
    """Run a pose planner: its scores and the final world."""

    def run(planner: Planner, **spec):
        world = make_world(pulling_away, spec={"action": "pose", "horizon": STEPS} | spec)
        for step in range(1, STEPS + 1):
            x, y, yaw = planner(step)
            world.step(PoseCommand(x=x, y=y, yaw=yaw))
        return {s.name: s for s in world.scores()}, world

    return run


def way(step: int) -> float:
    """Distance covered by the recorded drive [m]."""
    t = step * DT
    return t * t if t < 5 else 10 * t - 25


def honest(step: int) -> Pose:
    return way(step), 0.0, 0.0


def still(step: int) -> Pose:
    return 0.0, 0.0, 0.0


def hop(step: int) -> Pose:
    """Jump 1 m sideways every second step."""
    return way(step), float(step // 2 % 2), 0.0


def small_hop(step: int) -> Pose:
    return way(step), 0.2 * (step % 2), 0.0


def jump(step: int) -> Pose:
    """Stand still and cover the whole distance in the last step."""
    return (way(STEPS) if step == STEPS else 0.0), 0.0, 0.0


def teleport(step: int) -> Pose:
    """Follow the recording except for one step far away."""
    return (200.0, 50.0, 1.0) if step == 30 else honest(step)


def crab(step: int) -> Pose:
    """Slide sideways without turning."""
    return way(step), min(0.05 * step * step * DT, 1.5), 0.0


def spin(step: int) -> Pose:
    return 0.0, 0.0, 0.15 * step


def rush(step: int) -> Pose:
    """Accelerate at 15 m/s^2 from rest."""
    t = step * DT
    return min(7.5 * t * t, 15.0 * t), 0.0, 0.0


def backwards(step: int) -> Pose:
    t = step * DT
    return -min(t * t, 4 * t - 4) if t > 2 else -t * t, 0.0, 0.0


def backwards_at_full_speed(step: int) -> Pose:
    return way(step), 0.0, math.pi


def off_road(step: int) -> Pose:
    """Leave the road in a wide left turn."""
    s, radius = way(step), 40.0
    return radius * math.sin(s / radius), radius * (1 - math.cos(s / radius)), s / radius


def oscillating(step: int) -> Pose:
    """The recorded drive with a longitudinal oscillation of 0.3 m at 1 Hz."""
    return way(step) + 0.3 * math.sin(math.tau * step * DT) * min(step / 20, 1.0), 0.0, 0.0


def test_the_recorded_drive_gets_full_scores(judged):
    found, world = judged(honest)

    assert {n: found[n].value for n in SCORES} == pytest.approx(
        dict(zip(SCORES, (1.0, 1.0, 1.0, 5.0, 100.0, 1.0), strict=True)), rel=1e-3
    )
    assert world.metrics()["feasible"] == 1.0


@pytest.mark.parametrize(
    "planner", [hop, small_hop, jump, teleport, spin, crab, rush, backwards_at_full_speed]
)
def test_infeasible_motion_scores_zero(judged, planner):
    found, world = judged(planner)

    assert {n: found[n].value for n in SCORES} == dict.fromkeys(SCORES, 0.0)
    assert world.metrics()["feasible"] == found["feasible"].value == 0.0
    assert found["kinematic_infeasibility"].value == 1.0
    assert all(s.terms.get("feasible", 0.0) == 0.0 for s in found.values())
    assert found["feasible"].terms["infeasible_steps"] >= 1


def test_the_first_infeasible_step_is_reported(judged):
    found, _ = judged(jump)

    assert found["feasible"].terms == {"infeasible_steps": 1.0, "first_s": pytest.approx(6.0)}


@pytest.mark.parametrize("dt_us", [20_000, 50_000, 200_000, 500_000, 1_000_000])
def test_feasibility_does_not_depend_on_the_time_step(make_world, pulling_away, dt_us):
    steps = 6_000_000 // dt_us

    def drive(pose_at: Callable[[float], Pose]) -> float:
        spec = {"action": "pose", "dt_us": dt_us, "horizon": steps}
        world = make_world(pulling_away, spec=spec)
        for step in range(1, steps + 1):
            x, y, yaw = pose_at(step * dt_us * 1e-6)
            world.step(PoseCommand(x=x, y=y, yaw=yaw))
        return world.metrics()["feasible"]

    assert drive(lambda t: honest(t / DT)) == 1.0
    assert drive(lambda t: (way(STEPS) if t > 5.99 else 0.0, 0.0, 0.0)) == 0.0
    assert drive(lambda t: (way(t / DT), 4.0 * (t > 3.9), 0.0)) == 0.0


def test_standing_still_earns_no_progress(judged):
    found, _ = judged(still)

    # NAVSIM's formula gives 7/12 to a safe, comfortable drive without progress.
    values = {n: found[n].value for n in SCORES}
    expected = {"pdms": 7 / 12, "nuplan_cls": 0, "hugsim_hd": 0, "carla_ds": 0, "alpasim": 0}
    assert values == pytest.approx(expected | {"neuroncap": 5.0})
    assert "standing still while the recorded drive covers 35 m" in found["neuroncap"].cannot_see


def test_driving_backwards_scores_no_more_than_standing(judged):
    found, _ = judged(backwards)

    assert found["feasible"].value == 1.0
    assert found["pdms"].value <= 7 / 12 + 1e-9
    for name in ("nuplan_cls", "hugsim_hd", "carla_ds", "alpasim"):
        assert found[name].value == 0.0, name
    assert "against the route" in found["pdms"].cannot_see


def test_leaving_the_road_lowers_scores_that_see_the_road(judged):
    found, _ = judged(off_road)

    assert found["feasible"].value == 1.0
    for name in ("pdms", "nuplan_cls", "alpasim"):
        assert found[name].value == 0.0, name
    assert found["hugsim_hd"].value < 0.5
    assert found["carla_ds"].value < 50.0
    assert "leaving the road" in found["neuroncap"].cannot_see


def around(way: float, *, turn_at: float, radius: float = 12.0) -> Pose:
    """Drive along x, make a U-turn to the left and return."""
    if way < turn_at:
        return way, 0.0, 0.0
    if way < turn_at + math.pi * radius:
        angle = (way - turn_at) / radius
        return turn_at + radius * math.sin(angle), radius * (1 - math.cos(angle)), angle
    return turn_at - (way - turn_at - math.pi * radius), 2 * radius, math.pi


def test_a_short_cut_does_not_count_as_route_progress(make_world):
    times = np.arange(200) * 100_000
    out_and_back = np.array([around(0.8 * k, turn_at=60.0) for k in range(200)])
    places = np.column_stack([out_and_back[:, :2], np.zeros(200)])
    recorded = Trajectory(times, places, np.stack([yaw_quaternion(a) for a in out_and_back[:, 2]]))
    found = []
    for turn_at in (60.0, 8.0):
        world = make_world(recorded, spec={"action": "pose", "horizon": 60})
        for step in range(1, 61):
            x, y, yaw = around(0.8 * step, turn_at=turn_at)
            world.step(PoseCommand(x=x, y=y, yaw=yaw))
        found.append(({s.name: s for s in world.scores()}, world.metrics()))
    (whole, _), (cut, metrics) = found

    assert cut["feasible"].value == 1.0
    for name in ("hugsim_hd", "carla_ds"):
        assert cut[name].value < whole[name].value, name
    assert cut["carla_ds"].terms["RC"] < 1.0
    assert metrics["route_progress"] < 50.0
    assert "skipped by a shortcut" in cut["neuroncap"].cannot_see


def test_scores_are_missing_before_the_first_step(judged, make_world, pulling_away):
    world = make_world(pulling_away, spec={"action": "pose", "horizon": STEPS})

    scores = world.scores()
    assert [s.value for s in scores] == [None] * len(scores)
    assert {s.missing for s in scores} == {("a step that counts",)}


def test_scores_of_an_unfinished_episode_name_the_unseen_part(make_world, pulling_away, judged):
    world = make_world(pulling_away, spec={"action": "pose", "horizon": STEPS})
    for step in range(1, 11):
        x, y, yaw = honest(step)
        world.step(PoseCommand(x=x, y=y, yaw=yaw))
    early = {s.name: s.cannot_see for s in world.scores()}
    whole, _ = judged(honest)

    assert all("events after 1 s (the episode may last 6 s)" in said for said in early.values())
    assert not any("events after" in score.cannot_see for score in whole.values())
    assert "following closely" in whole["pdms"].cannot_see


def test_oscillation_lowers_comfort(judged):
    found, _ = judged(oscillating)
    quiet, _ = judged(honest)

    assert found["pdms"].terms["C"] == 0.0
    for name in ("pdms", "nuplan_cls", "hugsim_hd"):
        assert found[name].value < quiet[name].value - 0.05, name


def test_jumps_of_the_perfect_tracker_are_infeasible(make_world, pulling_away):
    world = make_world(pulling_away, spec={"horizon": STEPS, "ego": {"tracker": "perfect"}})
    for step in range(STEPS):
        poses = [hop(step + k) for k in range(1, 11)]
        times = [world.t_us + 100_000 * k for k in range(1, 11)]
        world.step(TrajectoryPlan(times_us=times, poses=poses, frame="world"))

    assert world.metrics()["feasible"] == 0.0
    assert {s.name: s.value for s in world.scores()}["epdms"] == 0.0


@pytest.mark.parametrize("dynamics", ["kinematic_bicycle", "dynamic_bicycle"])
def test_vehicle_models_drive_feasibly(make_world, moving, dynamics):
    spec = {"action": "control", "horizon": STEPS, "ego": {"dynamics": dynamics}}
    world = make_world(moving(speed=12.0), spec=spec)
    for step in range(STEPS):
        wild = (-8.0 if step % 20 < 5 else 4.0), 0.15 * math.sin(step / 4)
        world.step(Control(acceleration=wild[0], steering=wild[1]))

    assert world.metrics()["feasible"] == 1.0


def test_the_seam_of_a_loop_is_feasible(make_world):
    times = np.arange(121) * 100_000
    angle, radius = times * 1e-6 * 10.0 / 120.0, 120.0
    places = [radius * np.sin(angle), radius * (1 - np.cos(angle)), np.zeros(121)]
    headings = np.stack([yaw_quaternion(a) for a in angle])
    bend = Trajectory(times, np.stack(places, axis=1), headings)
    spec = {"action": "control", "beyond_log": "loop", "horizon": 300}
    world = make_world(bend, spec=spec)
    while not world.over:
        world.step(Control(acceleration=0.0, steering=math.atan(2.8 / radius)))

    assert world.lap >= 2
    assert world.metrics()["feasible"] == 1.0


def test_an_impact_is_feasible(make_world, moving):
    spec = {"action": "control", "horizon": STEPS, "on_collision": "continue"}
    world = make_world(moving(speed=15.0), car=moving(25, 0.6, z=0.8), spec=spec)
    for _ in range(STEPS):
        world.step(Control(acceleration=0.0, steering=0.0))

    assert world.metrics()["collisions"] >= 1
    assert world.metrics()["feasible"] == 1.0


def test_every_score_states_what_it_cannot_see(judged):
    found, _ = judged(honest)

    for name, score in found.items():
        assert score.cannot_see.startswith("Cannot see "), name
        assert score.cannot_see.endswith("."), name
        assert "uncounted" not in score.cannot_see, name
        assert "no map" in score.cannot_see, name
    assert "comfort" in found["neuroncap"].cannot_see
    assert "lane keeping" in found["pdms"].cannot_see


def test_planners_move_as_named():
    # The planners above move as intended.
    assert all(b[0] >= a[0] for a, b in pairwise(map(honest, range(STEPS))))
    assert backwards(STEPS)[0] < -10
    assert off_road(STEPS)[1] > 5
