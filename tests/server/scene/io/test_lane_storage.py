"""Lanes in scene bundles and documents: exact round trips and damage."""

from __future__ import annotations

import json
from dataclasses import fields, replace

import numpy as np
import pytest

from real2sim_server.scene import (
    Area,
    BundleError,
    Lane,
    LaneGraph,
    Road,
    RoadLane,
    Signal,
    StopLine,
)
from real2sim_server.scene.io import load_scene, read_scene_summary, save_scene
from real2sim_server.scene.io.document import graph_of, lane_document, read_lanes


def graph():
    rng = np.random.default_rng(1)
    line = np.cumsum(rng.uniform(0.5, 1, (9, 3)), axis=0)
    lane = Lane("1.0.-1", "driving", line, rng.uniform(3, 4, 9), 13.9, ("b",), opposite="b")
    other = Lane("b", "bus", line[::-1], np.full(9, 3.0), may_change_left=False, junction="4")
    s = np.arange(9.0)
    stretch = RoadLane(-1, "1.0.-1", s, 0 * s, -rng.uniform(3, 4, 9))
    return LaneGraph.of(
        [lane, other],
        areas=[Area("x", "crosswalk", line[:4])],
        stop_lines=[StopLine("w", line[:2], ("b",))],
        signals=[Signal("l", "traffic_light", (1, 2, 3.5), 0.3, ("b",), "w")],
        roads=[Road("1", s, line, rng.uniform(0, 1, 9), 0 * s, (stretch,), drives_right=False)],
        source="test",
        accuracy=0.25,
        geo_reference="+proj=utm",
    )


def same(a, b):
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b)
    if hasattr(a, "__dataclass_fields__"):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if hasattr(a, "items"):
        return list(a) == list(b) and all(same(a[k], b[k]) for k in a)
    if isinstance(a, tuple) and a and hasattr(a[0], "__dataclass_fields__"):
        return len(a) == len(b) and all(map(same, a, b))
    return a == b


def test_lanes_round_trip_exactly_in_bundles(tiny_scene, tmp_path):
    saved = save_scene(replace(tiny_scene, lanes=graph()), tmp_path / "a.r2s")
    assert same(load_scene(tmp_path / "a.r2s").lanes, graph())
    summary = read_scene_summary(tmp_path / "a.r2s")
    assert summary.lane_count == 2
    assert same(summary.lanes, graph())
    assert saved.content_hash != save_scene(tiny_scene, tmp_path / "b.r2s").content_hash


def test_a_scene_without_lanes_is_written_without_them(tiny_scene, tmp_path):
    save_scene(tiny_scene, tmp_path / "a.r2s")
    document = json.loads((tmp_path / "a.r2s" / "scene.json").read_text())
    assert "lanes" not in document["content"]
    assert load_scene(tmp_path / "a.r2s").lanes is None
    assert read_scene_summary(tmp_path / "a.r2s").lanes is None


def test_lanes_round_trip_in_documents(tmp_path):
    document = lane_document(graph())
    assert same(graph_of(document), graph())
    (tmp_path / "lanes.json").write_text(document.model_dump_json())
    assert same(read_lanes(tmp_path / "lanes.json"), graph())


@pytest.mark.parametrize("change", [{"points": 8}, {"centre": -1}, {"lane_id": "b"}])
def test_inconsistent_lanes_are_refused(tiny_scene, tmp_path, change):
    save_scene(replace(tiny_scene, lanes=graph()), tmp_path / "a.r2s")
    path = tmp_path / "a.r2s" / "scene.json"
    document = json.loads(path.read_text())
    part = document["content"]["lanes"]
    (part if "points" in change else part["document"]["lanes"][0]).update(change)
    path.write_text(json.dumps(document))
    with pytest.raises(BundleError, match=r"a\.r2s"):
        load_scene(tmp_path / "a.r2s", verify=False)


def test_a_file_that_is_not_a_lane_document_is_refused(tmp_path):
    (tmp_path / "lanes.json").write_text('{"lanes": [{"lane_id": "a"}]}')
    with pytest.raises(BundleError, match=r"lanes\.json.*kind"):
        read_lanes(tmp_path / "lanes.json")
