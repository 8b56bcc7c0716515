"""Scores of episodes calculated by hand."""

from __future__ import annotations

import math
import sys
from dataclasses import replace

import numpy as np
import pytest

from real2sim_server.world import scoring
from real2sim_server.world.plan import PlannedTrajectory
from real2sim_server.world.scoring import (
    ContactRecord,
    Instant,
    ObjectSamples,
    ScoringContext,
)
from real2sim_server.world.scoring.comfort import comfort_sample, comfort_window
from real2sim_server.world.scoring.instant import side_of_contact

from .scored_drives import DT, NOBODY, car, context, drive, ego, scores


def hit(instants: list[Instant], step: int, **note) -> list[Instant]:
    fields = {
        "object_id": "car",
        "category": "car",
        "side": "front",
        "relative_speed": 10.0,
        "ego_speed": 10.0,
        "object_speed": 0.0,
    }
    contact = ContactRecord(**fields | note)
    return [replace(i, contacts=(contact,)) if i.step == step else i for i in instants]


# --- a drive without fault --------------------------------------------------------------------


def test_the_recorded_drive_gets_full_scores():
    found = scores(drive([10.0] * 41), context(40))
    assert found["pdms"].value == 1.0
    assert found["nuplan_cls"].value == 1.0
    assert found["hugsim_hd"].value == pytest.approx(1.0)
    assert found["neuroncap"].value == 5.0
    assert found["carla_ds"].value == pytest.approx(100.0)
    assert found["alpasim"].value == 1.0
    assert found["kinematic_infeasibility"].value == 0.0
    assert found["delta_v"].value == 0.0
    assert found["feasible"].value == 1.0


def test_the_metrics_version_lists_every_score():
    published = scoring.metrics_version().split()
    found = scores(drive([10.0] * 3), context(2))
    assert published == [f"{s.name}@{s.version}" for s in found.values()]


# --- progress ---------------------------------------------------------------------------------


def test_half_the_distance_is_half_the_progress():
    # 20 of 40 m: PDMS (5/2 + 5 + 2)/12, CLS (5/2 + 5 + 4 + 2)/16, HD route 20/36.
    found = scores(drive([5.0] * 41), context(40))
    assert found["pdms"].value == pytest.approx(9.5 / 12)
    assert found["nuplan_cls"].value == pytest.approx(13.5 / 16)
    assert found["hugsim_hd"].value == pytest.approx(20 / 36)
    assert found["carla_ds"].value == pytest.approx(50.0)
    assert found["alpasim"].value == pytest.approx(0.5 / 0.8)


def test_nuplan_gives_zero_without_progress():
    # 4 of 40 m is less than a fifth.
    assert scores(drive([1.0] * 41), context(40))["nuplan_cls"].value == 0.0


def slow(speed: float) -> ScoringContext:
    """A context whose recorded drive has another speed [m/s]."""
    way = tuple(speed * DT * k for k in range(41))
    return context(40, expert_s=way, route_end_s=way[-1])


def test_a_short_recorded_drive_is_scored_and_noted():
    found = scores(drive([0.0] * 41), slow(1.0))
    assert found["pdms"].terms["EP"] == found["alpasim"].value == found["carla_ds"].value == 0.0
    for name in ("pdms", "alpasim"):
        assert "the recorded drive is short (4.0 m)" in " ".join(found[name].assumed)


def test_standing_is_perfect_when_the_recorded_ego_stands():
    found = scores(drive([0.0] * 41), slow(0.1))
    assert found["pdms"].value == found["alpasim"].value == 1.0
    for name in ("pdms", "nuplan_cls", "hugsim_hd", "carla_ds", "alpasim"):
        assert "the recorded ego does not move" in " ".join(found[name].assumed), name
        assert "progress (the recorded ego does not move)" in found[name].cannot_see


# --- the warm-up ------------------------------------------------------------------------------


