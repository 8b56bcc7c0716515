"""Traffic on map lanes: closed forms of the intelligent driver model, and MOBIL."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from real2sim_proto import ErrorCode
from real2sim_proto.episode import LaneDriver, ResetSpec
from real2sim_proto.plans import Control
from real2sim_server.scene import Lane, LaneGraph
from real2sim_server.world import World, WorldError
from real2sim_server.world.traffic.driver import Idm, Leader, Neighbours, incentive
from real2sim_server.world.traffic.idm_drivers import LaneChanger

COAST = Control(acceleration=0.0, steering=0.0)
FREE = Neighbours(None, None)
SPEC = LaneDriver()


def lane(name: str, y: float, *, start: float = -200.0, end: float = 1500.0, **fields) -> Lane:
    x = np.arange(start, end + 1.0, 10.0)
    line = np.column_stack([x, np.full(len(x), y), np.zeros(len(x))])
    return Lane(name, "driving", line, np.full(len(x), 3.5), **fields)


ONE = LaneGraph.of([lane("own", 0.0)])
TWO = LaneGraph.of([lane("own", 0.0, left="fast"), lane("fast", 3.5, right="own")])


@pytest.fixture
def driven(make_world, moving):
    """Make a world with cars that follow map lanes. The ego stands 40 m beside the road."""

    def make(graph: LaneGraph | None, drivers: dict, **cars) -> World:
        made = make_world(moving(0, -40), **cars)
        kinds = {name: {"kind": "lanes", **fields} for name, fields in drivers.items()}
        spec = {"agents": {"drivers": kinds}, "action": "control", "privileged": True}
        options = ResetSpec(**spec, beyond_log="extend", horizon=900)
        return World(replace(made.scene, lanes=graph), made.state, options)

    return make


def seen(world: World, name: str) -> tuple[np.ndarray, float]:
    """Position [m] and speed [m/s] of an object."""
    k = [o.object_id for o in world.agents.objects].index(name)
    return world.agents.positions[k], float(np.hypot(*world.agents.velocities[k, :2]))


def after(world: World, seconds: float) -> World:
    for _ in range(round(seconds / 0.1)):
        world.step(COAST)
    return world


def gap(world: World) -> float:
    return float(seen(world, "lead")[0][0] - seen(world, "car")[0][0]) - 4.0


# --- the intelligent driver model -------------------------------------------------------------


def test_the_gap_behind_a_steady_leader_is_the_equilibrium_gap(driven, moving):
    """Treiber et al. 2000, equation 4: s = (s0 + v T) / sqrt(1 - (v / v0)^4)."""
    drivers = {"lead": {"desired_speed": 8.0}, "car": {"desired_speed": 12.0}}
    cars = {"lead": moving(60, 0, z=0.8, speed=8.0), "car": moving(20, 0, z=0.8, speed=8.0)}
    world = after(driven(ONE, drivers, **cars), 80.0)
    v, wanted = 8.0, SPEC.gap + 8.0 * SPEC.headway
    assert seen(world, "car")[1] == pytest.approx(v, abs=0.01)
    assert gap(world) == pytest.approx(wanted / math.sqrt(1 - (v / 12.0) ** 4), rel=0.01)


def test_a_car_stops_at_the_standstill_gap_behind_a_stopped_leader(driven, moving):
    world = driven(
        ONE,
        {"car": {"desired_speed": 10.0}},
        lead=moving(100, 0, z=0.8),
        car=moving(0, 0, z=0.8, speed=10.0),
    )
    speeds = [seen(after(world, 0.1), "car")[1] for _ in range(500)]
    braking = -np.diff(speeds).min() / 0.1
    assert gap(world) == pytest.approx(SPEC.gap, abs=0.05)
    # With enough room it brakes at the comfortable deceleration.
    assert 0.6 * SPEC.braking < braking < 1.05 * SPEC.braking


def test_free_flow_speed_is_the_limit_of_the_lane(driven, moving):
    limited = LaneGraph.of([lane("own", 0.0, speed_limit=9.0)])
    cars = {"car": moving(0, 0, z=0.8, speed=5.0)}
    world = after(driven(limited, {"car": {}}, **cars), 40.0)
    assert seen(world, "car")[1] == pytest.approx(9.0, abs=0.05)
    world = after(driven(ONE, {"car": {}}, **cars), 40.0)
    assert seen(world, "car")[1] == pytest.approx(5.0, abs=0.05)


def test_a_car_follows_successor_lanes_and_disappears_at_the_end(driven, moving):
    turn = np.linspace(0, np.pi / 2, 20)
    bend = np.column_stack([60 + 30 * np.sin(turn), 30 - 30 * np.cos(turn), 0 * turn])
    up = np.column_stack([np.full(9, 90.0), np.linspace(30, 110, 9), np.zeros(9)])
    graph = LaneGraph.of(
        [
            lane("a", 0.0, end=60.0, successors=("b",)),
            Lane("b", "driving", bend, np.full(20, 3.5), successors=("c",)),
            Lane("c", "driving", up, np.full(9, 3.5)),
        ]
    )
    world = driven(graph, {"car": {}}, car=moving(40, 0, z=0.8, speed=8.0))
    for _ in range(100):
        world.step(COAST)
        if not world.traffic.drivers["car"].present:
            break
        (x, y, _), speed = seen(world, "car")
        place = graph.nearest(x, y)
        assert abs(place.offset) < 0.15
        if place.lane_id == "b":
            assert speed < math.sqrt(2.5 * 30) + 0.3
    else:
        after(world, 14.0)
    assert "car" not in [o.object_id for o in world.agents.objects]


# --- MOBIL --------------------------------------------------------------------------------------


def idm(v: float, v0: float, s: float = math.inf, leader: float = 0.0) -> float:
    """Acceleration of the intelligent driver model, as published."""
    a, b = SPEC.acceleration, SPEC.braking
    wanted = SPEC.gap + max(0.0, v * SPEC.headway + v * (v - leader) / (2 * math.sqrt(a * b)))
    return a * (1 - (v / v0) ** 4 - (wanted / s) ** 2)


def test_the_incentive_matches_the_mobil_paper():
    """Kesting et al. 2007, equation 3, with both followers present."""
    v, v0, length = 10.0, 12.0, 4.0
    here = Neighbours(Leader(15.0, 7.0), Leader(25.0, 9.0))
    there = Neighbours(Leader(60.0, 11.0), Leader(30.0, 10.0))
    own = idm(v, v0, 60.0, 11.0) - idm(v, v0, 15.0, 7.0)
    new = idm(10.0, v0, 30.0, v) - idm(10.0, v0, 30.0 + length + 60.0, 11.0)
    old = idm(9.0, v0, 25.0 + length + 15.0, 7.0) - idm(9.0, v0, 25.0, v)
    found = incentive(SPEC, v, length, here=(here, v0), there=(there, v0))
    assert found == pytest.approx(own + SPEC.politeness * (new + old) - SPEC.threshold)


def test_lane_changes_that_force_hard_braking_are_unsafe():
    """Equation 2: the new follower's acceleration stays above -b_safe."""
    slow = (Neighbours(Leader(10.0, 3.0), None), 12.0)

    def there(gap: float) -> tuple[Neighbours, float]:
        return Neighbours(None, Leader(gap, 12.0)), 12.0

    limit = next(s for s in np.arange(60.0, 0.0, -0.01) if idm(12.0, 12.0, s, 10.0) < -4.0)
    assert incentive(SPEC, 10.0, 4.0, here=slow, there=there(limit + 0.1)) is not None
    assert incentive(SPEC, 10.0, 4.0, here=slow, there=there(limit - 0.1)) is None
    beside = Neighbours(None, Leader(-2.0, 10.0)), 12.0
    assert incentive(SPEC, 10.0, 4.0, here=slow, there=beside) is None


