"""Maps that scenariogeneration writes: five roads and junctions without a gap."""

from __future__ import annotations

import pytest

from real2sim_server.maps import read_map

xodr = pytest.importorskip("scenariogeneration.xodr", reason="scenariogeneration is not installed")


def bends():
    roads = [
        xodr.create_road(
            [xodr.Line(60), xodr.Spiral(1e-9, 0.03, 30), xodr.Arc(0.03, angle=0.9)],
            id=0, left_lanes=1, right_lanes=2,
        ),
        xodr.create_road(
            [xodr.Spiral(0.03, -0.04, 50), xodr.Line(20)], id=1, left_lanes=1, right_lanes=2
        ),
    ]  # fmt: skip
    roads[0].add_successor(xodr.ElementType.road, 1, xodr.ContactPoint.start)
    roads[1].add_predecessor(xodr.ElementType.road, 0, xodr.ContactPoint.end)
    return roads, []


def reversed_contact():
    roads = [xodr.create_road(xodr.Line(40), id=i, left_lanes=2, right_lanes=2) for i in (0, 1)]
    roads[0].add_successor(xodr.ElementType.road, 1, xodr.ContactPoint.end)
    roads[1].add_successor(xodr.ElementType.road, 0, xodr.ContactPoint.end)
    return roads, []


def merging():
    merge = xodr.LaneDef(20, 60, 3, 2, -3)
    road = xodr.create_road(xodr.Line(100), id=0, left_lanes=1, right_lanes=[merge])
    return [road], []


def crossing(count):
    roads = [
        xodr.create_road(xodr.Line(50), id=i, left_lanes=1, right_lanes=2) for i in range(count)
    ]
    junction = xodr.CommonJunctionCreator(id=100, name="j", startnum=100)
    for i, road in enumerate(roads):
        junction.add_incoming_road_circular_geometry(
            road, radius=20, angle=i * 2 * 3.14159265 / count, road_connection="successor"
        )
    for a in range(count):
        for b in range(a):
            junction.add_connection(b, a)
    return [*roads, *junction.get_connecting_roads()], [junction.junction]


MAPS = {
    "bends": bends,
    "reversed_contact": reversed_contact,
    "merging": merging,
    "crossing": lambda: crossing(4),
    "fork": lambda: crossing(3),
}


@pytest.mark.parametrize("name", MAPS)
def test_lanes_go_on_where_the_last_one_ends(tmp_path, name):
    roads, junctions = MAPS[name]()
    network = xodr.OpenDrive(name)
    for road in roads:
        network.add_road(road)
    for junction in junctions:
        network.add_junction(junction)
    network.adjust_roads_and_lanes()
    path = tmp_path / f"{name}.xodr"
    network.write_xml(str(path))
    graph = read_map(path)
    assert graph.gaps
    assert max(graph.gaps.values()) < 0.01
    for before, after in graph.gaps:
        turn = graph.lane(before).headings[-1] - graph.lane(after).headings[0]
        assert abs((turn + 3.1416) % 6.2832 - 3.1416) < 0.05