def test_warm_up_steps_do_not_count():
    # 20 of 40 steps are warm-up, with a hit and a hard stop.
    speeds = [10.0] * 10 + [0.0] * 11 + [10.0] * 20
    rough = hit(drive(speeds), 15)
    found = scores(rough, context(40, warmup_steps=20))
    assert found["pdms"].terms["NC"] == 1.0
    assert found["carla_ds"].terms["vehicle"] == 0.0
    assert found["neuroncap"].missing == ()
    assert found["kinematic_infeasibility"].value == 1.0  # from 0 to 10 m/s at its end
    smooth = scores(hit(drive([10.0] * 41), 15), context(40, warmup_steps=20))
    assert {n: smooth[n].value for n in ("pdms", "nuplan_cls", "alpasim", "feasible")} == {
        "pdms": 1.0,
        "nuplan_cls": 1.0,
        "alpasim": 1.0,
        "feasible": 1.0,
    }
    assert smooth["carla_ds"].value == pytest.approx(100.0)


def test_progress_is_measured_from_the_end_of_the_warm_up():
    # The last 20 steps slow to 5 m/s; the recorded drive covers 20 m in that time.
    speeds = [10.0] * 21 + [9.0, 8.0, 7.0, 6.0] + [5.0] * 16
    found = scores(drive(speeds), context(40, warmup_steps=20))
    assert found["pdms"].terms["EP"] == pytest.approx(sum(speeds[21:]) * DT / 20.0)
    assert found["carla_ds"].terms["RC"] == pytest.approx(sum(speeds[21:]) * DT / 20.0)


def test_the_speeding_penalty_grows_with_the_excess():
    # 3 m/s too fast all the time: 1 - 3/2.23 is below 0; 1 m/s: 1 - 1/2.23.
    assert scores(drive([10.0] * 41), context(40, speed_limit=7.0))["nuplan_cls"].terms["SL"] == 0.0
    limited = scores(drive([10.0] * 41), context(40, speed_limit=9.0))["nuplan_cls"]
    assert limited.terms["SL"] == pytest.approx(1 - 1 / 2.23)
    assert limited.value == pytest.approx((5 + 5 + 4 * (1 - 1 / 2.23) + 2) / 16)


# --- collisions and fault ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("category", "nc", "carla"),
    [("car", 0.0, 60.0), ("pedestrian", 0.0, 50.0), ("pole", 0.5, 65.0)],
)
def test_the_collision_penalty_depends_on_the_category(category, nc, carla):
    found = scores(hit(drive([10.0] * 41), 20, category=category), context(40))
    assert found["pdms"].terms["NC"] == nc
    assert found["pdms"].value == pytest.approx(nc)
    assert found["nuplan_cls"].terms["NC"] == nc
    assert found["carla_ds"].value == pytest.approx(carla)


@pytest.mark.parametrize("side", ["rear", "stopped_ego", "lateral"])
def test_being_hit_in_its_lane_is_not_the_egos_fault(side):
    found = scores(hit(drive([10.0] * 41), 20, side=side), context(40))
    assert found["pdms"].value == 1.0
    assert found["carla_ds"].value == pytest.approx(60.0)
    assert found["neuroncap"].value is None


def test_a_lateral_hit_across_the_lane_line_is_the_egos_fault():
    # 0.925 + 0.9 m reach out of a lane of 1.75 m.
    found = scores(hit(drive([10.0] * 41, y=0.9), 20, side="lateral"), context(40))
    assert found["pdms"].value == 0.0


@pytest.mark.parametrize(("since", "nc"), [(0.1, 1.0), (0.9, 0.0)])
def test_fault_is_judged_at_the_time_of_contact(since, nc):
    # The ego crosses the lane line within one step, at an offset of 0.825 m.
    instants = drive([10.0] * 41)
    shifted = [replace(i, ego=i.ego._replace(y=1.5, offset=1.5)) for i in instants[20:]]
    changing = hit([*instants[:20], *shifted], 20, side="lateral", since=since)
    assert scores(changing, context(40))["pdms"].terms["NC"] == nc