def test_politeness_lowers_the_incentive():
    here = (Neighbours(Leader(35.0, 10.0), None), 12.0)
    there = (Neighbours(None, Leader(20.0, 10.0)), 12.0)
    selfish, polite = (
        incentive(LaneDriver(politeness=p), 10.0, 4.0, here=here, there=there) for p in (0.0, 1.0)
    )
    assert polite < 0.0 < selfish


def test_two_free_lanes_give_no_incentive():
    found = incentive(SPEC, 10.0, 4.0, here=(FREE, 12.0), there=(FREE, 12.0))
    assert found == pytest.approx(-SPEC.threshold)


# --- lane changes in a world --------------------------------------------------------------------


def test_a_slow_leader_is_overtaken(driven, moving):
    cars = {"lead": moving(40, 0, z=0.8, speed=4.0), "car": moving(0, 0, z=0.8, speed=10.0)}
    drivers = {"lead": {"desired_speed": 4.0, "changes": False}, "car": {"desired_speed": 10.0}}
    world = driven(TWO, drivers, **cars)
    began, aside = None, []
    for k in range(150):
        world.step(COAST)
        aside.append(seen(world, "car")[0][1])
        if began is None and world.traffic.drivers["car"].changing:
            began = k - 1  # the previous step started the change
    assert began is not None
    # A quintic covers half the distance in half the time; peak acceleration 5.77 d / T^2.
    change = round(SPEC.change_time / 0.1)
    assert aside[began + change // 2] == pytest.approx(1.75, abs=0.05)
    assert aside[began + change] == pytest.approx(3.5, abs=0.01)
    assert np.abs(np.diff(aside, 2)).max() / 0.01 < 1.1 * 5.7735 * 3.5 / SPEC.change_time**2
    assert seen(world, "car")[0][0] > seen(world, "lead")[0][0]
    assert world.accumulator.collisions == 0


def test_the_left_indicator_flashes_during_a_change_to_the_left(driven, moving):
    cars = {"lead": moving(40, 0, z=0.8, speed=4.0), "car": moving(0, 0, z=0.8, speed=10.0)}
    drivers = {"lead": {"desired_speed": 4.0, "changes": False}, "car": {"desired_speed": 10.0}}
    world = driven(TWO, drivers, **cars)
    lit = []
    for _ in range(150):
        world.step(COAST)
        lit.append("indicator_left" in world.lamps.get("car", ()))
        assert "indicator_right" not in world.lamps.get("car", ())
    first, change = lit.index(True), round(SPEC.change_time / 0.1)
    assert lit[first : first + change] == ([True] * 4 + [False] * 5 + [True]) * (
        change // 10 - 1
    ) + ([True] * 4 + [False] * 6)
    assert not any(lit[first + change :])


def test_two_cars_do_not_swap_lanes_forever(driven, moving):
    """MOBIL also makes a slow leader change lanes for a fast follower."""
    cars = {"lead": moving(40, 0, z=0.8, speed=4.0), "car": moving(0, 0, z=0.8, speed=10.0)}
    world = driven(TWO, {"lead": {"desired_speed": 4.0}, "car": {"desired_speed": 10.0}}, **cars)
    changes, before = 0, dict.fromkeys(cars, False)
    for _ in range(200):
        world.step(COAST)
        for name in cars:
            now = world.traffic.drivers[name].changing is not None
            changes += now and not before[name]
            before[name] = now
    assert 1 <= changes <= 2
    assert seen(world, "car")[0][0] > seen(world, "lead")[0][0] + 20.0
    assert world.accumulator.collisions == 0


@pytest.mark.parametrize("why", ["told", "marks", "traffic"])
def test_a_car_that_cannot_change_lanes_follows_its_leader(driven, moving, why):
    cars = {"lead": moving(30, 0, z=0.8, speed=4.0), "car": moving(0, 0, z=0.8, speed=8.0)}
    graph, fields = TWO, {"desired_speed": 10.0}
    if why == "told":
        fields["changes"] = False
    elif why == "marks":
        own = replace(TWO.lane("own"), may_change_left=False)
        graph = LaneGraph.of([own, TWO.lane("fast")])
    else:
        cars["beside"] = moving(-1, 3.5, z=0.8, speed=8.0)
    drivers = {"lead": {"desired_speed": 4.0}, "car": fields}
    if why == "traffic":
        drivers["beside"] = {"desired_speed": 8.0, "changes": False}
    world = after(driven(graph, drivers, **cars), 2.0 if why == "traffic" else 12.0)
    assert abs(seen(world, "car")[0][1]) < 0.01


def test_a_car_leaves_a_lane_that_ends(driven, moving):
    graph = LaneGraph.of([lane("own", 0.0, end=200.0, left="fast"), lane("fast", 3.5, right="own")])
    world = after(driven(graph, {"car": {}}, car=moving(0, 0, z=0.8, speed=10.0)), 25.0)
    (x, y, _), _ = seen(world, "car")
    assert y == pytest.approx(3.5, abs=0.02)
    assert x > 200.0


# --- beginning ----------------------------------------------------------------------------------


def test_lane_drivers_need_a_map(driven, moving):
    with pytest.raises(WorldError, match="has no map") as caught:
        driven(None, {"car": {}}, car=moving(0, 0, speed=5.0))
    assert caught.value.code == ErrorCode.INVALID_REQUEST


def test_cars_outside_lanes_follow_their_recorded_path(driven, moving):
    cars = {"car": moving(0, -12, z=0.8, speed=5.0), "cross": moving(9, 0, speed=5.0, yaw=1.5)}
    world = after(driven(TWO, {"car": {"headway": 2.5}, "cross": {}}, **cars), 1.0)
    assert isinstance(world.traffic.drivers["car"], Idm)
    assert isinstance(world.traffic.drivers["cross"], Idm)
    assert world.traffic.drivers["car"].spec.headway == 2.5


def test_the_default_lane_driver_applies_to_cars_on_lanes(make_world, moving):
    made = make_world(moving(0, -40), car=moving(0, 0.4, z=0.8, speed=8.0), parked=moving(50, -6))
    agents = {"default": "lanes"}
    world = World(replace(made.scene, lanes=TWO), made.state, ResetSpec(agents=agents))
    assert isinstance(world.traffic.drivers["car"], LaneChanger)
    assert list(world.traffic.drivers) == ["car"]
    # It returns to the lane centre.
    for _ in range(80):
        world.step()
    assert abs(seen(world, "car")[0][1]) < 0.02
