"""What actions of a storyboard do, against their formulas."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from real2sim_proto.episode import ResetSpec
from real2sim_server.render import rasterize
from real2sim_server.render.images import to_uint8
from real2sim_server.scene import Camera, Lane, LaneGraph, Road, RoadLane
from real2sim_server.world import World
from real2sim_server.world.common import Draws
from real2sim_server.world.storyboard.roads import GraphNetwork, Place, path_through

from .boards import action_at, after, board, drive, event, places, speeds

NEAR = 0.05
"""Trajectories meet their formulas within this [m]."""


@pytest.fixture
def run(make_world, moving):
    """Steps of an episode of actions of the car: the first at 1 s, the ego at 10 m/s."""

    def made(*events, steps=80, init=(), **options):
        world = make_world(
            moving(0, 0, speed=10.0),
            look=moving(500, 50),
            spec={"storyboard": board(*events, init=init, **options)},
        )
        return drive(world, steps)

    return made


@pytest.mark.parametrize(
    ("shape", "mean"),
    [("linear", 0.5), ("cubic", 0.5), ("sinusoidal", 0.5)],
)
def test_a_speed_changes_by_its_form_in_its_time(run, shape, mean):
    dynamics = {"shape": shape, "dimension": "time", "value": 2.0}
    worlds = run(action_at(1.0, {"kind": "speed", "speed": 4.0, "dynamics": dynamics}))

    v, x = speeds(worlds), places(worlds)[:, 0]
    assert v[10] == pytest.approx(10.0)
    assert v[20] == pytest.approx(7.0, abs=0.02)
    assert v[30] == pytest.approx(4.0)
    # All three forms have the mean of both speeds as theirs.
    assert x[30] - x[10] == pytest.approx(2.0 * (10 + (4.0 - 10) * mean), abs=NEAR)
    assert x[80] - x[30] == pytest.approx(4.0 * 5.0, abs=1e-6)


def test_a_rate_is_the_highest_acceleration_of_every_form(run):
    for shape in ("linear", "cubic", "sinusoidal"):
        dynamics = {"shape": shape, "dimension": "rate", "value": 3.0}
        worlds = run(action_at(1.0, {"kind": "speed", "speed": 4.0, "dynamics": dynamics}))
        rates = np.diff(speeds(worlds)) / 0.1
        assert -rates.min() == pytest.approx(3.0, abs=0.02)


def test_only_the_magnitude_of_a_rate_counts(run):
    dynamics = {"shape": "linear", "dimension": "rate", "value": -3.0}
    v = speeds(run(action_at(1.0, {"kind": "speed", "speed": 4.0, "dynamics": dynamics})))

    assert np.diff(v).min() == pytest.approx(-0.3, abs=0.002)


def test_a_speed_by_distance_is_reached_after_it(run):
    dynamics = {"shape": "linear", "dimension": "distance", "value": 21.0}
    worlds = run(action_at(1.0, {"kind": "speed", "speed": 4.0, "dynamics": dynamics}))

    v, x = speeds(worlds), places(worlds)[:, 0]
    there = int(np.argmax(v <= 4.0 + 1e-9))
    assert x[there] - x[10] == pytest.approx(21.0, abs=NEAR)


@pytest.mark.parametrize(
    ("shape", "form"),
    [
        ("linear", lambda u: u),
        ("cubic", lambda u: 3 * u**2 - 2 * u**3),
        ("sinusoidal", lambda u: (1 - math.cos(math.pi * u)) / 2),
        ("quintic", lambda u: 10 * u**3 - 15 * u**4 + 6 * u**5),
    ],
)
def test_a_lane_change_follows_its_form(run, shape, form):
    dynamics = {"shape": shape, "dimension": "time", "value": 2.5}
    change = {"kind": "lane_change", "lane": 1, "relative_to": "car", "dynamics": dynamics}
    worlds = run(action_at(1.0, change))

    y = places(worlds)[:, 1]
    for k in range(10, 36):
        assert y[k] == pytest.approx(3.5 * form((k - 10) / 25), abs=NEAR)
    assert y[60] == pytest.approx(3.5)


def test_a_lane_offset_keeps_its_highest_acceleration(run):
    aside = {"kind": "lane_offset", "offset": -1.2, "shape": "sinusoidal", "acceleration": 1.5}
    worlds = run(action_at(1.0, aside))

    y = places(worlds)[:, 1]
    duration = math.pi * math.sqrt(1.2 / (2 * 1.5))
    assert y[80] == pytest.approx(-1.2)
    half = 10 + duration / 2 * 10
    assert np.interp(half, np.arange(81), y) == pytest.approx(-0.6, abs=NEAR)


def test_a_linear_lane_offset_takes_as_long_as_a_cubic_one(run):
    aside = {"kind": "lane_offset", "offset": 1.5, "shape": "linear", "acceleration": 1.0}
    y = places(run(action_at(1.0, aside)))[:, 1]

    # sqrt(6 x 1.5 m / 1 m/s^2) = 3 s
    assert (y[25], y[40]) == (pytest.approx(0.75, abs=NEAR), pytest.approx(1.5, abs=NEAR))


def test_a_lane_offset_leaves_the_speed_along_the_lane(run):
    aside = {"kind": "lane_offset", "offset": -3.0, "shape": "sinusoidal", "acceleration": 5.0}
    x = places(run(action_at(1.0, aside)))[:, 0]

    # Its centre is ahead of its reference point, so it falls behind while it is at an angle.
    assert x[80] - x[0] == pytest.approx(80.0, abs=1e-6)


def test_synchronised_entities_arrive_together(run):
    ego_place = {"kind": "world", "x": 40.0, "y": 0.0}
    place = {"kind": "world", "x": 130.0, "y": 0.0}
    sync = {"kind": "synchronize", "master": "Ego", "master_target": ego_place, "target": place}
    worlds = run(action_at(0.5, sync), steps=40)

    # The ego is there at 4 s, by a constant acceleration of the car.
    assert places(worlds)[40, 0] == pytest.approx(130.0, abs=NEAR)
    rates = np.diff(speeds(worlds))[6:39] / 0.1
    assert np.ptp(rates) < 0.05


def test_a_final_speed_is_that_of_the_arrival(run):
    sync = {
        "kind": "synchronize",
        "master": "Ego",
        "master_target": {"kind": "world", "x": 50.0, "y": 0.0},
        "target": {"kind": "world", "x": 140.0, "y": 0.0},
        "final_speed": 6.0,
    }
    worlds = run(action_at(0.5, sync), steps=50)

    assert places(worlds)[50, 0] == pytest.approx(140.0, abs=NEAR)
    assert speeds(worlds)[50] == pytest.approx(6.0, abs=0.05)
    # One acceleration up to a speed, and its opposite from there.
    rates = np.diff(speeds(worlds))[6:49] / 0.1
    turn = int(np.argmax(np.sign(rates) != np.sign(rates[0])))
    assert rates[: turn - 1] == pytest.approx(rates[0], abs=0.05)
    assert rates[turn + 1 :] == pytest.approx(-rates[0], abs=0.05)


def test_a_timed_polyline_is_met_at_its_times(run):
    vertices = [
        {"time": t, "position": {"kind": "world", "x": x, "y": y}}
        for t, x, y in ((0.0, 30.0, 0.0), (1.0, 40.0, 2.0), (3.0, 50.0, 2.0))
    ]
    follow = {
        "kind": "follow_trajectory",
        "curve": {"shape": "polyline", "vertices": vertices},
        "timing": {"domain": "relative"},
    }
    worlds = run(action_at(1.0, follow), steps=45)

    found = places(worlds)
    assert found[20, :2] == pytest.approx((40.0, 2.0), abs=NEAR)
    assert found[30, :2] == pytest.approx((45.0, 2.0), abs=NEAR)
    # At its end it goes on as it went.
    assert found[45, 0] == pytest.approx(50.0 + 5.0 * 0.5, abs=2 * NEAR)


def polyline(*vertices, **options):
    points = [
        {"position": {"kind": "world", "x": x, "y": y, **more}, "oriented": bool(more), "time": t}
        for t, x, y, more in vertices
    ]
    curve = {"shape": "polyline", "vertices": points}
    return {"kind": "follow_trajectory", "curve": curve, **options}


def test_a_timed_trajectory_begins_at_its_offset_and_its_time(run):
    follow = polyline((0.0, 30.0, 20.0, {}), (10.0, 80.0, 20.0, {}), timing={}, offset=20.0)
    worlds = run(action_at(1.0, follow), steps=30)

    assert places(worlds)[11:31, 0] == pytest.approx(50.0 + 0.5 * np.arange(1, 21), abs=NEAR)


def test_the_heading_turns_within_two_metres_of_a_vertex(run):
    follow = polyline((0.0, 30.0, 20.0, {}), (0.0, 40.0, 20.0, {}), (0.0, 40.0, 40.0, {}))
    worlds = run(action_at(1.0, follow), steps=38)

    x, y, h = places(worlds)[11:].T
    s = x - 30.0 + y - 20.0
    turned = np.clip((s - 8.0) / 4.0, 0.0, 1.0)
    assert h == pytest.approx(turned * math.pi / 2, abs=0.01)


def test_headings_of_vertices_hold_up_to_the_next(run):
    follow = polyline((0.0, 30.0, 20.0, {"h": 0.4}), (0.0, 50.0, 20.0, {"h": 0.4}))
    worlds = run(action_at(1.0, follow), steps=25)

    assert places(worlds)[11:25, 2] == pytest.approx(0.4)
    assert places(worlds)[20, :2] == pytest.approx((40.0, 20.0), abs=NEAR)


@pytest.mark.parametrize("given", [{}, {"h": math.pi}])
def test_with_a_negative_speed_it_drives_along_a_trajectory_rear_first(run, given):
    follow = polyline((0.0, 30.0, 20.0, given), (0.0, 60.0, 20.0, given))
    back = {"kind": "speed", "speed": -5.0}
    worlds = run(event("back", back, follow, start=after(1.0)), steps=60)

    assert places(worlds)[11:61, 0] == pytest.approx(30.0 + 0.5 * np.arange(1, 51), abs=NEAR)
    assert np.abs(places(worlds)[11:61, 2]) == pytest.approx(math.pi)


def test_it_goes_on_along_a_trajectory_whose_vertices_turn_it_around(run):
    vertices = [(0.0, 30.0, 20.0, {"h": 0.0}), (0.0, 45.0, 20.0, {"h": math.pi})]
    follow = polyline(*vertices, (0.0, 70.0, 20.0, {"h": math.pi}))
    worlds = run(action_at(1.0, follow), steps=45)

    assert places(worlds)[11:45, 0] == pytest.approx(30.0 + np.arange(1, 35), abs=NEAR)


def test_the_heading_of_a_route_turns_near_its_places():
    places = [Place(0, 0, 0), Place(50, 0, 0), Place(50 - 1e-3, 1e-4, 0), Place(50, 60, 0)]
    path = path_through(places)

    assert path.at(47.0)[3] == pytest.approx(0.0)
    assert path.at(50.0)[3] == pytest.approx(math.pi / 4)
    assert path.at(53.0)[3] == pytest.approx(math.pi / 2)


def test_a_lane_offset_is_to_the_left_of_the_entity_that_it_refers_to(run):
    oncoming = {"kind": "world", "x": 200.0, "y": 5.25, "h": math.pi}
    init = [("other", {"kind": "teleport", "position": oncoming})]
    aside = {"kind": "lane_offset", "offset": 4.0, "relative_to": "other"}
    other = {"name": "other", "box": {"size": (4.6, 1.85, 1.5), "centre": (0.0, 0.0, 0.75)}}
    storyboard = board(action_at(1.0, aside), init=init)
    worlds = run(
        stories=storyboard["stories"],
        entities=[*storyboard["entities"], other],
        init=init,
        steps=20,
    )

    assert places(worlds)[20, 1] == pytest.approx(5.25 - 4.0)


def test_a_clothoid_leads_where_its_integral_says(run):
    from scipy.integrate import quad

    curvature, rate, length = 0.02, 0.002, 30.0
    start = {"kind": "world", "x": 40.0, "y": 0.0, "h": 0.0}
    curve = {
        "shape": "clothoid",
        "position": start,
        "curvature": curvature,
        "curvature_rate": rate,
        "length": length,
    }
    worlds = run(action_at(1.0, {"kind": "follow_trajectory", "curve": curve}), steps=40)

    def psi(s):
        return curvature * s + rate * s * s / 2

    x = 40.0 + quad(lambda s: math.cos(psi(s)), 0, length)[0]
    y = quad(lambda s: math.sin(psi(s)), 0, length)[0]
    assert places(worlds)[40, :2] == pytest.approx((x, y), abs=NEAR)


def test_a_nurbs_of_a_quarter_circle_is_one(run):
    w = math.sqrt(0.5)
    points = [((40, 0), 1.0), ((60, 0), w), ((60, 20), 1.0)]
    curve = {
        "shape": "nurbs", "order": 3, "knots": [0, 0, 0, 1, 1, 1],
        "points": [
            {"position": {"kind": "world", "x": x, "y": y}, "weight": w} for (x, y), w in points
        ],
    }  # fmt: skip
    worlds = run(action_at(1.0, {"kind": "follow_trajectory", "curve": curve}), steps=40)

    for x, y, *_ in places(worlds)[12:40]:
        assert math.hypot(x - 40, y - 20) == pytest.approx(20.0, abs=0.01)


def test_a_distance_to_the_ego_is_kept(run):
    keep = {
        "kind": "longitudinal_distance", "entity": "Ego", "distance": 60.0, "continuous": True,
        "freespace": True, "place": "leading", "limits": {"acceleration": 3.0, "deceleration": 4.0},
    }  # fmt: skip
    worlds = run(action_at(1.0, keep), steps=100)

    world = worlds[-1]
    ego = world.motion.x + world.scene.ego_size[0] - 1.0
    rear = places(worlds)[-1, 0] - 2.3
    assert speeds(worlds)[-1] == pytest.approx(10.0, abs=0.1)
    assert rear - ego == pytest.approx(60.0, abs=0.2)


def test_an_entity_that_is_there_is_not_added_again(run):
    add = {"kind": "add_entity", "entity": "car", "position": {"kind": "world", "x": 0, "y": 0}}
    worlds = run(action_at(1.0, add), steps=20)

    assert places(worlds)[20, 0] == pytest.approx(places(worlds)[0, 0] + 20.0)


def test_a_deleted_entity_does_not_move_until_it_is_added_again(run):
    again = {"kind": "relative_lane", "entity": "car", "ds": 30.0}
    worlds = run(
        action_at(1.0, {"kind": "delete_entity", "entity": "car"}),
        action_at(3.0, {"kind": "add_entity", "entity": "car", "position": again}),
        steps=40,
    )

    x = places(worlds)[:, 0]
    assert x[40] - x[0] == pytest.approx(10.0 + 30.0 + 10.0, abs=0.2)


def test_an_entity_appears_where_it_is_put_and_leaves(run):
    hide = {"kind": "visibility", "visible": False}
    worlds = run(action_at(1.0, hide), steps=20)

    assert "car" in {o.object_id for o in worlds[5].agents.objects}
    assert "car" not in {o.object_id for o in worlds[15].agents.objects}


def light(lamp, mode="on", **times):
    return {"kind": "light_state", "lamp": lamp, "mode": mode, **times}


def lamps_of(worlds):
    return [w.lamps.get("car", ()) for w in worlds]


def test_lamps_are_lit_until_they_are_switched_off(run):
    on, off = light("brake"), light("brake", "off")
    lit = lamps_of(run(action_at(1.0, on), action_at(1.5, off), steps=20))

    assert lit == [()] * 11 + [("brake",)] * 5 + [()] * 5


def test_a_lamp_flashes_with_its_times(run):
    flash = light("indicator_left", "flashing", on_time=0.3, off_time=0.2)
    lit = lamps_of(run(init=[("car", flash)], steps=20))

    lamp = ("indicator_left",)
    assert lit == ([lamp] * 3 + [()] * 2) * 4 + [lamp]


def test_the_hazard_lamps_leave_the_indicators_their_state(run):
    lit = lamps_of(
        run(
            action_at(0.5, light("hazard")),
            action_at(1.0, light("hazard", "off")),
            init=[("car", light("indicator_right"))],
            steps=15,
        )
    )
    both = ("indicator_left", "indicator_right")
    assert lit == [both[1:]] * 6 + [both] * 5 + [both[1:]] * 5


@pytest.mark.parametrize(
    ("lamp", "corners", "colour"),
    [
        ("brake", [(-2.33, 0.645), (-2.33, -0.645)], (255, 115, 89)),
        ("indicator_left", [(-2.33, 0.805), (2.33, 0.805)], (255, 204, 89)),
        ("indicator_right", [(-2.33, -0.805), (2.33, -0.805)], (255, 204, 89)),
    ],
)
def test_lit_lamps_show_at_corners_of_the_car_and_nowhere_else(run, lamp, corners, colour):
    """The car is 8 m ahead of the camera; its lamps are 0.825 m above the ground."""
    K = np.array([[400.0, 0, 160], [0, 400, 100], [0, 0, 1]])
    mount = np.array([[0, 0, 1, 1.5], [-1, 0, 0, 0], [0, -1, 0, 1.2], [0, 0, 0, 1]], np.float64)
    camera = Camera("ahead", 320, 200, K, mount)

    def shown(*init):
        place = {"kind": "relative_lane", "entity": "Ego", "ds": 11.8}
        put = ("car", {"kind": "teleport", "position": place})
        (world,) = run(init=[put, *init], steps=0)
        view = camera.viewmat(world.T_world_body)
        drawn = rasterize(world.instances(), view[None], K[None], 320, 200, backend="reference")
        return world, view, to_uint8(drawn.rgb)[0].astype(int)

    _, _, dark = shown()
    world, view, lit = shown(("car", light(lamp)))

    (T_world_car,) = (
        T for o, T in zip(world.agents.objects, world.agents.transforms, strict=True)
        if o.object_id == "car"
    )  # fmt: skip
    places = np.array([view @ T_world_car @ (x, y, 0.825 - 0.75, 1.0) for x, y in corners])
    pixels = places[:, :2] / places[:, 2:3] * 400.0 + (160, 100)
    assert lit[int(pixels[0, 1]), int(pixels[0, 0])] == pytest.approx(colour, abs=25)
    changed = np.argwhere((lit != dark).any(axis=2))[:, ::-1] + 0.5
    away = np.abs(changed[:, None] - pixels).max(axis=2)
    # A lamp is at most 0.5 m wide and high.
    assert len(changed) > 20
    assert (away < 0.25 * 400.0 / places[:, 2]).any(axis=1).all()


def test_a_controller_brakes_behind_the_ego(run):
    """The car is put 15 m behind the ego and drives up to it."""
    behind = {"kind": "teleport", "position": {"kind": "relative_lane", "entity": "Ego", "ds": -30}}
    speed = {"kind": "speed", "speed": 14.0}
    worlds = run(
        action_at(0.0, {"kind": "controller", "idm": {"desired_speed": 14.0}}),
        init=[("car", behind), ("car", speed)],
        steps=100,
    )
    gaps = [w.motion.x - places([w])[0, 0] for w in worlds]
    assert min(gaps) > 4.6
    assert speeds(worlds)[-1] == pytest.approx(10.0, abs=1.0)


def test_a_speed_goes_on_following_that_of_the_ego(run):
    follow = {"kind": "speed", "speed": 1.5, "relative_to": "Ego", "continuous": True}
    worlds = run(action_at(1.0, follow), steps=30)

    assert speeds(worlds)[30] == pytest.approx(worlds[30].motion.speed + 1.5)


def forked() -> LaneGraph:
    """A road of 160 m along x, and two that go on from its end: straight, and to the left."""
    lanes, roads = [], []
    for name, x, heading, length, onward in [
        ("0", 0.0, 0.0, 160.0, ("straight", "left")),
        ("straight", 160.0, 0.0, 50.0, ()),
        ("left", 160.0, 0.3, 50.0, ()),
    ]:
        s, width = np.linspace(0.0, length, 21), np.full(21, 3.5)
        ahead = [math.cos(heading), math.sin(heading), 0.0]
        line = np.array([x, 0.0, 0.0]) + np.outer(s, ahead)
        lanes.append(Lane(name, "driving", line, width, successors=onward))
        part = RoadLane(-1, name, s, width / 2, -width / 2)
        roads.append(Road(name, s, line, 0 * s + heading, 0 * s, lanes=(part,)))
    return LaneGraph.of(lanes, roads=roads)


@pytest.mark.parametrize("kind", [{"kind": "relative_lane"}, {"kind": "relative_road", "dt": 0.0}])
def test_a_position_ahead_of_an_entity_is_on_its_route(make_world, moving, kind):
    made = make_world(moving(0, 0, speed=10.0), look=moving(500, 50))
    scene = replace(made.scene, lanes=forked())
    places_ = [{"kind": "lane", "road": r, "lane": -1, "s": s} for r, s in (("0", 5), ("left", 45))]
    ahead = {**kind, "entity": "car", "ds": 50.0}
    init = [
        ("car", {"kind": "assign_route", "route": {"waypoints": places_}}),
        (
            "car",
            {"kind": "teleport", "position": {"kind": "lane", "road": "0", "lane": -1, "s": 140}},
        ),
    ]
    given = board(
        action_at(0.1, {"kind": "teleport", "position": ahead}), init=init, roads={"kind": "map"}
    )
    world = World(scene, made.state, ResetSpec(storyboard=given))

    x, y, _ = places(drive(world, 3))[-1]
    # 50 m ahead of 141 m, and then 0.2 s at 10 m/s.
    assert (x, y) == pytest.approx((160 + 33 * math.cos(0.3), 33 * math.sin(0.3)), abs=0.01)


def test_random_routes_take_each_lane_of_a_fork_equally_often():
    graph, here = forked(), Place(10.0, 0.0, 0.0)

    def is_left(seed, name="car"):
        way = GraphNetwork(graph, Draws(seed)).random_way(here, name)
        assert way.length == pytest.approx(210.0)
        return abs(way.path.at(200.0)[1]) > 1.0

    left = [is_left(seed) for seed in range(200)]
    assert 75 <= sum(left) <= 125
    assert left == [is_left(seed) for seed in range(200)]
    assert left != [is_left(seed, "other") for seed in range(200)]


def test_an_entity_follows_its_random_route_to_the_end_of_the_road(make_world, moving):
    made = make_world(moving(0, 0, speed=10.0), look=moving(500, 50))
    scene = replace(made.scene, lanes=forked())
    given = board(init=[("car", {"kind": "random_route"})], roads={"kind": "map"})
    ends = {}
    for seed in range(6):
        world = World(scene, made.state, ResetSpec(storyboard=given, seed=seed))
        ends[seed] = tuple(np.round(places(drive(world, 115))[-1], 3))

    last = {
        (210.0, 0.0, 0.0),
        tuple(np.round((160 + 50 * math.cos(0.3), 50 * math.sin(0.3), 0.3), 3)),
    }
    assert set(ends.values()) == last