def test_repeated_contacts_with_an_object_count_once():
    twice = hit(hit(drive([10.0] * 41), 20, category="pole"), 30, category="pole")
    found = scores(twice, context(40))
    assert found["nuplan_cls"].terms["NC"] == 0.5
    assert found["delta_v"].terms["secondary_collisions"] == 1.0


def test_neuroncap_is_relative_to_the_no_action_impact():
    instants = hit(drive([10.0] * 41), 20, relative_speed=4.0)
    found = scores(instants, context(40, no_action_impact=10.0))["neuroncap"]
    assert found.value == pytest.approx(4 * (1 - 0.4))
    assert scores(instants, context(40, no_action_impact=3.0))["neuroncap"].value == 0.0


def test_hugsim_gives_zero_for_steps_in_contact():
    found = scores(hit(drive([10.0] * 41), 20), context(40))
    assert found["hugsim_hd"].terms["mean"] == pytest.approx(39 / 40)


def test_delta_v_sums_the_impulses_of_an_impact():
    # 4 m/s in one step, 1 m/s in the next: 7500 N s on 1500 kg.
    instants = drive([10.0] * 20 + [6.0] + [5.0] * 20)
    instants = hit(instants, 20, impulse=(-6000.0, 0.0))
    instants = hit(instants, 21, impulse=(-1500.0, 0.0), begun=False)
    found = scores(instants, context(40))["delta_v"]
    assert found.value == pytest.approx(5.0)
    assert found.terms["impulse"] == pytest.approx(7500.0)
    assert found.terms["post_impact_displacement"] == pytest.approx(9.5 + 0.5)


def test_engine_thrust_against_a_wall_does_not_add_to_delta_v():
    instants = hit(drive([10.0] * 20 + [0.0] * 21), 20, impulse=(-15_000.0, 0.0))
    for step in range(21, 41):
        instants = hit(instants, step, impulse=(-600.0, 0.0), begun=False)
    assert scores(instants, context(40))["delta_v"].value == pytest.approx(10.4)


HERE = (0.0, 0.0, 0.0, 4.6, 1.85)


@pytest.mark.parametrize(
    ("box", "ego_speed", "speed", "side"),
    [
        ((4.2, 0.0, 0.0, 4.0, 2.0), 10.0, 3.0, "front"),
        ((4.2, 0.0, 0.0, 4.0, 2.0), 10.0, 0.0, "stopped_track"),
        ((4.2, 0.0, 0.0, 4.0, 2.0), 0.0, 3.0, "stopped_ego"),
        ((-4.2, 0.0, 0.0, 4.0, 2.0), 5.0, 9.0, "rear"),
        ((-0.5, 1.9, 0.0, 3.0, 2.0), 10.0, 9.0, "lateral"),
        ((3.4, 2.0, 1.57, 4.0, 2.4), 10.0, 9.0, "front"),
    ],
)
def test_contact_sides_match_nuplan(box, ego_speed, speed, side):
    assert side_of_contact(HERE, ego_speed, box, speed, axle=1.35) == side


def test_contact_sides_match_navsim_for_random_overlaps():
    # NAVSIM measures the bearing from the rear axle, not the centre, and uses full speeds.
    rng = np.random.default_rng(5)
    bumper = np.stack([np.full(4001, 2.3), np.linspace(-0.925, 0.925, 4001)], 1)
    behind_middle = 0
    for _ in range(3000):
        x, y, yaw = rng.uniform(-4.5, 4.5), rng.uniform(-2.5, 2.5), rng.uniform(-3.2, 3.2)
        box = (x, y, yaw, *rng.uniform((3.0, 1.4), (6.0, 2.2)))
        bearing = abs(math.atan2(y, x + 1.35))
        cos, sin = math.cos(yaw), math.sin(yaw)
        local = (bumper - [x, y]) @ np.array([[cos, -sin], [sin, cos]])
        depth = (np.array(box[3:]) / 2 - np.abs(local)).min(axis=1).max()
        if abs(bearing - math.radians(150)) < 1e-6 or abs(depth) < 1e-3:
            continue
        rear = bearing > math.radians(150)
        expected = "rear" if rear else "front" if depth > 0 else "lateral"
        behind_middle += rear != (abs(math.atan2(y, x)) > math.radians(150))
        assert side_of_contact(HERE, 8.0, box, 6.0, axle=1.35) == expected
    assert behind_middle > 50


