"""Lanelet2, Argoverse 2, nuScenes and the project's own document: what each tells of lanes."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from real2sim.cli import build_app
from real2sim_server.maps import MAP_READERS, MapError, read_map
from real2sim_server.maps.reader import between
from real2sim_server.scene import Lane
from real2sim_server.scene.io import save_scene
from real2sim_server.scene.io.document import lane_document

NODES = {
    1: (0, 3),
    2: (40, 3),
    3: (0, 0),
    4: (40, 0),
    5: (80, 3),
    6: (80, 0),
    7: (0, -3),
    8: (40, -3),
}
WAYS = {
    11: ([1, 2], {"type": "line_thin", "subtype": "solid"}),
    12: ([3, 4], {"type": "line_thin", "subtype": "dashed"}),
    13: ([2, 5], {}),
    14: ([4, 6], {}),
    15: ([7, 8], {"type": "curbstone"}),
    16: ([4, 2], {"type": "stop_line"}),
    17: ([6, 5], {"type": "traffic_light"}),
}
LANELETS = {21: (11, 12), 22: (13, 14), 23: (12, 15)}


def written_lanelet2(folder):
    def tags(values):
        return "".join(f'<tag k="{k}" v="{v}"/>' for k, v in values.items())

    parts = [
        f'<node id="{n}" lat="0" lon="0">{tags({"local_x": x, "local_y": y, "ele": 1})}</node>'
        for n, (x, y) in NODES.items()
    ]
    for way, (nodes, values) in WAYS.items():
        refs = "".join(f'<nd ref="{n}"/>' for n in nodes)
        parts.append(f'<way id="{way}">{refs}{tags(values)}</way>')
    for key, (left, right) in LANELETS.items():
        rules = '<member type="relation" role="regulatory_element" ref="31"/>' * (key == 21)
        rules += '<member type="relation" role="regulatory_element" ref="32"/>'
        parts.append(
            f'<relation id="{key}"><member type="way" role="left" ref="{left}"/>'
            f'<member type="way" role="right" ref="{right}"/>{rules}'
            f"{tags({'type': 'lanelet', 'subtype': 'road'})}</relation>"
        )
    light = {"type": "regulatory_element", "subtype": "traffic_light"}
    limit = {"type": "regulatory_element", "subtype": "speed_limit", "sign_type": "30 km/h"}
    parts.append(
        '<relation id="31"><member type="way" role="refers" ref="17"/>'
        f'<member type="way" role="ref_line" ref="16"/>{tags(light)}</relation>'
        f'<relation id="32">{tags(limit)}</relation>'
    )
    path = folder / "map.osm"
    path.write_text(f"<osm>{''.join(parts)}</osm>")
    return path


def written_argoverse2(folder):
    def line(y):
        return [{"x": x, "y": y, "z": 0.0} for x in (0.0, 40.0)]

    def segment(name, left, right, **more):
        return {
            "id": name, "is_intersection": False, "lane_type": "VEHICLE",
            "left_lane_boundary": left, "right_lane_boundary": right,
            "left_lane_mark_type": "DASHED_WHITE", "right_lane_mark_type": "SOLID_WHITE",
            "successors": [99], "predecessors": [], "left_neighbor_id": None,
            "right_neighbor_id": None, **more,
        }  # fmt: skip

    content = {
        "lane_segments": {
            "1": segment(1, line(3.0), line(0.0), left_neighbor_id=2),
            "2": segment(2, line(3.0)[::-1], line(6.0)[::-1], left_neighbor_id=1),
        },
        "drivable_areas": {"7": {"id": 7, "area_boundary": [*line(-1.0), *line(7.0)[::-1]]}},
        "pedestrian_crossings": {"8": {"id": 8, "edge1": line(1.0), "edge2": line(2.0)}},
    }
    path = folder / "log_map_archive_x____PIT_city_1.json"
    path.write_text(json.dumps(content))
    return path


def written_nuscenes(folder):
    corners = {"a": (0, -2), "b": (30, -2), "c": (30, 2), "d": (0, 2)}
    path = [
        {"start_pose": [0, 0, 0], "end_pose": [0, 0, 0], "shape": "LSR", "radius": 20.0,
         "segment_length": [10.0, 10.0, 10.0]}
    ]  # fmt: skip
    content = {
        "arcline_path_3": {"l": path},
        "connectivity": {"l": {"incoming": [], "outgoing": ["gone"]}},
        "node": [{"token": k, "x": x, "y": y} for k, (x, y) in corners.items()],
        "polygon": [{"token": "p", "exterior_node_tokens": list(corners)}],
        "line": [],
        "lane": [{"token": "l", "polygon_token": "p"}],
        "drivable_area": [{"token": "r", "polygon_tokens": ["p"]}],
        "stop_line": [{"token": "w", "polygon_token": "p", "traffic_light_tokens": ["t"]}],
        "traffic_light": [{"token": "t", "pose": {"tx": 1, "ty": 2, "tz": 3, "rz": 0.5}}],
    }
    file = folder / "boston.json"
    file.write_text(json.dumps(content))
    return file


def written_native(folder):
    graph = read_map(written_argoverse2(folder))
    path = folder / "lanes.json"
    path.write_text(lane_document(graph).model_dump_json())
    return path


def written_opendrive(folder):
    path = folder / "map.xodr"
    path.write_text(
        '<OpenDRIVE><header revMajor="1" revMinor="7"/><road id="1" length="40"><planView>'
        '<geometry s="0" x="0" y="0" hdg="0" length="40"><line/></geometry></planView><lanes>'
        '<laneSection s="0"><right><lane id="-1" type="driving"><width sOffset="0" a="3" b="0" '
        'c="0" d="0"/></lane></right></laneSection></lanes></road></OpenDRIVE>'
    )
    return path


@pytest.mark.parametrize("reader", MAP_READERS, ids=lambda reader: reader.name)
def test_every_reader_passes_the_contract(reader, tmp_path):
    """Its own file is recognised by it alone, read the same twice, and refused by name when cut."""
    path = globals()[f"written_{reader.name}"](tmp_path)
    assert [r.name for r in MAP_READERS if r.recognises(path)] == [reader.name]
    graph = read_map(path)
    assert graph.lanes
    assert lane_document(graph) == lane_document(read_map(path, format=reader.name))
    assert not reader.recognises(tmp_path / "nothing")
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(MapError, match=path.name):
        read_map(path, format=reader.name)


DECLARATION = '<?xml version="1.0" encoding="UTF-8"?>'


@pytest.mark.parametrize("name", ["opendrive", "lanelet2"])
@pytest.mark.parametrize(
    ("before", "encoding"),
    [
        (f"<!-- made by hand -->\n{DECLARATION}", "utf-8"),
        (f"\n\n  {DECLARATION}", "utf-8"),
        (f"\n<!-- one --> <!-- two -->{DECLARATION}<!-- three -->", "utf-8-sig"),
        (f"<!-- made by hand -->{DECLARATION.replace('UTF-8', 'UTF-16')}", "utf-16"),
    ],
)
def test_comments_may_precede_the_xml_declaration(tmp_path, name, before, encoding):
    path = globals()[f"written_{name}"](tmp_path)
    lanes = read_map(path).lanes
    path.write_text(before + path.read_text(), encoding=encoding)
    assert list(read_map(path).lanes) == list(lanes)


@pytest.mark.parametrize("name", ["opendrive", "lanelet2"])
def test_a_document_type_is_refused_in_any_encoding(tmp_path, name):
    """Without its byte order mark, UTF-16 is still XML."""
    path = globals()[f"written_{name}"](tmp_path)
    text = (
        f"<?xml version='1.0' encoding='utf-16'?><!DOCTYPE a [<!ENTITY b 'c'>]>{path.read_text()}"
    )
    path.write_bytes(text.encode("utf-16-le"))
    with pytest.raises(MapError, match="document type"):
        read_map(path)


@pytest.mark.parametrize("name", ["opendrive", "lanelet2"])
def test_suffixes_may_be_upper_case(tmp_path, name):
    path = globals()[f"written_{name}"](tmp_path)
    path = path.rename(path.with_suffix(path.suffix.upper()))
    path.write_text("<!--" + " " * 5000 + "-->" + path.read_text())
    assert read_map(path).lanes


@pytest.mark.parametrize("name", ["opendrive", "lanelet2"])
@pytest.mark.parametrize("prefix", ["", "m:"])
def test_xml_namespaces_are_ignored(tmp_path, name, prefix):
    """Elements of another namespace are not read as parts of the map."""
    path = globals()[f"written_{name}"](tmp_path)
    plain = lane_document(read_map(path))
    text = re.sub(r"<(/?)(?=\w)", rf"<\1{prefix}", path.read_text())
    declared = f"xmlns{':m' if prefix else ''}='http://example.org/map' xmlns:v='http://v.org'"
    text = re.sub(r"^<\S+?(?=>)", rf"\g<0> {declared}", text)
    text = text.replace(f"</{prefix}laneSection>", f"<v:lane id='9'/></{prefix}laneSection>")
    path.write_text(text)
    assert lane_document(read_map(path)) == plain


def test_lanelets_are_joined_by_their_points_and_ruled_by_their_elements(tmp_path):
    graph = read_map(written_lanelet2(tmp_path))
    first, beside = graph.lane("21"), graph.lane("23")
    assert (first.successors, first.right, beside.left) == (("22",), "23", "21")
    assert graph.gaps["21", "22"] == 0
    assert first.at(10.0) == pytest.approx((10.0, 1.5, 1.0, 0.0))
    assert first.speed_limit == pytest.approx(30 / 3.6)
    assert (first.may_change_left, first.may_change_right) == (False, True)
    light = graph.signals["31"]
    assert (light.kind, light.lanes, light.stop_line) == ("traffic_light", ("21",), "16")
    np.testing.assert_allclose(graph.stop_lines["16"].points[:, 0], 40.0)


@pytest.fixture
def from_map(tiny_scene, tmp_path):
    """What ``real2sim map --from FILE`` gives a scene: the lanes, the figures and the output."""
    save_scene(tiny_scene, tmp_path / "scene.r2s")

    def read(osm):
        path, lanes, figures = (tmp_path / name for name in ("map.osm", "lanes.json", "told.json"))
        path.write_text(f"<osm>{osm}</osm>")
        given = ["map", tmp_path / "scene.r2s", "--from", path, "--as-it-is", "--out", lanes]
        done = CliRunner().invoke(build_app(), [str(a) for a in (*given, "--json", figures)])
        assert done.exit_code == 0, done.output
        return json.loads(lanes.read_text())["lanes"], json.loads(figures.read_text()), done.output

    return read


def lanelet(number, sides=("left", "right"), more="", action=""):
    """A lanelet 3 m beside the one before, of its own nodes and ways."""
    parts = []
    for i, side in enumerate(sides):
        y, key = 3 * number - i, f"{number}{i}"
        for n, x in enumerate((0, 40)):
            place = f'<tag k="local_x" v="{x}"/><tag k="local_y" v="{y}"/>'
            parts.append(f'<node id="{key}{n}" lat="0" lon="0"{action}>{place}</node>')
        parts.append(f'<way id="{key}"{action}><nd ref="{key}0"/><nd ref="{key}1"/></way>')
        more += f'<member type="way" role="{side}" ref="{key}"/>'
    tags = '<tag k="type" v="lanelet"/><tag k="subtype" v="road"/>'
    return "".join(parts) + f'<relation id="l{number}"{action}>{more}{tags}</relation>'


def limited_by(sign, key="9"):
    tags = {"type": "regulatory_element", "subtype": "speed_limit", "sign_type": sign}
    rule = "".join(f'<tag k="{k}" v="{v}"/>' for k, v in tags.items())
    return lanelet(1, more=f'<member type="relation" role="regulatory_element" ref="{key}"/>') + (
        f'<relation id="{key}">{rule}</relation>'
    )


def test_elements_marked_as_deleted_are_ignored(from_map):
    lanes, figures, _ = from_map(lanelet(1) + lanelet(2, action=' action="delete"'))
    assert [lane["lane_id"] for lane in lanes] == ["l1"]
    assert figures["notes"] == []


@pytest.mark.parametrize("attribute", ['action="delete"', 'visible="false"'])
def test_references_to_deleted_or_absent_elements_are_noted(tmp_path, attribute):
    """The rest is read: a way without its deleted node, a lanelet without its rule."""
    more = '<member type="relation" role="regulatory_element" ref="{}"/>'
    osm = lanelet(1, more=more.format(8) + more.format(9)) + f'<relation id="8" {attribute}/>'
    osm = osm.replace('<nd ref="100"/>', '<nd ref="100"/><nd ref="5"/><nd ref="6"/>', 1)
    path = tmp_path / "map.osm"
    path.write_text(f'<osm>{osm}<node id="5" lat="0" lon="0" {attribute}/></osm>')
    graph = read_map(path)
    assert graph.lane("l1").length == pytest.approx(40.0)
    assert graph.notes == (
        "ways read without nodes that are not there: 1 (10)",
        "relations read without members that are not there: 2 "
        "(l1 without relation 8, l1 without relation 9)",
    )


@pytest.mark.parametrize(
    ("sign", "limit"),
    [
        ("de274-60", 60), ("de274.1-60", 60), ("60", 60), ("60 km/h", 60), ("de274-15", 15),
        ("de274", 30), ("de274_1", 30), ("de274_1-20", 20), ("de310", 50),
    ],
)  # fmt: skip
def test_a_limit_given_by_a_sign_is_read(from_map, sign, limit):
    lanes, figures, _ = from_map(limited_by(sign))
    assert lanes[0]["speed_limit"] == pytest.approx(limit / 3.6)
    assert figures["notes"] == []


def tagged(osm, **tags):
    """The OSM text with these tags on its lanelets."""
    more = "".join(f'<tag k="{k.replace("__", ":")}" v="{v}"/>' for k, v in tags.items())
    return osm.replace('<tag k="subtype" v="road"/>', more)


def read_osm(folder, osm):
    path = folder / "map.osm"
    path.write_text(f"<osm>{osm}</osm>")
    return read_map(path)


def test_a_limit_comes_from_the_traffic_sign_that_a_rule_refers_to(tmp_path):
    """Before the tags of the lanelet."""
    member = '<member type="relation" role="regulatory_element" ref="9"/>'
    rule = (
        '<way id="8"><tag k="type" v="traffic_sign"/><tag k="subtype" v="de274-50"/></way>'
        '<relation id="9"><member type="way" role="refers" ref="8"/>'
        '<tag k="type" v="regulatory_element"/><tag k="subtype" v="speed_limit"/></relation>'
    )
    tags = {"subtype": "road", "location": "nonurban", "speed_limit": "70"}
    graph = read_osm(tmp_path, tagged(lanelet(1, more=member), **tags) + rule)
    assert graph.lane("l1").speed_limit == pytest.approx(50 / 3.6)
    assert graph.notes == ()


@pytest.mark.parametrize(
    ("tags", "limit"),
    [
        ({"subtype": "road", "location": "urban"}, 50),
        ({"subtype": "road", "location": "nonurban"}, 100),
        ({"subtype": "bus_lane", "location": "urban"}, 50),
        ({"subtype": "highway", "location": "nonurban"}, 130),
        ({"subtype": "play_street"}, 7),
        ({"subtype": "road", "location": "urban", "region": "de-bw"}, 50),
        ({"subtype": "road", "location": "urban", "region": "us-ca"}, None),
        ({"subtype": "road"}, None),
        ({"subtype": "walkway", "location": "urban"}, None),
        ({"subtype": "road", "location": "urban", "speed_limit__vehicle": "60"}, 60),
    ],
)
def test_german_limits_follow_from_the_kind_of_road(tmp_path, tags, limit):
    graph = read_osm(tmp_path, tagged(lanelet(1), **tags))
    given = graph.lane("l1").speed_limit
    assert given == (None if limit is None else pytest.approx(limit / 3.6))
    noted = limit is not None and "speed_limit__vehicle" not in tags
    assert graph.notes == (
        ("lanes with the speed limit of their kind of road in Germany: 1 (l1)",) if noted else ()
    )


@pytest.mark.parametrize(
    ("towards", "allowed"), [("left", (True, False)), ("right", (False, True))]
)
def test_lane_changes_may_be_allowed_in_one_direction(tmp_path, towards, allowed):
    other = {"left": "right", "right": "left"}[towards]
    marks = f'<tag k="lane_change:{towards}" v="yes"/><tag k="lane_change:{other}" v="no"/></way>'
    lane = read_osm(tmp_path, lanelet(1).replace("</way>", marks)).lane("l1")
    assert (lane.may_change_left, lane.may_change_right) == allowed


def mitred(centre, width, skew):
    """Borders of a lane with kinks: parallels of its centre line, whose ends are not square."""
    headings = np.unwrap(np.arctan2(*np.diff(centre, axis=0).T[::-1]))
    turns = np.pad(np.diff(headings), 1)
    mean = np.concatenate([headings[:1], (headings[:-1] + headings[1:]) / 2, headings[-1:]])
    aside = np.column_stack([-np.sin(mean), np.cos(mean)]) / np.cos(turns / 2)[:, None]
    rims = []
    for side in (1, -1):
        rim = centre + side * width / 2 * aside
        along = np.column_stack([np.cos(headings), np.sin(headings)])
        rim[0] -= side * skew[0] * along[0]
        rim[-1] += side * skew[1] * along[-1]
        rims.append(np.column_stack([rim, np.zeros(len(rim))]))
    return rims


def away(points, line):
    """Distances of points from a line whose ends go on straight."""
    ends = line[[0, -1]] + 100 * (line[[0, -1]] - line[[1, -2]])
    line = np.concatenate([ends[:1], line, ends[1:]])[:, :2]
    step = np.diff(line, axis=0)
    rest = points[:, None, :2] - line[:-1]
    squares = np.maximum((step * step).sum(axis=1), 1e-12)
    share = np.clip((rest * step).sum(axis=2) / squares, 0, 1)
    return np.linalg.norm(rest - share[..., None] * step, axis=2).min(axis=1)


@pytest.mark.parametrize("seed", range(40))
def test_the_borders_of_a_kinked_lane_follow_the_given_ones(seed):
    rng = np.random.default_rng(seed)
    headings = np.cumsum(np.radians([0, *rng.uniform(-50, 50, rng.integers(1, 6))]))
    steps = rng.uniform(5, 25, (len(headings), 1))
    along = np.column_stack([np.cos(headings), np.sin(headings)]) * steps
    centre = np.concatenate([np.zeros((1, 2)), np.cumsum(along, axis=0)])
    width = rng.uniform(2.5, 4.0)
    given = mitred(centre, width, rng.uniform(-0.5, 0.5, 2))
    points, widths = between(*given)
    lane = Lane("a", "driving", points, widths)
    assert away(points, np.pad(centre, ((0, 0), (0, 1)))).max() < 0.03
    for rim, line in zip(lane.rims, given, strict=True):
        assert away(rim, line).max() < 0.05
        assert away(line, rim).max() < 0.05
    np.testing.assert_allclose(points[[0, -1]], (given[0] + given[1])[[0, -1]] / 2, atol=1e-9)


def test_the_borders_of_a_straight_lane_stay_even():
    x = np.linspace(0.0, 10.0, 11)
    left, right = (np.column_stack([x, np.full(11, y), x * 0]) for y in (3.0, 0.0))
    points, widths = between(left, right)
    np.testing.assert_array_equal(points, (left + right) / 2)
    np.testing.assert_array_equal(widths, np.full(11, 3.0))


@pytest.mark.parametrize("sign", ["de274-56", "usR2-1", "1.2.3"])
def test_an_unreadable_speed_limit_is_noted(from_map, sign):
    lanes, figures, told = from_map(limited_by(sign))
    assert lanes[0]["speed_limit"] is None
    [note] = figures["notes"]
    assert f"{sign!r} is not known: 1 (l1)" in note
    assert note in told


@pytest.mark.parametrize("side", ["left", "right"])
def test_lanelets_without_a_boundary_are_noted(from_map, side):
    whole = lanelet(1) + lanelet(4)
    lanes, figures, told = from_map(whole + lanelet(2, [side]) + lanelet(3, [side]))
    assert [lane["lane_id"] for lane in lanes] == ["l1", "l4"]
    [note] = figures["notes"]
    assert "lack a rim: 2 (l2, l3)" in note
    assert note in told


def test_segments_of_argoverse_2_have_middles_neighbours_and_areas(tmp_path):
    graph = read_map(written_argoverse2(tmp_path))
    lane = graph.lane("1")
    assert lane.at(10.0)[:2] == pytest.approx((10.0, 1.5))
    assert (lane.opposite, lane.left, lane.successors) == ("2", None, ())
    assert (lane.may_change_left, lane.may_change_right) == (True, False)
    assert graph.is_drivable([[20, -0.5], [20, -1.5]]).tolist() == [True, False]
    assert graph.areas["crossing_8"].kind == "crosswalk"


def test_arcs_of_nuscenes_are_followed(tmp_path):
    lane = read_map(written_nuscenes(tmp_path)).lane("l")
    assert lane.length == pytest.approx(30.0, rel=1e-3)
    end = lane.at(lane.length)
    up = 20 * (1 - math.cos(0.5))
    assert end[0] == pytest.approx(40 * math.sin(0.5) + 10 * math.cos(0.5), abs=1e-6)
    assert end[1] == pytest.approx(2 * up + 10 * math.sin(0.5), abs=1e-6)
    assert lane.widths[0] == pytest.approx(4.0, rel=1e-2)


def test_a_real_map_of_argoverse_2_has_no_gaps_and_carries_its_drive(test_data):
    folder = next(Path(test_data, "argoverse2").glob("7fab*"))
    graph = read_map(folder)
    assert len(graph.lanes) == 183
    assert max(graph.gaps.values()) < 0.01


def grown(folder, reader, count=4):
    """The content of a reader's own file with ``count`` copies of what is driven on."""
    content = json.loads(globals()[f"written_{reader}"](folder).read_text())
    if reader == "argoverse2":
        one = json.dumps(content["lane_segments"]["1"])
        more = {str(k): json.loads(one) | {"id": k} for k in range(10, 10 + count)}
        content["lane_segments"] |= more
    else:
        content["lane"] += [content["lane"][0] | {"token": f"l{k}"} for k in range(count)]
        paths = content["arcline_path_3"]
        paths |= {f"l{k}": json.loads(json.dumps(paths["l"])) for k in range(count)}
    return content


