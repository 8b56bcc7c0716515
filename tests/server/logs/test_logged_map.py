"""Lanes of a log: its own, from a dataset map, or from the recorded drive."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from real2sim_server.geometry import invert_transform
from real2sim_server.logs import LoggedMap, open_log
from real2sim_server.maps import MapError, lanes_of_log
from real2sim_server.scene import Lane, LaneGraph
from real2sim_server.scene.io.document import lane_document


def straight(name: str, start: tuple[float, float], heading: float = 0.0, **more) -> Lane:
    s = np.linspace(0, 60, 31)
    x, y = start[0] + s * np.cos(heading), start[1] + s * np.sin(heading)
    centre = np.column_stack([x, y, np.zeros_like(s)])
    return Lane(name, "driving", centre, np.full(len(s), 3.4), **more)


def placed(yaw: float, x: float, y: float) -> np.ndarray:
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:2, 3] = x, y
    return T


@pytest.fixture
def bare(tiny_log):
    """The drive without lanes."""
    return replace(tiny_log, lanes=None, logged_map=None)


def with_map(log, folder: Path, graph: LaneGraph, T_world_map: np.ndarray):
    """The drive with a dataset map that contains ``graph``, given in the world frame."""
    back = invert_transform(T_world_map)
    moved = graph.moved(float(np.arctan2(back[1, 0], back[0, 0])), back[:3, 3])
    path = folder / "lanes.json"
    path.write_text(lane_document(moved).model_dump_json())
    return replace(log, logged_map=LoggedMap(path, T_world_map))


def test_a_dataset_map_is_transformed_to_the_world(bare, tmp_path):
    graph = LaneGraph.of([straight("a", (-10, 1.5)), straight("b", (0, -2))])
    log = with_map(bare, tmp_path, graph, placed(0.7, 30, -400))
    found = lanes_of_log(log)
    assert set(found.lanes) == {"a", "b"}
    for name, lane in graph.lanes.items():
        np.testing.assert_allclose(found.lane(name).centre, lane.centre, atol=1e-3)


def test_only_lanes_near_the_drive_are_kept(bare, tmp_path):
    near = straight("near", (0, 0), successors=("next",))
    graph = LaneGraph.of([near, straight("next", (60, 0)), straight("far", (4000, 0))])
    found = lanes_of_log(with_map(bare, tmp_path, graph, np.eye(4)))
    assert set(found.lanes) == {"near", "next"}
    assert found.lane("near").successors == ("next",)


def test_a_map_of_another_place_is_refused(bare, tmp_path):
    log = with_map(bare, tmp_path, LaneGraph.of([straight("a", (9000, 0))]), np.eye(4))
    with pytest.raises(MapError, match=r"lanes\.json: no lane of this map is within 250 m"):
        lanes_of_log(log)
    assert lanes_of_log(log, source="none") is None


def test_lanes_of_the_log_take_precedence(tiny_log, tmp_path):
    own = LaneGraph.of([straight("own", (0, 0))])
    log = replace(tiny_log, lanes=own, logged_map=LoggedMap(tmp_path / "missing", np.eye(4)))
    assert lanes_of_log(log) is own


def test_lanes_are_derived_from_the_drive_only_on_request(bare):
    assert lanes_of_log(bare) is None
    gathered = lanes_of_log(bare, source="log")
    assert gathered is None or gathered.accuracy is not None


def test_argoverse_2_logs_have_their_map(written_argoverse2, tmp_path):
    folder = Path(shutil.copytree(written_argoverse2, tmp_path / "log"))
    assert open_log(folder).logged_map is None
    (folder / "map").mkdir()
    (folder / "map" / "log_map_archive_x____PIT_city_1.json").write_text("{}")
    log = open_log(folder)
    assert log.logged_map.path == folder / "map"
    # The world origin is the first pose, so this transform is rigid but arbitrary.
    city = log.logged_map.T_world_map
    np.testing.assert_allclose(city[:3, :3] @ city[:3, :3].T, np.eye(3), atol=1e-9)


def test_nuscenes_logs_use_the_map_expansion_of_their_city(written_nuscenes, tmp_path):
    root = Path(shutil.copytree(written_nuscenes, tmp_path / "set"))
    assert open_log(root).logged_map is None
    tables = next(root.glob("v1.0-*"))
    scenes = json.loads((tables / "scene.json").read_text())
    for scene in scenes:
        scene["log_token"] = "l"
    (tables / "scene.json").write_text(json.dumps(scenes))
    (tables / "log.json").write_text(json.dumps([{"token": "l", "location": "boston-seaport"}]))
    assert open_log(root).logged_map is None
    expansion = root / "maps" / "expansion" / "boston-seaport.json"
    expansion.parent.mkdir(parents=True)
    expansion.write_text("{}")
    log = open_log(root)
    assert log.logged_map.path == expansion
    np.testing.assert_allclose(log.logged_map.T_world_map, log.provenance["T_world_dataset"])


def test_a_real_argoverse_2_drive_lies_on_its_lanes(test_data):
    path = test_data / "argoverse2"
    if not path.is_dir():
        pytest.skip(f"no sample drive at {path}")
    log = open_log(path)
    graph = lanes_of_log(log)
    assert len(graph.lanes) > 50
    start = log.ego.positions[0]
    assert graph.nearest(float(start[0]), float(start[1])) is not None
    assert graph.is_drivable(log.ego.positions[:, :2]).all()
