"""Maps brought into the frame of a scene by what was driven there."""

from __future__ import annotations

import math

import numpy as np
import pytest

from real2sim_server.maps import Alignment, MapError, align, laid_on
from real2sim_server.scene import Ground, Lane, LaneGraph, Signal


def winding(name="a", *, length=200.0, side=0.0, bend=0.02):
    s = np.arange(0.0, length, 1.0)
    heading = 0.6 * np.sin(s * bend * 2)
    line = np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    line += side * np.column_stack([-np.sin(heading), np.cos(heading)])
    return Lane(name, "driving", np.column_stack([line, 0 * s]), np.full(len(s), 3.5))


def driven(lane, first, last, *, offset=0.1):
    return np.array([[*lane.at(s, offset)[:2], lane.at(s)[3]] for s in np.arange(first, last, 2.0)])


GRAPH = LaneGraph.of([winding(), winding("b", side=3.5)])
YAW, SHIFT = 0.8, np.array([40.0, -25.0, 0.0])


@pytest.mark.parametrize("start", [None, (0.797, 40.3, -25.2)])
def test_a_map_of_another_frame_is_found(start):
    scene = GRAPH.moved(YAW, SHIFT)
    fit = align(GRAPH, driven(scene.lane("a"), 40.0, 160.0, offset=0.0), start=start)
    assert fit.residual < 0.05
    assert fit.within == 1.0
    place = fit.apply(GRAPH).lane("a").at(100.0)
    assert place[:2] == pytest.approx(scene.lane("a").at(100.0)[:2], abs=0.5)


def test_a_map_that_nearly_fits_is_only_nudged():
    off = GRAPH.moved(0.01, np.array([0.3, 0.5, 0.0]))
    fit = align(off, driven(GRAPH.lane("a"), 20.0, 180.0, offset=0.0))
    assert (fit.yaw, fit.residual) == (pytest.approx(-0.01, abs=2e-3), pytest.approx(0.0, abs=0.02))


def test_a_map_of_another_place_is_refused():
    turn = np.arange(0, 6, 0.1)
    circle = np.column_stack([30 * np.cos(turn), 30 * np.sin(turn), turn + 1.57])
    with pytest.raises(MapError, match=r"does not fit|several places"):
        align(GRAPH, circle)


def test_a_straight_road_that_fits_anywhere_is_refused():
    straight = np.column_stack([np.arange(0, 400.0), np.zeros(400), np.zeros(400)])
    graph = LaneGraph.of([Lane("a", "driving", straight, np.full(400, 3.5))])
    poses = np.column_stack([np.full(20, 50.0), np.arange(0, 40.0, 2), np.full(20, math.pi / 2)])
    with pytest.raises(MapError, match=r"several places.*--at"):
        align(graph, poses)


def test_alignment_without_a_drive_is_refused():
    with pytest.raises(MapError, match="no vehicle drove"):
        align(GRAPH, np.zeros((0, 3)))


def test_lanes_are_laid_on_the_ground_and_signals_keep_their_height_over_it():
    light = Signal("l", "traffic_light", (20.0, 5.0, 4.0))
    graph = LaneGraph.of(GRAPH.lanes.values(), signals=[light])
    fit = Alignment(0.0, 0.0, 0.0, 0.0, 1.0)
    laid = fit.apply(graph, Ground.level(2.5))
    assert (laid.lane("a").centre[:, 2] == 2.5).all()
    assert laid.signals["l"].position[2] == pytest.approx(6.5)
    assert laid_on(laid, Ground.level(0.0)).signals["l"].position[2] == pytest.approx(4.0)