# --- time to collision ------------------------------------------------------------------------


def ttc_of(others: ObjectSamples, *, y: float = 0.0, speed: float = 10.0) -> float:
    instants = drive([speed] * 2, y=y, others=lambda _k: others)
    accumulator = scoring.update_accumulator(
        scoring.begin_accumulator(instants[0], context(2)), instants[1], context(2)
    )
    return accumulator.ttc


def test_time_to_collision_is_gap_over_closing_speed():
    # Front bumper at 1 + 3.65 m, rear end at 30 - 2 m: 23.35 m at 10 m/s, and at 4 m/s.
    assert ttc_of(car(30.0)) == pytest.approx(2.4)
    assert ttc_of(car(18.0, speed=6.0)) == pytest.approx(2.9)


@pytest.mark.parametrize(
    "others",
    [car(30.0, speed=10.0), car(-8.0, speed=30.0), car(30.0, 3.0), car(60.0)],
    ids=["as fast", "behind", "beside", "far"],
)
def test_time_to_collision_is_infinite_without_a_collision(others):
    assert ttc_of(others) == math.inf


def test_a_standing_ego_has_no_time_to_collision():
    assert ttc_of(car(8.0, speed=-5.0), speed=0.0) == math.inf


def test_a_reversing_ego_has_time_to_collision_with_cars_behind():
    # Its tail at -0.4 - 0.95 m, the car's front at -8 + 2 m: 4.65 m at 4 m/s.
    assert ttc_of(car(-8.0), speed=-4.0) == pytest.approx(1.2)
    assert ttc_of(car(8.0), speed=-4.0) == math.inf


def test_a_reversing_ego_hits_cars_behind_with_its_front_side():
    box = (-4.0, 0.0, 0.0, 4.0, 2.0)
    assert side_of_contact(HERE, 3.0, box, 1.0, axle=1.35) == "rear"
    assert side_of_contact(HERE, 3.0, box, 1.0, axle=1.35, reversing=True) == "front"


@pytest.mark.parametrize(("facing", "progress"), [(0.0, 1.0), (math.pi, 0.0)])
def test_driving_tail_first_is_not_progress(facing, progress):
    given = context(40, expert_s=tuple(0.4 * k for k in range(41)), route_end_s=16.0)
    speed = math.copysign(4.0, math.cos(facing))
    instants = [
        Instant(k, k * 100_000, ego(0.4 * k, speed=speed, yaw=facing), NOBODY) for k in range(41)
    ]
    found = scores(instants, given)

    assert found["feasible"].value == 1.0
    assert found["pdms"].terms["EP"] == pytest.approx(progress)
    assert found["pdms"].value <= (7 + 5 * progress) / 12 + 1e-9
    for name in ("nuplan_cls", "hugsim_hd", "carla_ds", "alpasim"):
        assert (found[name].value > 0) == bool(progress), name
    assert ("16 m of the route driven in reverse" in found["neuroncap"].cannot_see) == bool(facing)


def test_a_short_time_to_collision_costs_the_ttc_term():
    # A car 0.8 s ahead, for one step.
    near = drive([10.0] * 41, others=lambda k: car(14.0 + k) if k == 20 else NOBODY)
    moved = [
        replace(i, others=car(i.ego.x + 3.65 + 2.0 + 7.5)) if i.step == 20 else i for i in near
    ]
    found = scores(moved, context(40))
    assert found["pdms"].value == pytest.approx(7 / 12)
    assert found["nuplan_cls"].value == pytest.approx(11 / 16)
    assert found["hugsim_hd"].terms["mean"] == pytest.approx((39 + 2 / 7) / 40)


