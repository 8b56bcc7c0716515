"""OpenDRIVE against closed forms worked out another way, and against maps that others write."""

from __future__ import annotations

import math
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


def one_road(tmp_path, geometry, length, *, offset="", more=""):
    path = tmp_path / "map.xodr"
    path.write_text(
        f'<OpenDRIVE>{HEADER}<road id="7" length="{length!r}" junction="-1"><planView>'
        f"{geometry}</planView>{LANES.format(offset=offset)}{more}</road></OpenDRIVE>"
    )
    return path


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
    plan = read_plan_view(ET.fromstring(f"<road><planView>{geometry}</planView></road>"), "here")
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


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("<OpenDRIVE", "not an XML"),
        ("<map/>", "expected <OpenDRIVE>"),
        (f"<OpenDRIVE>{HEADER}</OpenDRIVE>", "no <road>"),
        ('<OpenDRIVE><header revMajor="2" revMinor="0"/></OpenDRIVE>', "2.0"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><OpenDRIVE/>', "document type"),
        (f'<OpenDRIVE>{HEADER}<road id="a" length="5"/></OpenDRIVE>', "road 'a'.*planView"),
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
