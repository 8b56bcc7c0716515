"""Drivers of other road users: the common contract and each driver's behaviour."""

from __future__ import annotations

import math

import numpy as np
import pytest

from real2sim_proto import ErrorCode
from real2sim_proto.operations import Delete, Translate
from real2sim_proto.plans import Control, PoseCommand
from real2sim_server.world import WorldError

COAST = Control(acceleration=0.0, steering=0.0)
CONTROL = {"action": "control", "privileged": True}

KINDS = [
    "log",
    "constant_velocity",
    "idm",
    "cut_in",
    "hard_brake",
    "junction_crossing",
    "external",
]


def agent_of(world, object_id: str = "car") -> dict:
    found = {a["object_id"]: a for a in world.observe().obs_fields()["agents"]}
    return found[object_id]


@pytest.fixture
def driven(make_world, moving):
    """Make a world with a driver of a kind for ``car``, 30 m ahead at 6 m/s."""

    def make(kind: str, *, spec: dict | None = None, car=None, **fields):
        agents = {"drivers": {"car": {"kind": kind, **fields}}}
        car = car or moving(30, 0, z=0.8, speed=6.0)
        return make_world(car=car, spec=CONTROL | {"agents": agents} | (spec or {}))

    return make


# --- the common contract ----------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_velocity_matches_the_displacement(driven, kind):
    world = driven(kind, spec={"on_collision": "continue"})
    before = agent_of(world)["position"]
    for _ in range(12):
        world.step(COAST)
        now = agent_of(world)
        moved = np.subtract(now["position"], before)[:2] / 0.1
        np.testing.assert_allclose(now["velocity"][:2], moved, atol=0.8)
        before = now["position"]


@pytest.mark.parametrize("kind", KINDS)
def test_quaternions_are_unit_and_boxes_keep_their_size(driven, kind):
    world = driven(kind)
    for _ in range(10):
        world.step(COAST)
        now = agent_of(world)
        assert math.hypot(*now["quaternion"]) == pytest.approx(1.0)
        assert now["size"] == pytest.approx([4.0, 2.0, 1.6])


@pytest.mark.parametrize("kind", KINDS)
def test_a_fork_evolves_identically_and_independently(driven, kind):
    world = driven(kind)
    for _ in range(3):
        world.step(COAST)
    copied = world.fork()
    for _ in range(10):
        world.step(COAST)
    for _ in range(10):
        copied.step(COAST)
    assert agent_of(copied) == agent_of(world)


@pytest.mark.parametrize("kind", KINDS)
def test_driven_objects_can_be_deleted(driven, kind):
    world = driven(kind)
    world.step(COAST)
    world.apply([Delete(object_id="car")])
    world.step(COAST)
    assert world.observe().obs_fields()["agents"] == []


@pytest.mark.parametrize("kind", KINDS)
def test_a_driver_restarts_from_an_edited_trajectory(driven, kind):
    if kind in {"cut_in", "junction_crossing"}:
        pytest.skip("these take their places from the ego's route")
    world = driven(kind)
    world.step(COAST)
    before = agent_of(world)["position"][1]
    world.apply([Translate(object_id="car", y=2.5)])
    assert agent_of(world)["position"][1] - before == pytest.approx(2.5, abs=0.05)


def test_a_driver_of_an_unknown_object_is_refused(make_world, moving):
    with pytest.raises(WorldError, match="'ghost', which is not an object") as refused:
        make_world(car=moving(30, 5), spec={"agents": {"drivers": {"ghost": {"kind": "idm"}}}})
    assert refused.value.code == ErrorCode.UNKNOWN_OBJECT


# --- constant velocity, IDM -------------------------------------------------------------------


def test_constant_velocity_drives_straight(make_world, moving):
    car = moving(20, 8, z=0.8, speed=4.0, yaw=0.3)
    agents = {"default": "constant_velocity"}
    world = make_world(car=car, spec=CONTROL | {"agents": agents})
    for _ in range(20):
        world.step(COAST)
    x, y, _ = agent_of(world)["position"]
    assert (x, y) == pytest.approx((20 + 8 * math.cos(0.3), 8 + 8 * math.sin(0.3)))