# --- the road ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("y", "dac", "nuplan_dac"), [(2.5, 1.0, 1.0), (2.7, 0.0, 1.0), (2.95, 0.0, 0.0)]
)
def test_a_corner_outside_the_corridor_is_off_road(y, dac, nuplan_dac):
    # A corner is 0.925 m beside the ego; the corridor ends at 3.5 m, nuPlan tolerates 0.3 m.
    found = scores(drive([10.0] * 41, y=y), context(40))
    assert found["pdms"].terms["DAC"] == dac
    assert found["nuplan_cls"].terms["DAC"] == nuplan_dac


def test_recorded_lanes_of_others_are_drivable():
    lane = np.stack([np.arange(0.0, 100.0), np.full(100, 3.5)], axis=1)
    found = scores(drive([10.0] * 41, y=3.5), context(40, lanes=(lane,)))
    assert found["pdms"].terms["DAC"] == 1.0


@pytest.mark.parametrize(("speed", "ddc"), [(-1.5, 1.0), (-4.0, 0.5), (-7.0, 0.0)])
def test_driving_against_the_route_counts_by_distance_per_second(speed, ddc):
    instants = [
        replace(i, ego=ego(100.0 + speed * DT * i.step, speed=speed)) for i in drive([0.0] * 41)
    ]
    assert scores(instants, context(40))["nuplan_cls"].terms["DDC"] == ddc


# --- comfort ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("acceleration", "comfortable"), [(2.3, True), (2.5, False), (-4.0, True), (-4.2, False)]
)
def test_longitudinal_bounds_hold_for_steady_acceleration(acceleration, comfortable):
    speeds = [20.0 + acceleration * DT * k for k in range(31)]
    found = scores(drive(speeds), context(30))
    assert found["pdms"].terms["C"] == float(comfortable)


