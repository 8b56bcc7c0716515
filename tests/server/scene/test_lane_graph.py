"""Lane graphs: positions in lanes, routes and the road surface."""

from __future__ import annotations

import math

import numpy as np
import pytest

from real2sim_server.scene import SceneError
from real2sim_server.scene.lane import Area, Lane, Signal
from real2sim_server.scene.lane_graph import LaneGraph


def straight(name, y=0.0, *, x=0.0, length=50.0, flip=False, **more):
    line = np.array([[x, y, 0.0], [x + length / 2, y, 0.0], [x + length, y, 0.0]])
    more = {"kind": "driving", **more}
    return Lane(name, centre=line[::-1] if flip else line, widths=np.full(3, 3.5), **more)


@pytest.fixture
def street():
    return LaneGraph.of(
        [
            straight("a", successors=("c",), left="b"),
            straight("b", 3.5, right="a"),
            straight("back", 7.0, flip=True),
            straight("c", x=50.0),
            straight("walk", -4.0, kind="sidewalk"),
        ]
    )


def bend(radius=30.0, count=60):
    phi = np.linspace(0, 2.0, count)
    line = np.column_stack([radius * np.sin(phi), radius * (1 - np.cos(phi)), 0 * phi])
    return Lane("bend", "driving", line, np.full(count, 4.0))


def test_of_lanes_that_turn_equally_the_right_one_is_straight_on():
    line, width = (
        np.column_stack([np.arange(9.0), np.arange(9.0) ** 2 / 20, np.zeros(9)]),
        np.full(9, 3.5),
    )
    left = Lane("a", "driving", line, width)
    right = Lane("b", "driving", line * (1, -1, 1), width)
    graph = LaneGraph.of([left, right, straight("c")])

    found = graph.straightest_first([left, right, graph.lane("c")])
    assert [lane.lane_id for lane in found] == ["c", "b", "a"]


@pytest.mark.parametrize("offset", [-1.5, 0.0, 1.2])
def test_nearest_inverts_a_position_in_a_lane(offset):
    lane = bend()
    graph = LaneGraph.of([lane])
    for s in (1.0, 17.3, 58.0):
        x, y, _, heading = lane.at(s, offset)
        found = graph.nearest(x, y, heading)
        assert found.lane_id == "bend"
        assert found.s == pytest.approx(s, abs=0.06)
        assert found.offset == pytest.approx(offset, abs=0.01)
        assert found.heading == pytest.approx(s / 30, abs=0.01)
        assert found.inside


def test_nearest_matches_a_brute_force_search():
    rng = np.random.default_rng(3)
    lanes = []
    for i in range(40):
        way = np.cumsum(rng.normal(0, 4, (20, 3)), axis=0) + rng.uniform(-150, 150, 3)
        lanes.append(Lane(f"l{i}", "driving", way, np.full(20, 3.0)))
    graph = LaneGraph.of(lanes)
    places = np.column_stack([rng.uniform(-250, 250, (300, 2)), np.full(300, np.nan)])
    found, values = graph.nearest_many(places)
    for (x, y, _), index, (_, offset) in zip(places, found, values, strict=True):
        best = min(
            float(np.hypot(*(a + u * (b - a) - [x, y])))
            for lane in lanes
            for a, b in zip(lane.centre[:-1, :2], lane.centre[1:, :2], strict=True)
            for u in [np.clip(((x, y) - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)]
        )
        assert abs(offset) == pytest.approx(best, abs=1e-9)
        assert index >= 0


def test_heading_selects_between_opposite_lanes(street):
    assert street.nearest(20.0, 5.4, 0.0).lane_id == "b"
    assert street.nearest(20.0, 5.1, math.pi).lane_id == "back"
    assert street.nearest(20.0, 5.4).lane_id == "back"


def test_nearest_filters_by_lane_kind_and_distance(street):
    assert street.nearest(20.0, -4.0).lane_id == "a"
    assert street.nearest(20.0, -4.0, kinds={"sidewalk"}).lane_id == "walk"
    assert street.nearest(20.0, -4.0, kinds={"bus"}) is None
    assert street.nearest(20.0, -40.0, within=10.0) is None


def test_lanes_and_areas_are_drivable(street):
    square = [[60, 30, 0], [70, 30, 0], [70, 40, 0], [60, 40, 0]]
    graph = LaneGraph.of(street.lanes.values(), areas=[Area("x", "junction", np.array(square))])
    places = [[20, 0], [20, -1.74], [20, -1.76], [20, 8.7], [20, 8.8], [65, 35], [65, 45]]
    assert graph.is_drivable(places).tolist() == [True, True, False, True, False, True, False]


def test_routes_follow_successors_and_permitted_lane_changes(street):
    assert street.routes("a", 500.0) == [("a", "c")]
    assert street.routes("a", 30.0) == [("a",)]
    assert street.route("b", "c") == ("b", "a", "c")
    assert street.route("c", "a") is None
    assert street.gaps == {("a", "c"): 0.0}
    assert street.predecessors["c"] == ("a",)


def test_a_moved_graph_finds_the_same_positions(street):
    moved = street.moved(0.5, [10.0, -3.0, 2.0])
    x, y, z, heading = moved.lane("a").at(20.0, 0.3)
    assert z == 2.0
    found = moved.nearest(x, y, heading)
    assert (found.lane_id, found.s, found.offset) == ("a", pytest.approx(20), pytest.approx(0.3))


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda: straight("a", kind="river"), "river.*driving"),
        (lambda: Lane("a", "driving", np.zeros((3, 3)), np.ones(3)), "share a place"),
        (lambda: straight("a", speed_limit=-1.0), "speed limit"),
        (lambda: LaneGraph.of([straight("a", successors=("q",))]), "'q'"),
        (lambda: LaneGraph.of([straight("a"), straight("a")]), "twice"),
        (
            lambda: LaneGraph.of(
                [straight("a")], signals=[Signal("s", "stop", (0, 0, 0), lanes=("b",))]
            ),
            "signal 's'.*'b'",
        ),
    ],
)  # fmt: skip
def test_invalid_graphs_are_refused(make, reason):
    with pytest.raises(SceneError, match=reason):
        make()
