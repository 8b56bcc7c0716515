"""OpenDRIVE against closed forms worked out another way, and against maps that others write."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from real2sim_server.maps import MapError, read_map
from real2sim_server.maps.opendrive_roads import arc, cubic, line, read_plan_view, spiral

HEADER = '<header revMajor="1" revMinor="7" name="m"/>'
LANES = """<lanes>{offset}<laneSection s="0"><left><lane id="1" type="driving">
<width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></left>
<center><lane id="0" type="none"><roadMark sOffset="0" type="broken"/></lane></center>
<right><lane id="-1" type="driving"><width sOffset="0" a="3.5" b="0" c="0" d="0"/>
<roadMark sOffset="0" type="solid"/></lane>
<lane id="-2" type="driving"><width sOffset="0" a="3" b="0.01" c="0" d="0"/>
<speed sOffset="0" max="50" unit="km/h"/></lane></right></laneSection></lanes>"""
SHAPES = {
    "line": "<line/>",
    "arc": '<arc curvature="-0.05"/>',
    "spiral": '<spiral curvStart="-0.01" curvEnd="0.12"/>',
    "poly3": '<poly3 a="0" b="0" c="0.004" d="-0.00004"/>',
    "paramPoly3": '<paramPoly3 pRange="normalized" aU="0" bU="40" cU="0" dU="-3" '
    'aV="0" bV="0" cV="12" dV="-5"/>',
}


STRAIGHT = '<geometry s="0" x="0" y="0" hdg="0" length="100"><line/></geometry>'


def one_road(tmp_path, geometry, length, *, offset="", more="", lanes=LANES, header=HEADER):
    path = tmp_path / "map.xodr"
    path.write_text(
        f'<OpenDRIVE>{header}<road id="7" length="{length!r}" junction="-1"><planView>'
        f"{geometry}</planView>{lanes.format(offset=offset)}{more}</road></OpenDRIVE>"
    )
    return path


def lane(number, *widths, links="", kind="driving"):
    """A lane with widths (sOffset, a, b)."""
    records = "".join(
        f'<width sOffset="{s}" a="{a}" b="{b}" c="0" d="0"/>' for s, a, b in widths or [(0, 3, 0)]
    )
    return f'<lane id="{number}" type="{kind}"><link>{links}</link>{records}</lane>'


def section(s, left="", right="", single=""):
    given = f' singleSide="{single}"' if single else ""
    sides = "".join(
        f"<{side}>{lanes}</{side}>" for side, lanes in (("left", left), ("right", right)) if lanes
    )
    return f'<laneSection s="{s}"{given}>{sides}</laneSection>'


def integrated(start, end, length, d):
    """The place at distance d of a curve of linear curvature, by quadrature of its heading."""

    def heading(s):
        return start * s + (end - start) * s * s / (2 * length)

    options = {"epsabs": 1e-11, "epsrel": 1e-11, "limit": 400}
    x = quad(lambda s: math.cos(heading(s)), 0, d, **options)[0]
    y = quad(lambda s: math.sin(heading(s)), 0, d, **options)[0]
    return x, y, heading(d)


@pytest.mark.parametrize(
    ("shape", "start", "end"),
    [
        (line(), 0.0, 0.0),
        (arc(0.2), 0.2, 0.2),
        (arc(-1e-9), -1e-9, -1e-9),
        *(
            (spiral(start, end, 30.0), start, end)
            for start, end in (
                (0.0, 0.1), (-0.02, 0.08), (0.05, -0.15), (0.1, 0.1 + 1e-7), (0.03, 0.03 - 2e-6)
            )
        ),
    ],
)  # fmt: skip
def test_lines_arcs_and_spirals_are_the_integrals_of_their_curvature(shape, start, end):
    places = np.array([0.0, 7.5, 21.0, 30.0])
    wanted = [integrated(start, end, 30.0, d) for d in places]
    np.testing.assert_allclose(shape(places), wanted, atol=2e-7)


def test_a_cubic_is_followed_by_arc_length():
    u, v, length = (0.0, 40.0, 0.0, -3.0), (0.0, 0.0, 12.0, -5.0), 45.0

    def passed(p):
        speed = lambda q: math.hypot(40 - 9 * q * q, 24 * q - 15 * q * q)  # noqa: E731
        return quad(speed, 0, p, epsabs=1e-12)[0]

    total = passed(1.0)
    curve = cubic(u, v, 1.0, length)
    for d in (0.0, 3.0, 20.0, 44.0, 45.0):
        p = brentq(lambda p, d=d: passed(p) - d / length * total, 0, 1, xtol=1e-13) if d else 0.0
        x, y, heading = curve(np.array([d]))[0]
        assert (x, y) == pytest.approx((40 * p - 3 * p**3, 12 * p**2 - 5 * p**3), abs=1e-7)
        wanted = math.atan2(24 * p - 15 * p * p, 40 - 9 * p * p)
        assert heading == pytest.approx(wanted, abs=1e-8)


@pytest.mark.parametrize("kind", SHAPES)
def test_roads_keep_their_reference_lines_within_a_millimetre(tmp_path, kind):
    """Sampled and stored as they are, between their samples too."""
    length = 40.0
    geometry = f'<geometry s="0" x="3" y="-2" hdg="0.7" length="{length}">{SHAPES[kind]}</geometry>'
    road = read_map(one_road(tmp_path, geometry, length)).road("7")
    plan = read_plan_view(ET.fromstring(f"<road><planView>{geometry}</planView></road>"))
    s = np.random.default_rng(5).uniform(0, length, 500)
    exact, stored = plan.at(s), road.sample(s)
    assert np.abs(stored[:, :2] - exact[:, :2]).max() < 1e-3
    assert np.abs(stored[:, 3] - exact[:, 2]).max() < 2e-3


def test_lanes_run_as_their_traffic_does_with_neighbours_widths_and_speeds(tmp_path):
    geometry = '<geometry s="0" x="0" y="0" hdg="0" length="100"><line/></geometry>'
    graph = read_map(one_road(tmp_path, geometry, 100.0))
    outer, inner, other = (graph.lane(f"7.0.{n}") for n in (-2, -1, 1))
    assert inner.at(10.0) == pytest.approx((10.0, -1.75, 0.0, 0.0))
    assert other.at(10.0)[:2] == pytest.approx((90.0, 1.75))
    assert abs(other.at(10.0)[3]) == pytest.approx(math.pi)
    assert outer.width(50.0) == pytest.approx(3.5, abs=1e-4)
    assert (inner.right, inner.left, inner.opposite) == ("7.0.-2", None, "7.0.1")
    assert (outer.left, other.opposite) == ("7.0.-1", "7.0.-1")
    assert outer.speed_limit == pytest.approx(50 / 3.6)
    assert not inner.may_change_right  # its outer mark is solid
    assert not outer.may_change_left


def test_elevation_superelevation_and_lane_offset_move_the_lanes(tmp_path):
    geometry = '<geometry s="0" x="0" y="0" hdg="0" length="100"><line/></geometry>'
    more = (
        '<elevationProfile><elevation s="0" a="1" b="0.1" c="0" d="0"/></elevationProfile>'
        '<lateralProfile><superelevation s="0" a="0.1" b="0" c="0" d="0"/></lateralProfile>'
    )
    offset = (
        '<laneOffset s="0" a="0" b="0" c="0" d="0"/><laneOffset s="40" a="2" b="0" c="0" d="0"/>'
    )
    graph = read_map(one_road(tmp_path, geometry, 100.0, offset=offset, more=more))
    x, y, z, _ = graph.road("7").on_lane(-1, 60.0)
    t = 2.0 - 1.75
    assert (x, y, z) == pytest.approx((60, t * math.cos(0.1), 1 + 6 + t * math.sin(0.1)), abs=1e-6)


def test_marks_of_crosswalks_are_no_traffic_lights(tmp_path):
    mark, light = (
        f'<signal id="{d}" s="90" t="0" dynamic="{d}" orientation="+" type="1000003"/>'
        for d in ("no", "yes")
    )
    graph = read_map(one_road(tmp_path, STRAIGHT, 100.0, more=f"<signals>{mark}{light}</signals>"))

    assert {k: s.kind for k, s in graph.signals.items()} == {"no": "other", "yes": "traffic_light"}


def test_signals_rule_the_lanes_that_they_face_and_find_their_stop_line(tmp_path):
    geometry = '<geometry s="0" x="0" y="0" hdg="0" length="100"><line/></geometry>'
    more = """<signals>
    <signal id="l" s="90" t="-6" zOffset="4" dynamic="yes" orientation="+" type="1000001"/>
    <signal id="w" s="88" t="-3" dynamic="no" orientation="+" type="294"/>
    <signal id="v" s="20" t="-6" dynamic="no" orientation="+" type="274" value="30" unit="km/h">
    <validity fromLane="-2" toLane="-2"/></signal></signals>"""
    graph = read_map(one_road(tmp_path, geometry, 100.0, more=more))
    light, limit = graph.signals["l"], graph.signals["v"]
    assert (light.kind, set(light.lanes)) == ("traffic_light", {"7.0.-1", "7.0.-2"})
    assert light.position == pytest.approx((90, -6, 4))
    assert light.stop_line == "7/w"
    np.testing.assert_allclose(graph.stop_lines["7/w"].points[:, 0], 88.0)
    assert (limit.lanes, limit.value) == (("7.0.-2",), pytest.approx(30 / 3.6))


@pytest.mark.parametrize("header", ["", '<header name="m"/>'])
def test_a_file_without_a_version_is_read_with_a_note(tmp_path, header):
    graph = read_map(one_road(tmp_path, STRAIGHT, 100.0, header=header))
    assert len(graph.lanes) == 3
    assert "headers without a version" in graph.notes[0]


@pytest.mark.parametrize("given", ["", 'length="250"'])
def test_the_geometry_counts_where_a_road_has_another_length(tmp_path, given):
    path = one_road(tmp_path, STRAIGHT, 99.0)
    path.write_text(path.read_text().replace('length="99.0"', given))
    graph = read_map(path)
    assert graph.road("7").length == 100
    assert graph.notes == ("roads with another length than their geometry, which is used: 1 (7)",)


def test_references_to_absent_parts_are_noted_once_per_kind(tmp_path):
    links = (
        '<link><predecessor elementType="road" elementId="8" contactPoint="end"/>'
        '<successor elementType="junction" elementId="9"/>'
        '<neighbor side="left" elementId="12" direction="same"/></link>'
    )
    signals = (
        '<signals><signalReference id="s" s="5" t="0" orientation="+"/>'
        '<signal id="v" s="5" t="0" orientation="+" type="205"><validity fromLane="3" toLane="4"/>'
        "</signal></signals>"
    )
    sections = section(0, right=lane(-1, links='<successor id="-4"/>'))
    lanes = f"<lanes>{sections}{section(50, right=lane(-1))}</lanes>"
    path = one_road(tmp_path, STRAIGHT, 100.0, lanes=lanes, more=links + signals)
    junction = "".join(
        f'<connection id="{i}" incomingRoad="7" connectingRoad="{road}" contactPoint="start">'
        f'<laneLink from="-1" to="-1"/></connection>'
        for i, road in enumerate(range(20, 27))
    )
    end = f'<junction id="3">{junction}</junction></OpenDRIVE>'
    path.write_text(path.read_text().replace("</OpenDRIVE>", end))
    graph = read_map(path)
    assert set(graph.lanes) == {"7.0.-1", "7.1.-1"}
    assert graph.notes == (
        "connections of junctions to a road that is not there: 7 "
        "(3 to 20, 3 to 21, 3 to 22, 3 to 23, 3 to 24, ...)",
        "links of roads to a road or junction that is not there: 3 (7 to 8, 7 to 9, 7 to 12)",
        "lane links to a lane that is not there: 1 (7.1.-4)",
        "signals for lanes that are not there: 1 (v on road 7)",
        "references to a signal that is not there: 1 (s on road 7)",
    )


def test_a_section_of_one_side_keeps_the_lanes_of_the_other_side(tmp_path):
    """Their widths go on from the section that has them, and they continue into themselves."""
    ahead = '<successor id="-1"/>'
    lanes = "".join(
        (
            section(0, left=lane(1, (0, 3, 0.01)), right=lane(-1, links=ahead)),
            section(40, right=lane(-1) + lane(-2), single="true"),
            section(70, left=lane(1) + lane(2), single="true"),
        )
    )
    graph = read_map(one_road(tmp_path, STRAIGHT, 100.0, lanes=f"<lanes>{lanes}</lanes>"))
    assert list(graph.lanes) == [
        "7.0.-1", "7.0.1", "7.1.-1", "7.1.-2", "7.1.1", "7.2.-1", "7.2.-2", "7.2.1", "7.2.2"
    ]  # fmt: skip
    assert graph.road("7").lane(1, 55.0).width(55.0) == pytest.approx(3.55)
    assert graph.road("7").lane(1, 80.0).width(80.0) == pytest.approx(3.0)
    onward = {name: lane.successors for name, lane in graph.lanes.items() if lane.successors}
    assert onward == {
        "7.0.-1": ("7.1.-1",),
        "7.1.-1": ("7.2.-1",),
        "7.1.-2": ("7.2.-2",),
        "7.1.1": ("7.0.1",),
    }
    assert graph.lane("7.1.-1").opposite == "7.1.1"


def test_both_sides_may_begin_in_a_section_of_their_own(tmp_path):
    lanes = section(0, left=lane(1), single="true") + section(0, right=lane(-1), single="true")
    graph = read_map(one_road(tmp_path, STRAIGHT, 100.0, lanes=f"<lanes>{lanes}</lanes>"))
    assert set(graph.lanes) == {"7.0.1", "7.0.-1"}


@pytest.mark.parametrize("before", ["", '<laneOffset s="50.39" a="0" b="500" c="0" d="0"/>'])
def test_a_step_of_the_lane_offset_is_a_step(tmp_path, before):
    """With one record or two that are 4 mm apart; its borders are straight up to the step."""
    offset = (
        f'<laneOffset s="0" a="0" b="0" c="0" d="0"/>{before}'
        '<laneOffset s="50.394" a="1.83" b="0" c="0" d="0"/>'
    )
    lanes = f"<lanes>{{offset}}{section(0, right=lane(-1))}</lanes>"
    graph = read_map(one_road(tmp_path, STRAIGHT, 100.0, lanes=lanes, offset=offset))
    for s, t in ((50.0, 0), (50.391, 0), (50.396, 1.83), (50.8, 1.83)):
        assert graph.road("7").on_lane(-1, s)[1] == pytest.approx(t - 1.5, abs=1e-9)
    left, right = graph.lane("7.0.-1").rims
    for rim, t in ((left, 0.0), (right, -3.0)):
        away = np.minimum(np.abs(rim[:, 1] - t), np.abs(rim[:, 1] - t - 1.83))
        assert away.max() < 0.01
        assert np.abs(rim[:, 0] - graph.lane("7.0.-1").centre[:, 0]).max() < 0.01


def test_a_step_of_a_width_is_a_step(tmp_path):
    lanes = f"<lanes>{section(0, right=lane(-1, (0, 3, 0), (50.4, 4, 0)))}</lanes>"
    road = read_map(one_road(tmp_path, STRAIGHT, 100.0, lanes=lanes)).road("7")
    widths = [road.lane(-1, s).width(s) for s in (50.0, 50.397, 50.402)]
    assert widths == pytest.approx([3.0, 3.0, 4.0])


def test_a_lane_offset_changes_at_the_border_of_its_section(tmp_path):
    """Although its record starts some millimetres after or before the section."""
    ahead = '<successor id="-2"/>'
    for start in (50.004, 49.996):
        offset = f'<laneOffset s="{start}" a="3" b="0" c="0" d="0"/>'
        sections = section(0, right=lane(-1, links=ahead))
        sections += section(50, right=lane(-1) + lane(-2))
        lanes = f"<lanes>{offset}{sections}</lanes>"
        graph = read_map(one_road(tmp_path, STRAIGHT, 100.0, lanes=lanes))
        assert graph.gaps == {("7.0.-1", "7.1.-2"): pytest.approx(0.0, abs=1e-9)}
        assert np.ptp(graph.lane("7.1.-2").centre[:, 1]) < 1e-9


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("<OpenDRIVE", "not an XML"),
        ("<map/>", "expected <OpenDRIVE>"),
        (f"<OpenDRIVE>{HEADER}</OpenDRIVE>", "no <road>"),
        ('<OpenDRIVE><header revMajor="2" revMinor="0"/></OpenDRIVE>', "2.0"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><OpenDRIVE/>', "document type"),
        (
            f'<OpenDRIVE>{HEADER}<road id="a" length="5"/></OpenDRIVE>',
            "none of its 1 roads.*a: has no <planView>",
        ),
        (
            f'<OpenDRIVE>{HEADER}<road id="a" length="5"><planView><geometry s="0" x="0" y="0" '
            'hdg="0" length="5"><curl/></geometry></planView></road></OpenDRIVE>',
            "curl.*paramPoly3",
        ),
    ],
)
def test_invalid_maps_are_refused_by_name(tmp_path, text, reason):
    path = tmp_path / "bad.xodr"
    path.write_text(text)
    with pytest.raises(MapError, match=reason) as caught:
        read_map(path)
    assert "bad.xodr" in str(caught.value)


def road(key, *, more="", sections=None, geometry=None, attributes=""):
    """A straight road of 100 m with lanes -1 and -2, after the road before it."""
    lanes = sections or section(0, right=lane(-1) + lane(-2))
    line = f'<geometry s="0" x="{100 * key}" y="0" hdg="0" length="100"><line/></geometry>'
    return (
        f'<road id="{key}" length="100" junction="-1" {attributes}><planView>{geometry or line}'
        f"</planView><lanes>{lanes}</lanes>{more}</road>"
    )


def read_roads(tmp_path, *roads):
    path = tmp_path / "map.xodr"
    path.write_text(f"<OpenDRIVE>{HEADER}{''.join(roads)}</OpenDRIVE>")
    return read_map(path)


WIDE = '<width sOffset="0" a="3" b="0" c="0" d="0"/>'
THREE = section(0, right=lane(-1) + lane(-2) + lane(-3))
SIGN = '<signals><signal id="s" s="50" t="0" orientation="+" type="205"/>{}</signals>'


@pytest.mark.parametrize(
    ("damaged", "lost", "note"),
    [
        ("", "2.0.-1 2.0.-2", None),
        (road(2, geometry="<geometry/>"), "2.0.-1 2.0.-2", "roads .* read: 1 .2: s of <geometry>"),
        (road(2).replace('hdg="0"', 'hdg="nan"'), "2.0.-1 2.0.-2", "2: hdg of .* found 'nan'"),
        (road(2).replace("<line/>", "<curl/>"), "2.0.-1 2.0.-2", "2: geometry at .* holds curl"),
        (road(2, sections=" "), "2.0.-1 2.0.-2", "2: has no <laneSection>"),
        (road(2) + road(2), "", r"roads .* id is there twice: 1 \(2\)"),
        (road(2, sections=THREE.replace('id="-2"', 'id="x"')), "2.0.-2", "2.0.x: id of <lane>"),
        (
            road(2, sections=THREE.replace(WIDE, WIDE.replace('"3"', '"wide"'), 1)),
            "2.0.-1 2.0.-2",
            r"a lane further in cannot be read: 2 \(2.0.-2, 2.0.-3\)",
        ),
        (road(2, sections=THREE.replace(WIDE, "", 1)), "2.0.-1", r"have no width: 1 \(2.0.-1\)"),
        (road(2, sections=section(0, right=lane(-1) * 2)), "2.0.-2", "2.0.-1: its number is there"),
        (road(2, sections=section(0, right=lane(-2))), "2.0.-1", r"a gap in .*: 1 \(2.0.-2\)"),
        (
            road(2, sections=section(0, right=lane(-1) + lane(-2)) + section(150, right=lane(-1))),
            "",
            "sections left out because they start after the end of their road: 1 .2: s = 150",
        ),
        (
            road(2, sections=section(0, right=lane(-1, links='<successor id="a"/>') + lane(-2))),
            "",
            "links, marks and speeds .* read: 1 .2.0.-1: id of <successor>",
        ),
        (road(2, more=SIGN.format('<signal id="t" s="x"/>')), "", "signals left .*t on road 2: s"),
        (road(2, more="<objects><object type='crosswalk' id='c'/></objects>"), "", "2/c: has no"),
        (road(2, attributes='rule="left"'), "", "unknown traffic rule, read as RHT: 1 .2: LEFT"),
        (road(2, sections=THREE.replace('a="3"', 'a="-3"', 1)), "2.0.-1", "width below 0 .*2.0.-1"),
    ],
)  # fmt: skip
def test_a_damaged_part_costs_nothing_else(tmp_path, damaged, lost, note):
    """All lanes of other roads, and the other lanes of its own, stay bit for bit."""
    whole = read_roads(tmp_path, road(1), road(2), road(3))
    graph = read_roads(tmp_path, road(1), damaged, road(3))
    assert set(whole.lanes) - set(graph.lanes) == set(lost.split())
    for key in ("1.0.-1", "1.0.-2", "3.0.-1", "3.0.-2"):
        assert np.array_equal(graph.lane(key).centre, whole.lane(key).centre)
        assert np.array_equal(graph.lane(key).widths, whole.lane(key).widths)
    assert whole.notes == ()
    assert (note is None and not graph.notes) or any(re.search(note, n) for n in graph.notes)


@pytest.mark.parametrize(
    ("connection", "note"),
    [
        ('<laneLink from="x" to="-1"/>', "lane links of junctions .*0 of 9: from of <laneLink>"),
        ('<laneLink from="-7" to="-1"/>', r"lane links to a lane that is not there: 1 \(1.0.-7\)"),
        ('contact="middle"', "because of their contact point: 1 .0 of 9: 'middle'"),
        ("no road", r"because they lack a road: 1 \(0 of 9\)"),
    ],
)
def test_a_damaged_connection_costs_no_other(tmp_path, connection, note):
    link = '<laneLink from="-2" to="-2"/>'
    given = 'incomingRoad="1" ' * (connection != "no road") + 'connectingRoad="2" contactPoint='
    damaged = f'<connection id="0" {given}"start">{connection}</connection>'
    if connection.startswith("contact"):
        damaged = f'<connection id="0" {given}"middle">{link}</connection>'
    if connection == "no road":
        damaged = damaged.replace(connection, link)
    sound = f'<connection id="1" incomingRoad="1" connectingRoad="2" contactPoint="start">{link}'
    into = '<link><successor elementType="junction" elementId="9"/></link>'
    junction = f'<junction id="9">{damaged}{sound}</connection></junction>'
    graph = read_roads(tmp_path, road(1, more=into), road(2, attributes=""), junction)
    assert graph.lane("1.0.-2").successors == ("2.0.-2",)
    assert [n for n in graph.notes if re.search(note, n)] == list(graph.notes)


def test_all_damage_of_a_file_is_told_at_once(tmp_path):
    other = road(2).replace('hdg="0"', 'hdg="nan"')
    graph = read_roads(tmp_path, road(1), other, road(3, more=SIGN.format("<signal/>")))
    assert len(graph.notes) == 2


def test_a_map_of_which_more_than_half_is_damaged_is_refused(tmp_path):
    damaged = [road(k).replace('hdg="0"', 'hdg="nan"') for k in (1, 2, 3)]
    assert len(read_roads(tmp_path, *damaged, road(4), road(5), road(6)).lanes) == 6
    with pytest.raises(MapError, match=r"3 of its 5 roads .* more than half.*1: hdg of <geometry>"):
        read_roads(tmp_path, *damaged, road(4), road(5))


@pytest.mark.parametrize(
    ("limit", "speed", "note"),
    [
        ('max="30" unit="MPH"', 30 * 0.44704, None),
        ('max="50" unit="km/h"', 50 / 3.6, None),
        ('max="12.5"', 12.5, None),
        ('max="no limit"', None, None),
        ('max="undefined"', None, None),
        ('max="50" unit="knots"', None, "its unit is 'knots'"),
        ('max="-50" unit="km/h"', None, "'-50', not above 0"),
        ('max="fast"', None, "found 'fast'"),
    ],
)
def test_speed_limits_are_read_in_their_unit_or_noted(tmp_path, limit, speed, note):
    limited = lane(-1, links="").replace("</lane>", f'<speed sOffset="0" {limit}/></lane>')
    graph = read_roads(tmp_path, road(1, sections=section(0, right=limited)))
    assert graph.lane("1.0.-1").speed_limit == (None if speed is None else pytest.approx(speed))
    assert graph.notes == () if note is None else note in graph.notes[0]


def test_gaps_of_profiles_and_geometries_are_noted(tmp_path):
    line = '<geometry s="{}" x="{}" y="0" hdg="0" length="40"><line/></geometry>'
    elevation = '<elevationProfile><elevation s="20" a="5" b="0" c="0" d="0"/></elevationProfile>'
    given = road(1, geometry=line.format(0, 0) + line.format(60, 60), more=elevation)
    assert read_roads(tmp_path, given).notes == (
        "roads with gaps or overlaps between their geometries: 1 (1)",
        "roads whose elevation begins later than they do, 0 before: 1 (1)",
    )


def test_removing_any_element_leaves_the_other_roads_as_they_are(tmp_path):
    """What is read and what the notes count adds up to the roads of the file."""
    links = (
        '<link><predecessor elementType="road" elementId="{}" contactPoint="end"/>'
        '<successor elementType="road" elementId="{}" contactPoint="start"/></link>'
    )
    onward = lane(-1, links='<predecessor id="-1"/><successor id="-1"/>') + lane(-2)
    roads = [
        road(k, more=links.format((k - 2) % 5 + 1, k % 5 + 1), sections=section(0, right=onward))
        for k in range(1, 6)
    ]
    whole = read_roads(tmp_path, *roads)
    text = f"<OpenDRIVE>{''.join(roads)}</OpenDRIVE>"
    paths = [(p, c) for p, e in enumerate(ET.fromstring(text).iter()) for c in range(len(e))]
    for parent, child in paths:
        root = ET.fromstring(text)
        holder = list(root.iter())[parent]
        element = holder[child]
        own = next(r.get("id") for r in root if element in r.iter())
        holder.remove(element)
        graph = read_roads(tmp_path, *(ET.tostring(r, "unicode") for r in root))
        kept = {key: lane for key, lane in whole.lanes.items() if not key.startswith(f"{own}.")}
        for key, before in kept.items():
            assert np.array_equal(graph.lane(key).centre, before.centre)
            assert np.array_equal(graph.lane(key).widths, before.widths)
        told = "; ".join(graph.notes)
        lost = re.search(r"roads left out because they cannot be read: (\d+)", told)
        assert len(graph.roads) + int(lost[1] if lost else 0) == len(root)
        if element.tag == "road" or lost:
            assert "links of roads to a road or junction that is not there: 2" in told
