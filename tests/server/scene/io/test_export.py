import json

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from real2sim.cli import build_app
from real2sim_server.geometry import apply_transform
from real2sim_server.scene import (
    BundleError,
    GaussianCloud,
    SceneError,
    Trajectory,
    UnknownObjectError,
)
from real2sim_server.scene.io import (
    export_scene,
    import_exported,
    import_splats,
    load_scene,
    read_splats,
    save_scene,
)
from real2sim_server.scene.io.export import bake

SPLATS = ["ply", "compressed.ply", "spz", "splat"]


@pytest.fixture
def t_us(scene):
    return scene.start_us + 130_000


def extent(cloud):
    return cloud.means.amin(0).tolist() + cloud.means.amax(0).tolist()


@pytest.mark.parametrize("name", SPLATS)
def test_a_baked_scene_holds_all_gaussians_at_their_poses(scene, t_us, tmp_path, name):
    (file,) = export_scene(scene, tmp_path / f"a.{name}", format=name, t_us=t_us)
    back = import_splats(file, name="a").background
    expected = [scene.background.means.numpy()]
    for scene_object in scene.objects.values():
        pose = scene_object.trajectory.transform(t_us)
        expected.append(apply_transform(pose, scene_object.cloud.means.numpy()))
    expected = np.concatenate(expected)
    assert len(back) == len(expected) == scene.gaussian_count
    given = back.means.numpy()
    # Some formats reorder Gaussians, so match the nearest points in both directions.
    distances = np.linalg.norm(given[:, None] - expected[None], axis=2)
    # A chunk spans about 60 m, and compressed ply quantises it to at least 1023 steps.
    assert distances.min(axis=0).max() < (0.06 if name == "compressed.ply" else 4e-4)
    assert distances.min(axis=1).max() < (0.06 if name == "compressed.ply" else 4e-4)


@pytest.mark.parametrize(
    ("name", "axis", "within"),
    [("spz", "y", 1e-3), ("ply", "z", 1e-6), ("compressed.ply", "z", 1e-3), ("splat", "z", 1e-6)],
)
def test_exported_files_import_with_the_same_extent(scene, t_us, tmp_path, name, axis, within):
    save_scene(scene, tmp_path / "a.r2s")

    def run(*words):
        figures = tmp_path / "figures.json"
        done = CliRunner().invoke(build_app(), [*map(str, words), "--json", str(figures)])
        assert done.exit_code == 0, done.output
        return json.loads(figures.read_text())

    file = tmp_path / f"out.{name}"
    told = run("export", tmp_path / "a.r2s", "--out", file, "--format", name, "--t-us", t_us)
    back = run("import", file, "--out", tmp_path / "b.r2s")
    assert (told["up_axis"], back["up_axis"]) == (axis, axis)
    expected = extent(bake(scene, t_us))
    assert extent(load_scene(tmp_path / "b.r2s").background) == pytest.approx(expected, abs=within)


def test_a_baked_ply_holds_the_clouds_in_the_world_frame(scene, t_us, tmp_path):
    export_scene(scene, tmp_path / "a.ply", format="ply", t_us=t_us)
    back, expected = read_splats(tmp_path / "a.ply"), bake(scene, t_us)
    assert torch.equal(back.means, expected.means)
    assert torch.equal(back.sh, expected.sh)
    placed = scene.objects["car_7"].cloud.moved(scene.objects["car_7"].trajectory.transform(t_us))
    n = len(scene.background)
    assert torch.equal(back.means[n : n + len(placed)], placed.means)


def test_objects_absent_at_the_time_are_omitted(scene, tmp_path):
    late = scene.end_us
    gone = scene.objects["car_3"]
    first = gone.trajectory
    short = Trajectory(first.times_us[:2], first.positions[:2], first.quaternions[:2])
    object.__setattr__(gone, "trajectory", short)
    export_scene(scene, tmp_path / "a.ply", format="ply", t_us=late)
    assert len(read_splats(tmp_path / "a.ply")) == scene.gaussian_count - len(gone.cloud)


def test_only_requested_objects_are_baked(scene, t_us, tmp_path):
    export_scene(scene, tmp_path / "a.ply", format="ply", t_us=t_us, objects=["car_3"])
    expected = len(scene.background) + len(scene.objects["car_3"].cloud)
    assert len(read_splats(tmp_path / "a.ply")) == expected
    export_scene(scene, tmp_path / "a.ply", format="ply", t_us=t_us, objects=[])
    assert len(read_splats(tmp_path / "a.ply")) == len(scene.background)


@pytest.mark.parametrize(("up_axis", "file_up"), [("z", 2), ("y", 1)])
def test_the_requested_axis_points_up(scene, t_us, tmp_path, up_axis, file_up):
    scene.background.means[:, 2] += 1000
    export_scene(scene, tmp_path / "a.ply", format="ply", t_us=t_us, up_axis=up_axis)
    assert read_splats(tmp_path / "a.ply").means[:100].mean(0)[file_up] > 900
    back = import_splats(tmp_path / "a.ply", name="a").background
    np.testing.assert_allclose(back.means, bake(scene, t_us).means, atol=1e-3)