def change(content, place, value):
    """Set a value in nested containers, or remove it (None)."""
    for name in place[:-1]:
        content = content[int(name) if isinstance(content, list) else name]
    last = int(place[-1]) if isinstance(content, list) else place[-1]
    if value is None:
        content.pop(last, None)
    else:
        content[last] = value


@pytest.mark.parametrize(
    ("reader", "place", "value", "note"),
    [
        ("argoverse2", "lane_segments 10 left_lane_boundary", [], "10: has no length"),
        ("argoverse2", "lane_segments 10 left_lane_boundary 0 x", math.nan, "10: its borders"),
        ("argoverse2", "lane_segments 10 lane_type", None, "lane segments .*10: lacks 'lane_type'"),
        ("argoverse2", "lane_segments 10 left_neighbor_id", 77, "not in the file: .*10 to 77"),
        ("argoverse2", "drivable_areas 7 area_boundary", None, "areas .*7: lacks 'area_boundary'"),
        ("argoverse2", "pedestrian_crossings 8 edge1", "x", "crossings .*8: TypeError"),
        ("argoverse2", "drivable_areas", [], "not objects: 1 .drivable_areas"),
        ("nuscenes", "stop_line", {}, "not lists: 1 .stop_line"),
        ("nuscenes", "lane 1 polygon_token", "gone", r"3.5 m, because they have no .*\(l0\)"),
        ("nuscenes", "arcline_path_3 l0 0 radius", "x", "lanes left out .*l0: ValueError"),
        ("nuscenes", "arcline_path_3 l0", [], "lanes left out .*l0: has no arcline_path_3"),
        ("nuscenes", "lane 1", 7, "lanes left out .*row 1: TypeError"),
        ("nuscenes", "lane 1 token", "l", r"lanes left out .* twice: 1 \(l\)"),
        ("nuscenes", "node 0 x", None, "polygons left out .*p: lacks 'a'"),
        ("nuscenes", "stop_line 0 polygon_token", "gone", "stop lines .*w: has no polygon 'gone'"),
        ("nuscenes", "traffic_light 0 pose", {}, "signals left out .*t: lacks 'tx'"),
    ],
)
def test_a_damaged_record_is_left_out_and_told(tmp_path, reader, place, value, note):
    """The other lanes are those of the file without the damage."""
    content, graph = grown(tmp_path, reader), {}
    path = tmp_path / "log_map_archive_x.json"
    for name in ("whole", "damaged"):
        path.write_text(json.dumps(content))
        graph[name] = read_map(path, format=reader)
        change(content, place.split(), value)
    assert any(re.search(note, told) for told in graph["damaged"].notes), graph["damaged"].notes
    assert len(graph["whole"].lanes) - len(graph["damaged"].lanes) <= 1
    for key, lane in graph["damaged"].lanes.items():
        assert np.array_equal(lane.centre, graph["whole"].lane(key).centre)