def test_idm_reaches_its_desired_speed_on_a_free_road(make_world, moving):
    agents = {"drivers": {"car": {"kind": "idm", "desired_speed": 12.0}}}
    car = moving(30, 20, z=0.8, speed=6.0)
    world = make_world(moving(speed=1.0), car=car, spec=CONTROL | {"agents": agents})
    speeds = []
    for _ in range(100):
        world.step(COAST)
        if (found := world.observe().obs_fields()["agents"]) == []:
            break
        speeds.append(found[0]["velocity"][0])
    assert max(speeds) == pytest.approx(12.0, abs=1.0)
    assert max(speeds) <= 12.0 + 1e-6
    assert max(np.diff(speeds)) <= 0.15 + 1e-6


def test_idm_with_zero_desired_speed_stops(make_world, moving):
    agents = {"drivers": {"car": {"kind": "idm", "desired_speed": 0.0}}}
    world = make_world(car=moving(30, 20, z=0.8, speed=6.0), spec=CONTROL | {"agents": agents})
    for _ in range(40):
        world.step(COAST)
    assert agent_of(world)["velocity"][0] == pytest.approx(0.0, abs=0.1)


def test_idm_follows_at_the_equilibrium_gap(make_world, moving):
    # s_e = (s0 + v T) / sqrt(1 - (v/v0)^4) (Treiber et al. 2000, eq. 4).
    agents = {"drivers": {"car": {"kind": "idm", "desired_speed": 15.0}}}
    car = moving(-25, 0, z=0.8, speed=8.0)
    spec = {"agents": agents, "privileged": True, "horizon": 90}
    world = make_world(moving(speed=8.0), car=car, spec=spec)
    while not world.over:
        world.step()
    rear = world.motion.x - 0.95
    gap = rear - agent_of(world)["position"][0] - 2.0
    expected = (2.0 + 8.0 * 1.5) / math.sqrt(1 - (8 / 15) ** 4)
    assert gap == pytest.approx(expected, rel=0.1)


def test_idm_stops_behind_a_stopped_ego(make_world, moving):
    agents = {"default": "idm"}
    world = make_world(
        moving(speed=10.0), car=moving(-20, 0, z=0.8, speed=10.0), spec=CONTROL | {"agents": agents}
    )
    while not world.over:
        world.step(Control(acceleration=-5.0, steering=0.0))
    gap = world.motion.x - 0.95 - agent_of(world)["position"][0] - 2.0
    assert world.reason == "horizon"
    assert 1.0 < gap < 4.0


def test_replayed_traffic_runs_into_an_ego_that_stops(make_world, moving):
    world = make_world(car=moving(-20, 0, z=0.8, speed=10.0), spec=CONTROL)
    while not world.over:
        world.step(Control(acceleration=-5.0, steering=0.0))
    assert world.reason == "collision"
    assert world.accumulator.at_fault == {}


def test_replayed_traffic_can_react_once_the_ego_leaves_the_log(make_world, moving):
    agents = {"ego_off_log": "idm", "off_log_distance": 2.0}
    world = make_world(car=moving(-25, 0, z=0.8, speed=10.0), spec=CONTROL | {"agents": agents})
    events = []
    while not world.over:
        events += world.step(Control(acceleration=-4.0, steering=0.0))
    assert world.reason == "horizon"
    assert [e.type for e in events].count("agents_react") == 1


# --- adversaries ------------------------------------------------------------------------------


def test_a_cut_in_ends_ahead_in_the_egos_lane(driven):
    world = driven("cut_in", gap=8.0, speed_change=0.0)
    assert agent_of(world)["position"][1] == pytest.approx(3.5)
    for _ in range(40):
        world.step(COAST)
    x, y, _ = agent_of(world)["position"]
    assert y == pytest.approx(0.0, abs=0.01)
    assert x - 2.0 - (world.motion.x + 3.65) == pytest.approx(8.0, abs=1.0)


def lamps_of(world, object_id: str = "car") -> list:
    return list(agent_of(world, object_id).get("lamps", ()))