@pytest.mark.parametrize("name", SPLATS)
def test_objects_are_exported_as_files_in_their_own_frame(scene, tmp_path, name):
    files = export_scene(scene, tmp_path / "out", format=name)
    assert sorted(f.name for f in files) == sorted(p.name for p in (tmp_path / "out").iterdir())
    index = json.loads((tmp_path / "out" / "objects.json").read_bytes())
    assert index["background"] == f"background.{name}"
    assert [o["object_id"] for o in index["objects"]] == list(scene.objects)
    for entry in index["objects"]:
        expected = scene.objects[entry["object_id"]]
        cloud = read_splats(tmp_path / "out" / entry["file"])
        turned = cloud.moved(np.linalg.inv(index["T_file_scene"]))
        np.testing.assert_allclose(extent(turned), extent(expected.cloud), atol=4e-4)
        track = Trajectory(entry["times_us"], entry["positions"], entry["quaternions_wxyz"])
        assert track.times_us.tolist() == expected.trajectory.times_us.tolist()
        assert (track.positions == expected.trajectory.positions).all()
        assert (entry["category"], tuple(entry["size"])) == (expected.category, expected.size)


def test_object_ids_cannot_escape_the_folder(scene, tmp_path):
    files = export_scene(scene, tmp_path / "out", format="ply")
    assert all(f.parent == tmp_path / "out" for f in files)
    assert "003_______etc_passwd.ply" in {f.name for f in files}
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_an_export_replaces_only_a_previous_export(scene, tmp_path):
    export_scene(scene, tmp_path / "out", format="ply")
    export_scene(scene, tmp_path / "out", format="spz")
    assert all(not p.name.endswith(".ply") for p in (tmp_path / "out").iterdir())
    (tmp_path / "out" / "notes.txt").write_text("mine")
    with pytest.raises(SceneError, match="holds something else than an export"):
        export_scene(scene, tmp_path / "out", format="ply")
    assert (tmp_path / "out" / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"background": 1, "objects": [3]}'])
def test_a_folder_with_a_foreign_index_is_kept(scene, tmp_path, text):
    (tmp_path / "objects.json").write_text(text)
    with pytest.raises(SceneError, match="holds something else"):
        export_scene(scene, tmp_path, format="ply")


def test_a_failed_export_leaves_no_files(scene, tmp_path):
    scene.objects["car_3"].cloud.scales[0] = 0
    with pytest.raises(SceneError, match="scales not positive"):
        export_scene(scene, tmp_path / "out", format="ply")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"format": "obj"}, "export format 'obj'; allowed are compressed.ply, ply, spz"),
        ({"t_us": 10**9}, "t_us=1000000000 is outside scene 'street'; allowed are 7 to 400007"),
        ({"objects": "car_3"}, "must be a list of ids, not the text 'car_3'"),
        ({"objects": ["car_9"]}, "no object 'car_9'"),
        ({"up_axis": "x"}, "up_axis 'x'"),
        ({"format": "spz", "t_us": 7}, r"must end with \.spz"),
        ({"format": "gltf"}, r"must end with \.glb"),
        ({"format": "gltf", "up_axis": "z"}, "glTF is always y up"),
    ],
)
def test_invalid_export_requests_are_refused(scene, tmp_path, options, reason):
    with pytest.raises((SceneError, UnknownObjectError), match=reason):
        export_scene(scene, tmp_path / "a.ply", **{"format": "ply"} | options)
    assert list(tmp_path.iterdir()) == []


def test_a_suffix_of_another_format_is_refused(scene, tmp_path):
    with pytest.raises(SceneError, match="this ending means PlayCanvas compressed ply, not ply"):
        export_scene(scene, tmp_path / "a.compressed.ply", format="ply", t_us=7)


def test_a_scene_without_objects_bakes_to_its_background(scene, tmp_path):
    assert len(bake(scene, scene.start_us, objects={})) == len(scene.background)
    assert isinstance(bake(scene, scene.start_us), GaussianCloud)


@pytest.mark.parametrize("name", SPLATS)
def test_an_exported_folder_is_imported_with_its_objects(scene, tmp_path, name):
    save_scene(scene, tmp_path / "a.r2s")
    for words in (
        ["export", tmp_path / "a.r2s", "--out", tmp_path / "out", "--format", name],
        ["import", tmp_path / "out", "--out", tmp_path / "b.r2s"],
    ):
        done = CliRunner().invoke(build_app(), [*map(str, words)])
        assert done.exit_code == 0, done.output
    back = load_scene(tmp_path / "b.r2s")
    assert back.provenance["up_axis"] == ("y" if name == "spz" else "z")
    assert extent(back.background) == pytest.approx(extent(scene.background), abs=1e-3)
    assert list(back.objects) == list(scene.objects)
    for object_id, expected in scene.objects.items():
        subject = back.objects[object_id]
        assert extent(subject.cloud) == pytest.approx(extent(expected.cloud), abs=1e-3)
        assert (subject.category, subject.size) == (expected.category, expected.size)
        assert (subject.trajectory.positions == expected.trajectory.positions).all()
        assert back.start_us <= subject.trajectory.start_us <= subject.trajectory.end_us
        assert subject.trajectory.end_us <= back.end_us


@pytest.mark.parametrize(
    ("key", "value", "reason"),
    [
        ("background", "../out/background.ply", "not the name of a file beside it"),
        ("T_file_scene", [[0.0] * 4] * 4, "T_file_scene"),
        ("objects", 3, "objects"),
        ("format", "other", "format"),
    ],
)
def test_a_damaged_index_is_refused(scene, tmp_path, key, value, reason):
    export_scene(scene, tmp_path / "out", format="ply")
    file = tmp_path / "out" / "objects.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {key: value}))
    with pytest.raises(BundleError, match=reason):
        import_exported(tmp_path / "out", name="a")


def test_a_folder_without_index_is_refused(tmp_path):
    with pytest.raises(BundleError, match=r"a folder without objects\.json"):
        import_exported(tmp_path, name="a")
