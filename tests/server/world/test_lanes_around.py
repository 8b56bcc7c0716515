"""Lanes near the vehicle in privileged observations, limited to the size of a message."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from real2sim.observation import observation_from_wire
from real2sim_proto.codec import decode, encode
from real2sim_proto.drive import Obs
from real2sim_proto.episode import ResetSpec
from real2sim_server.scene import Lane, LaneGraph
from real2sim_server.world import World
from real2sim_server.world.observation import MAX_LANES, MAX_PLACES, RADIUS, lanes_around


def lane(name: str, points, **fields) -> Lane:
    line = np.array([(*p, 0.0) for p in points], dtype=np.float64)
    return Lane(name, "driving", line, np.linspace(3.0, 4.0, len(line)), **fields)


STREET = LaneGraph.of(
    [
        lane("own", [(-500, 0), (500, 0)], left="left", speed_limit=10.0, successors=("on",)),
        lane("left", [(-500, 3.5), (500, 3.5)], right="own", may_change_right=False),
        lane("on", [(500, 0), (600, 0)]),
    ]
)


def test_lanes_are_sampled_within_the_radius_nearest_first():
    found = lanes_around(STREET, 20.0, 1.0)
    assert [piece.lane.lane_id for piece in found] == ["own", "left"]
    x, y, heading, width = found[1].places.T
    assert (np.hypot(x - 20.0, y - 1.0) <= RADIUS).all()
    assert np.ptp(x) > 2 * RADIUS - 15.0
    np.testing.assert_array_equal(y, 3.5)
    np.testing.assert_array_equal(heading, 0.0)
    np.testing.assert_allclose(width, 3.0 + (x + 500.0) / 1000.0)
    assert np.diff(x).max() <= 5.0 + 1e-9


def test_no_lanes_are_returned_out_of_reach():
    assert lanes_around(STREET, 0.0, 300.0) == ()
    assert lanes_around(LaneGraph({}), 0.0, 0.0) == ()


def test_the_result_is_bounded_on_dense_maps():
    rng = np.random.default_rng(0)
    turns = np.linspace(0, 40 * np.pi, 900)
    spiral = lane("spiral", np.column_stack([30 * np.cos(turns), 30 * np.sin(turns)]))
    many = [
        lane(f"l{k}", [(x, y), (x + 30, y + 2)])
        for k, (x, y) in enumerate(rng.uniform(-40, 40, (200, 2)))
    ]
    found = lanes_around(LaneGraph.of([spiral, *many]), 0.0, 0.0)
    assert len(found) == MAX_LANES
    assert all(len(piece.places) <= MAX_PLACES for piece in found)
    assert sum(piece.places.nbytes for piece in found) <= 32 * 1024
    nearest = [np.hypot(*piece.places[:, :2].T).min() for piece in found]
    assert nearest == sorted(nearest)


def test_a_returning_lane_is_sampled_at_its_nearest_part():
    there = [(-300, 0), (300, 0), (300, 40), (-300, 40)]
    [piece] = lanes_around(LaneGraph.of([lane("u", there)]), 0.0, 5.0)
    np.testing.assert_array_equal(piece.places[:, 1], 0.0)


@pytest.fixture
def observe(make_world):
    def made(lanes: LaneGraph | None, **spec):
        world = make_world()
        scene = replace(world.scene, lanes=lanes)
        return World(scene, world.state, ResetSpec(**spec)).observe()

    return made


def test_only_privileged_observations_on_a_map_hold_lanes(observe):
    assert observe(STREET).lanes == ()
    assert observe(None, privileged=True).lanes == ()
    assert "lanes" not in observe(None, privileged=True).obs_fields()
    assert len(observe(STREET, privileged=True).lanes) == 2


def test_lanes_survive_the_round_trip_to_the_planner(observe):
    fields = observe(STREET, privileged=True).obs_fields()
    sent = decode(encode(Obs(**fields, frames=[]).model_dump()))
    seen = observation_from_wire(Obs.model_validate(sent))
    own, left = seen.lanes
    assert (own.lane_id, own.left, own.speed_limit, own.successors) == ("own", "left", 10.0, ["on"])
    assert (left.may_change_left, left.may_change_right) == (True, False)
    np.testing.assert_array_equal(own.places, fields["lanes"][0]["places"])