@pytest.mark.parametrize(
    ("acceleration", "comfortable"), [(-2.3, True), (-2.5, False), (4.0, True), (4.2, False)]
)
def test_longitudinal_bounds_are_mirrored_in_reverse(acceleration, comfortable):
    window = comfort_window(DT)
    t = (np.arange(window) - window // 2) * DT
    felt = comfort_sample(np.stack([-8.0 + acceleration * t, 0 * t], axis=1), DT)
    assert felt.lon_acceleration == pytest.approx(-acceleration)
    assert felt.comfortable == felt.comfortable_to_hugsim == comfortable


def test_derivatives_are_exact_for_cubics():
    window = comfort_window(DT)
    t = (np.arange(window) - window // 2) * DT
    speed, yaw = 8.0 + 0.5 * t + 0.2 * t**2, 0.3 * t + 0.1 * t**2 + 0.05 * t**3
    felt = comfort_sample(np.stack([speed, yaw], axis=1), DT)
    assert felt.lon_acceleration == pytest.approx(0.5)
    assert felt.lon_jerk == pytest.approx(0.4)
    assert felt.yaw_rate == pytest.approx(0.3)
    assert felt.yaw_acceleration == pytest.approx(0.2)
    assert felt.lat_acceleration == pytest.approx(8.0 * 0.3)
    assert felt.jerk == pytest.approx(math.hypot(0.4, 0.5 * 0.3 + 8.0 * 0.2))


def test_comfort_does_not_import_scipy_signal(monkeypatch):
    # Importing the module during a step would take a second.
    monkeypatch.setitem(sys.modules, "scipy.signal", None)
    samples = np.stack([np.linspace(5.0, 6.0, 17), np.zeros(17)], axis=1)
    assert comfort_sample(samples, 0.087).lon_acceleration == pytest.approx(1 / 16 / 0.087)


def test_hugsim_comfort_recovers_and_has_its_own_bounds():
    # A longitudinal jerk of 6 m/s^3 exceeds nuPlan's 4.13, but not HUGSIM's 8.37.
    t = DT * np.arange(16)
    rough = [10.0] * 20 + (10.0 + 3.0 * t**2)[:8].tolist() + [11.5] * 33
    hasty = scores(drive(rough), context(60))
    assert hasty["pdms"].terms["C"] == 0.0
    braked = scores(drive([10.0] * 20 + [9.1, 8.2, 7.3, 6.4, 5.5] + [5.5] * 36), context(60))
    assert braked["pdms"].terms["C"] == 0.0
    # Only steps whose window contains the braking lose 2/7.
    lost = (1.0 - braked["hugsim_hd"].terms["mean"]) * 60 / (2 / 7)
    assert 5 <= round(lost) <= 20
    assert lost == pytest.approx(round(lost), abs=1e-6)


def test_driving_beside_the_route_gives_no_route_completion():
    beside = scores(drive([10.0] * 41, y=2.9), context(40))
    assert beside["carla_ds"].value == 0.0
    assert beside["carla_ds"].terms["in_lanes"] == 0.0
    assert "40 m off all driven lanes" in beside["hugsim_hd"].cannot_see


@pytest.mark.parametrize(("turn", "share"), [(1, 1.0), (-1, 0.0)])
def test_lanes_driven_by_others_count_in_their_direction(turn, share):
    lane = np.stack([np.arange(0.0, 100.0)[::turn], np.full(100, 3.0)], axis=1)
    found = scores(drive([10.0] * 41, y=2.9), context(40, lanes=(lane,)))["carla_ds"]
    assert found.terms["in_lanes"] == pytest.approx(share)


def test_an_impossible_deceleration_is_infeasible():
    found = scores(drive([10.0] * 10 + [8.0] * 10), context(19))
    assert found["kinematic_infeasibility"].value == 1.0


# --- EPDMS ------------------------------------------------------------------------------------


def with_plans(instants: list[Instant], speed_of) -> list[Instant]:
    planned = []
    for i in instants:
        ahead = np.arange(1, 21)
        times = i.t_us + 100_000 * ahead
        poses = np.zeros((20, 3))
        poses[:, 0] = i.ego.x + speed_of(i.step) * DT * ahead
        planned.append(replace(i, plan=PlannedTrajectory(times, poses)))
    return planned


def test_epdms_needs_successive_plans():
    found = scores(drive([10.0] * 41), context(40))["epdms"]
    assert found.value is None
    assert found.missing


def test_epdms_is_1_for_a_faultless_drive():
    steady = with_plans(drive([10.0] * 41), lambda _k: 10.0)
    assert scores(steady, context(40))["epdms"].value == pytest.approx(1.0)


def test_inconsistent_plans_lose_extended_comfort():
    def braking(step: int) -> float:
        return 10.0

    instants = with_plans(drive([10.0] * 41), braking)
    plan = instants[20].plan
    poses = plan.poses.copy()
    t = DT * np.arange(1, 21)
    poses[:, 0] = instants[20].ego.x + 10.0 * t - 1.5 * t * t
    instants[20] = replace(instants[20], plan=replace(plan, poses=poses))
    found = scores(instants, context(40))["epdms"]
    assert found.terms["EC"] == 0.0
    assert found.value == pytest.approx(14 / 16)


def test_two_seconds_off_the_lane_centre_lose_lane_keeping():
    short = with_plans(drive([10.0] * 20, y=0.6), lambda _k: 10.0)
    assert scores(short, context(19))["epdms"].terms["LK"] == 1.0
    long = with_plans(drive([10.0] * 22, y=0.6), lambda _k: 10.0)
    assert scores(long, context(21))["epdms"].terms["LK"] == 0.0