@pytest.mark.parametrize(
    ("old", "new", "lost", "note"),
    [
        ('<tag k="local_x" v="0"/>', '<tag k="local_x" v="x"/>', ["l1"], "nodes .*local_x is 'x'"),
        ('<tag k="local_x" v="0"/>', "", ["l1"], r"nodes .* lack local_x and local_y: 1 \(100\)"),
        ('<nd ref="100"/>', "", ["l1"], r"lack a rim: 1 \(l1\)"),
        ('<tag k="local_x" v="40"/>', '<tag k="local_x" v="9e8"/>', ["l1"], "l1: its borders are"),
        ('<way id="10">', '<way id="20">', ["l1"], r"ways left out .* twice: 1 \(20\)"),
        ('<relation id="l2">', '<relation id="l1">', ["l2"], r"relations .* twice: 1 \(l1\)"),
    ],
)
def test_a_damaged_lanelet_costs_no_other(tmp_path, old, new, lost, note):
    osm = lanelet(1) + lanelet(2) + lanelet(3)
    whole, graph = read_osm(tmp_path, osm), read_osm(tmp_path, osm.replace(old, new, 1))
    assert sorted(set(whole.lanes) - set(graph.lanes)) == lost
    assert any(re.search(note, told) for told in graph.notes), graph.notes


def test_ways_that_do_not_continue_a_border_are_noted(tmp_path):
    graph = read_osm(tmp_path, lanelet(1, ("left", "right", "left")) + lanelet(4))
    assert graph.notes == ("ways left out because they do not continue a border: 1 (12)",)


@pytest.mark.parametrize(
    ("sign", "speed"),
    [
        ("usR2-1-35", 35 * 0.44704), ("US:R2-1[35]", 35 * 0.44704), ("DE:274[60]", 60 / 3.6),
        ("FR:B14[50]", 50 / 3.6), ("GB:670[V30]", 30 * 0.44704), ("30 MPH", 30 * 0.44704),
    ],
)  # fmt: skip
def test_signs_of_other_notations_give_their_limit(tmp_path, sign, speed):
    graph = read_osm(tmp_path, limited_by(sign))
    assert graph.lane("l1").speed_limit == pytest.approx(speed)
    assert graph.notes == ()
