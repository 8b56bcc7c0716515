from dataclasses import replace

import numpy as np
import pytest

from real2sim_server.geometry import yaw_quaternion
from real2sim_server.scene import (
    CameraRig,
    GaussianCloud,
    Scene,
    SceneError,
    SceneObject,
    Trajectory,
)
from real2sim_server.scene.io import export_scene

from .glb_reading import Glb, rotation_matrix

EXTENSION = "KHR_gaussian_splatting"


@pytest.fixture
def drive(scene, make_cloud) -> Scene:
    """A 3 s scene with a car present throughout, one present for a while and one for one frame."""
    times = np.arange(0, 3_000_001, 250_000) + 1_700_000_000_000_000
    turn = np.linspace(0.2, 7.0, len(times))
    path = np.stack([np.cos(turn) * 30, np.sin(turn) * 30, turn * 0.1], axis=1)
    whole = Trajectory(times, path, yaw_quaternion(turn) * np.where(turn > 3, -1, 1)[:, None])
    part = Trajectory(times[3:8], path[3:8] + 5, yaw_quaternion(-turn[3:8]))
    once = Trajectory(times[5:6], path[5:6] - 5, yaw_quaternion(turn[5:6]))
    tracks = {"car_1": whole, "car_2": part, "van_3": once}
    objects = {
        k: SceneObject(k, k[:3], (4, 2, 1.5), make_cloud(9 + i, degree=i, seed=i), t)
        for i, (k, t) in enumerate(tracks.items())
    }
    return replace(scene, objects=objects, ego=whole, frame_times_us=times)


@pytest.fixture
def glb(drive, tmp_path) -> Glb:
    (file,) = export_scene(drive, tmp_path / "drive.glb", format="gltf")
    return Glb(file)


def seconds(drive, t_us):
    return (t_us - drive.start_us) / 1e6


def test_the_file_uses_the_gaussian_splatting_extension(glb):
    assert glb.json["asset"]["version"] == "2.0"
    assert glb.json["extensionsUsed"] == [EXTENSION]
    for mesh in glb.json["meshes"]:
        (primitive,) = mesh["primitives"]
        assert primitive["mode"] == 0
        assert primitive["extensions"] == {
            EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
        }


def test_background_objects_and_ego_share_one_root(glb):
    (root,) = glb.json["scenes"][0]["nodes"]
    children = [glb.json["nodes"][i]["name"] for i in glb.json["nodes"][root]["children"]]
    assert children == ["background", "car_1", "car_2", "van_3", "ego"]
    cameras = [glb.json["nodes"][i]["name"] for i in glb.node("ego")["children"]]
    assert cameras == ["front", "rear"]
    listed = [i for n in glb.json["nodes"] for i in n.get("children", [])] + [root]
    assert sorted(listed) == list(range(len(glb.json["nodes"])))


@pytest.mark.parametrize("name", ["background", "car_1", "car_2", "van_3"])
def test_gaussians_keep_their_values(glb, drive, name):
    cloud = drive.background if name == "background" else drive.objects[name].cloud
    given = glb.attributes(name)
    names = {"POSITION", "COLOR_0", *(f"{EXTENSION}:{n}" for n in ("ROTATION", "SCALE", "OPACITY"))}
    names |= {
        f"{EXTENSION}:SH_DEGREE_{d}_COEF_{n}"
        for d in range(cloud.sh_degree + 1)
        for n in range(2 * d + 1)
    }
    assert set(given) == names
    np.testing.assert_array_equal(given["POSITION"], cloud.means)
    np.testing.assert_array_equal(given[f"{EXTENSION}:SCALE"], cloud.scales)
    np.testing.assert_array_equal(given[f"{EXTENSION}:OPACITY"][:, 0], cloud.opacities)
    xyzw = given[f"{EXTENSION}:ROTATION"]
    np.testing.assert_allclose(xyzw, cloud.quats[:, [1, 2, 3, 0]], atol=2e-7)
    np.testing.assert_allclose(np.linalg.norm(xyzw, axis=1), 1, atol=1e-6)
    for k in range(cloud.sh.shape[1]):
        degree = int(k**0.5)
        coefficient = given[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k - degree**2}"]
        np.testing.assert_array_equal(coefficient, cloud.sh[:, k])


def test_fallback_colours_are_those_of_the_constant_harmonic(glb, drive):
    rgba = glb.attributes("car_1")["COLOR_0"] / 255
    cloud = drive.objects["car_1"].cloud
    expected = (0.5 + 0.28209479 * cloud.sh[:, 0].numpy()).clip(0, 1)
    np.testing.assert_allclose(rgba[:, :3], expected, atol=0.501 / 255)
    np.testing.assert_allclose(rgba[:, 3], cloud.opacities, atol=0.501 / 255)


def test_positions_have_bounds(glb):
    for mesh in glb.json["meshes"]:
        index = mesh["primitives"][0]["attributes"]["POSITION"]
        assert "min" in glb.json["accessors"][index]


def test_tracks_are_linear_channels_with_one_key_per_pose(glb, drive):
    for name, track in [
        ("car_1", drive.objects["car_1"].trajectory),
        ("car_2", drive.objects["car_2"].trajectory),
        ("ego", drive.ego),
    ]:
        channels = glb.channels(name)
        for path in ("translation", "rotation"):
            times, values, interpolation = channels[path]
            assert interpolation == "LINEAR"
            assert len(times) == len(values) == len(track.times_us)
            assert (np.diff(times) > 0).all()
            np.testing.assert_allclose(times, seconds(drive, track.times_us), atol=1e-6)
        assert (np.sum(channels["rotation"][1][1:] * channels["rotation"][1][:-1], 1) >= 0).all()
    assert set(glb.channels("van_3")) == {"scale"}
    for animation in glb.json["animations"]:
        for sampler in animation["samplers"]:
            assert "min" in glb.json["accessors"][sampler["input"]]


