"""Point clouds of scenarios: positions, objects and normals of Gaussians."""

from __future__ import annotations

import numpy as np

from real2sim_proto.conventions import GROUND, SEMANTIC_CLASSES
from real2sim_proto.operations import Translate
from real2sim_server.cli import export as command
from real2sim_server.edit import ScenarioState, apply_operations
from real2sim_server.edit.compose import ROW, ply_of_points, points_at
from real2sim_server.scene.io import save_scene
from real2sim_server.scene.io.ply import read_ply_elements


def test_points_cover_background_and_objects_at_an_instant(tiny_scene):
    state = ScenarioState.of(tiny_scene)
    rows = points_at(tiny_scene, state, 0)
    parts = [points_at(tiny_scene, state, 0, part=part) for part in ("background", "objects")]
    assert len(rows) == sum(map(len, parts))
    assert set(np.unique(parts[0]["instance"])) == {0}
    assert (parts[0]["semantic"] == GROUND).any()
    placed = state.tracks.at(0)
    for subject, pose, size in zip(placed.objects, placed.transforms, placed.sizes, strict=True):
        own = rows[rows["instance"] == subject.instance_id]
        assert len(own)
        places = np.stack([own[axis] for axis in "xyz"], axis=1)
        assert (np.abs(places - pose[:3, 3]) <= np.linalg.norm(size)).all()
        if subject.category == "car":
            assert set(own["semantic"]) == {SEMANTIC_CLASSES["car"]}


def test_normals_are_unit_vectors_and_ground_normals_point_up(tiny_scene):
    rows = points_at(tiny_scene, ScenarioState.of(tiny_scene), 0, part="background")
    normals = np.stack([rows[f"n{axis}"] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    flat = (rows["semantic"] == GROUND) & (np.abs(normals[:, 2]) > 0.9)
    assert (normals[flat, 2] > 0).all()


def test_points_of_a_moved_object_have_moved(tiny_scene):
    state = ScenarioState.of(tiny_scene)
    edits = [Translate(object_id="car_blue", x=2.0, y=0.0, z=0.0)]
    number = state.objects["car_blue"].instance_id
    before = points_at(tiny_scene, state, 0, instance_id=number)
    moved = apply_operations(state, edits).state
    after = points_at(tiny_scene, moved, 0, instance_id=number)
    np.testing.assert_allclose(after["x"] - before["x"], 2.0, atol=1e-4)


def test_the_command_writes_one_file_or_one_per_object(tiny_scene, tmp_path):
    save_scene(tiny_scene, tmp_path / "tiny.r2s")
    whole, apart = tmp_path / "all.ply", tmp_path / "apart"
    for out in (whole, apart):
        command.export(scene=tmp_path / "tiny.r2s", out=out, file_format="points", t_us=500_000)
    found = read_ply_elements(whole)["vertex"]
    assert found.dtype.names == ROW.names
    names = {path.stem for path in apart.iterdir()}
    assert names == {"background", *tiny_scene.objects}
    counts = [len(read_ply_elements(path)["vertex"]) for path in apart.iterdir()]
    assert sum(counts) == len(found)


def test_a_file_without_points_has_a_header(tmp_path):
    (tmp_path / "none.ply").write_bytes(b"".join(ply_of_points(np.zeros(0, ROW))))
    assert len(read_ply_elements(tmp_path / "none.ply")["vertex"]) == 0