def test_brake_lamps_are_lit_while_a_driver_brakes_and_stands(driven):
    world = driven("hard_brake", gap=25.0, delay=0.5, spec={"on_collision": "continue"})
    lit = [lamps_of(world)]
    for _ in range(20):
        world.step(Control(acceleration=-8.0, steering=0.0))
        lit.append(lamps_of(world))
    assert lit == [[]] * 6 + [["brake"]] * 15


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_indicator_flashes_during_a_cut_in(driven, side):
    world = driven("cut_in", gap=8.0, offset=3.5 * side, speed_change=0.0, duration=2.0)
    lit = []
    for _ in range(60):
        world.step(COAST)
        lit.append([lamp for lamp in lamps_of(world) if lamp != "brake"])
    lamp = ["indicator_right" if side > 0 else "indicator_left"]
    first = lit.index(lamp)
    # It lasts 2 s, twice 0.5 s lit and 0.5 s dark.
    assert lit[first : first + 19] == [lamp] * 4 + [[]] * 5 + [lamp] * 5 + [[]] * 5
    assert not any(lit[first + 19 :])


def test_an_ego_that_does_not_brake_hits_a_braking_cut_in(driven):
    world = driven("cut_in", gap=4.0, speed_change=-6.0)
    while not world.over:
        world.step(COAST)
    assert world.reason == "collision"


def test_a_hard_brake_stops_in_front_of_the_ego(driven):
    world = driven("hard_brake", gap=25.0, delay=0.5, spec={"on_collision": "continue"})
    speeds = []
    for _ in range(20):
        world.step(Control(acceleration=-8.0, steering=0.0))
        speeds.append(math.hypot(*agent_of(world)["velocity"][:2]))
    assert min(np.diff(speeds)) == pytest.approx(-0.7, abs=0.01)
    assert speeds[-1] == 0.0


def test_a_hard_brake_needs_the_ego_near(driven):
    world = driven("hard_brake", gap=5.0, spec={"horizon": 20})
    while not world.over:
        world.step(Control(acceleration=-8.0, steering=0.0))
    assert math.hypot(*agent_of(world)["velocity"][:2]) == pytest.approx(6.0)


@pytest.mark.parametrize("angle", [1.57, -1.57])
def test_a_crossing_car_hits_an_ego_that_does_not_react(driven, angle):
    world = driven("junction_crossing", ahead=40.0, angle=angle)
    while not world.over:
        world.step(COAST)
    assert world.reason == "collision"
    assert world.motion.x == pytest.approx(40.0 - 3.65, abs=2.5)


def test_an_ego_that_brakes_late_and_hard_avoids_a_crossing_car(driven):
    world = driven("junction_crossing", ahead=40.0, commit=2.0)
    while not world.over:
        near = world.motion.x > 20.0
        world.step(Control(acceleration=-8.0 if near else 0.0, steering=0.0))
    assert world.reason == "horizon"


# --- external ---------------------------------------------------------------------------------


def test_an_external_agent_follows_its_plan_then_drives_straight(driven):
    world = driven("external")
    times = [world.t_us + 500_000, world.t_us + 1_000_000]
    world.set_agent_plan("car", times, [(33.0, 1.0, 0.0), (37.0, 2.0, 0.0)])
    for _ in range(10):
        world.step(COAST)
    assert agent_of(world)["position"][:2] == pytest.approx([37.0, 2.0])
    world.step(COAST)
    assert agent_of(world)["position"][:2] == pytest.approx([37.8, 2.2])


def test_only_external_agents_can_be_steered(driven):
    world = driven("idm")
    with pytest.raises(WorldError, match="not driven externally") as refused:
        world.set_agent_plan("car", [world.t_us + 1], [(0.0, 0.0, 0.0)])
    assert refused.value.code == ErrorCode.INVALID_ACTION


def test_plans_for_the_past_are_refused(driven):
    world = driven("external")
    with pytest.raises(WorldError, match="us already"):
        world.set_agent_plan("car", [world.t_us], [(0.0, 0.0, 0.0)])


def test_idm_reacts_to_a_pose_driven_ego(make_world, moving):
    world = make_world(
        moving(speed=5.0),
        car=moving(-12, 0, z=0.8, speed=6.0),
        spec={"action": "pose", "agents": {"default": "idm"}, "privileged": True},
    )
    for _ in range(60):
        world.step(PoseCommand(x=0.0, y=0.0, yaw=0.0))
    assert math.hypot(*agent_of(world)["velocity"][:2]) < 0.3