@pytest.mark.parametrize("name", ["car_1", "car_2", "van_3", "ego"])
def test_the_animation_matches_the_trajectory(glb, drive, name):
    track = drive.ego if name == "ego" else drive.objects[name].trajectory
    random = np.random.default_rng(0)
    asked = random.integers(track.start_us, track.end_us + 1, 40).tolist()
    for t_us in [track.start_us, track.end_us, *track.times_us.tolist(), *asked]:
        np.testing.assert_allclose(
            glb.local(name, seconds(drive, t_us)), track.transform(t_us), atol=2e-5
        )


def test_objects_are_hidden_outside_their_lifetime(glb, drive):
    for name, scene_object in drive.objects.items():
        track = scene_object.trajectory
        for t_us in range(drive.start_us, drive.end_us + 1, 50_000):
            assert glb.shown(name, seconds(drive, t_us)) == track.covers(t_us), (name, t_us)


def test_the_root_rotates_z_up_to_y_up(glb, drive):
    root = rotation_matrix(np.array(glb.node(drive.name)["rotation"]))
    # glTF: y up, z forward, x left.
    np.testing.assert_allclose(root @ [0, 0, 1], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(root @ [1, 0, 0], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(root @ [0, 1, 0], [1, 0, 0], atol=1e-12)


def test_cameras_match_the_rig(glb, drive):
    camera = drive.rig["front"]
    t_us = int(drive.ego.times_us[4])
    point = np.array([20.0, 3.0, 1.0, 1.0])
    seen = camera.viewmat(drive.ego.transform(t_us)) @ point
    T_ego_camera = glb.local("front", 0)
    ours = np.linalg.inv(glb.local("ego", seconds(drive, t_us)) @ T_ego_camera) @ point
    # glTF cameras look along -z with y up.
    np.testing.assert_allclose(ours[:3], seen[:3] * [1, -1, -1], atol=1e-4)
    lens = glb.json["cameras"][glb.node("front")["camera"]]["perspective"]
    assert np.tan(lens["yfov"] / 2) == pytest.approx(427 / 2 / 701.3)
    assert np.tan(lens["yfov"] / 2) * lens["aspectRatio"] == pytest.approx(640 / 2 / 700.1)


def test_an_export_at_one_time_has_no_animation(drive, tmp_path):
    t_us = int(drive.ego.times_us[3]) + 100_000
    (file,) = export_scene(drive, tmp_path / "a.glb", format="gltf", t_us=t_us)
    still = Glb(file)
    assert "animations" not in still.json
    assert still.json["asset"]["extras"]["start_us"] == t_us
    assert {n["name"] for n in still.json["nodes"]} >= {"car_1", "car_2"}
    assert "van_3" not in {n["name"] for n in still.json["nodes"]}
    for name in ("car_1", "car_2"):
        expected = drive.objects[name].trajectory.transform(t_us)
        np.testing.assert_allclose(still.local(name, 0), expected, atol=1e-12)


def test_only_requested_objects_are_written(drive, tmp_path):
    (file,) = export_scene(drive, tmp_path / "a.glb", format="gltf", objects=["car_2"])
    names = {n["name"] for n in Glb(file).json["nodes"]}
    assert names == {drive.name, "background", "car_2", "ego", "front", "rear"}


def test_an_empty_cloud_is_a_node_without_a_mesh(drive, tmp_path):
    bare = replace(drive, background=GaussianCloud.empty(), rig=CameraRig(()))
    glb = Glb(export_scene(bare, tmp_path / "a.glb", format="gltf")[0])
    assert "mesh" not in glb.node("background")
    assert "children" not in glb.node("ego")
    assert "cameras" not in glb.json


def test_an_empty_scene_gives_a_valid_file(scene, tmp_path):
    still = Trajectory([5], [[0, 0, 0]], [[1, 0, 0, 0]])
    nothing = replace(scene, background=GaussianCloud.empty(), objects={}, ego=still)
    glb = Glb(export_scene(nothing, tmp_path / "a.glb", format="gltf")[0])
    assert not {"meshes", "accessors", "buffers", "extensionsUsed", "animations"} & set(glb.json)


def test_key_times_too_close_for_float32_still_increase(drive, tmp_path):
    times = drive.start_us + np.array([0, 100_000_000, 100_000_001, 100_000_002, 200_000_000])
    path = Trajectory(times, np.arange(15.0).reshape(5, 3), [[1.0, 0, 0, 0]] * 5)
    scene = replace(drive, ego=path)
    glb = Glb(export_scene(scene, tmp_path / "a.glb", format="gltf")[0])
    assert (np.diff(glb.channels("ego")["translation"][0]) > 0).all()


def test_non_finite_values_are_refused(drive, tmp_path):
    drive.objects["car_2"].cloud.means[0, 0] = float("nan")
    with pytest.raises(SceneError, match=r"object 'car_2'.*means not finite"):
        export_scene(drive, tmp_path / "a.glb", format="gltf")
    assert list(tmp_path.iterdir()) == []


def test_export_is_reproducible(drive, tmp_path):
    files = [export_scene(drive, tmp_path / f"{i}.glb", format="gltf")[0] for i in range(2)]
    assert files[0].read_bytes() == files[1].read_bytes()
