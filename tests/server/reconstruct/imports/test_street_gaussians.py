import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_server.reconstruct.imports import (
    CheckpointError,
    CheckpointOptions,
    import_checkpoint,
    import_street_gaussians,
)
from real2sim_server.scene.cloud import sh_basis
from real2sim_server.scene.io import load_scene, save_scene

from .worlds import StreetWorld, street_model

OPTIONS = CheckpointOptions(first_frame=10, last_frame=13, cameras=(0, 1))


@pytest.fixture(params=["closed up", "with gaps"])
def world(request):
    return StreetWorld() if request.param == "closed up" else StreetWorld.with_gaps()


@pytest.fixture
def options(world, tmp_path):
    return replace(OPTIONS, dataset=world.write_folder(tmp_path / "002"))


@pytest.fixture
def plain(tmp_path):
    """A single world, for tests that do not depend on the columns."""
    world = StreetWorld()
    return world, replace(OPTIONS, dataset=world.write_folder(tmp_path / "002"))


def imported(world, options, tmp_path, **parts):
    torch.save(world.state(**parts), tmp_path / "iteration_50000.pth")
    return import_street_gaussians(tmp_path / "iteration_50000.pth", options)


def track_of(scene, track):
    return next(o for o in scene.objects.values() if o.object_id.endswith(f"_{track}"))


def test_objects_have_the_corrected_track_poses(world, options, tmp_path):
    scene = imported(world, options, tmp_path).scene
    assert {o.split("_")[1] for o in scene.objects} == {str(t) for t in world.movers}
    for (frame, track), _ in world.columns.items():
        t_us = round(world.seconds(frame) * 1e6)
        given = track_of(scene, track).trajectory.transform(t_us)
        np.testing.assert_allclose(given, world.pose_in_scene(frame, track), atol=1e-5)


def test_an_object_exists_from_its_first_to_its_last_frame(world, options, tmp_path):
    scene = imported(world, options, tmp_path).scene
    for track in world.movers:
        frames = [f for f, t in world.columns if t == track]
        expected = [round(world.seconds(f) * 1e6) for f in sorted(frames)]
        assert track_of(scene, track).trajectory.times_us.tolist() == expected


def test_object_gaussians_are_posed_in_the_world(world, options, tmp_path):
    scene = imported(world, options, tmp_path).scene
    given = track_of(scene, 8)
    xyz = world.state()["obj_008"]["xyz"].detach().double().numpy()
    truth = world.pose_in_scene(13, 8)
    expected = xyz @ truth[:3, :3].T + truth[:3, 3]
    moved = given.cloud.moved(given.trajectory.transform(round(world.seconds(13) * 1e6)))
    np.testing.assert_allclose(moved.means, expected, atol=1e-4)


def test_gaussians_are_activated(plain, tmp_path):
    world, options = plain
    scene = imported(world, options, tmp_path).scene
    part = {k: v.detach() for k, v in world.state()["background"].items()}
    cloud = scene.background
    torch.testing.assert_close(cloud.means, part["xyz"])
    torch.testing.assert_close(cloud.scales, part["scaling"].exp())
    torch.testing.assert_close(cloud.opacities, part["opacity"].sigmoid()[:, 0])
    torch.testing.assert_close(cloud.quats, torch.nn.functional.normalize(part["rotation"]))
    expected = torch.cat([part["feature_dc"], part["feature_rest"]], dim=1)
    torch.testing.assert_close(cloud.sh, expected)


def test_time_varying_colours_are_evaluated_at_mid_life(world, options, tmp_path):
    result = imported(world, options, tmp_path)
    series = world.state()["obj_007"]["feature_dc"].detach()
    # At half of its time: 1, sin 2 pi t = 0, cos 2 pi t = -1, sin 4 pi t = 0, cos 4 pi t = 1.
    expected = series[:, 0] - series[:, 2] + series[:, 4]
    torch.testing.assert_close(
        track_of(result.scene, 7).cloud.sh[:, 0], expected, atol=1e-5, rtol=1e-5
    )
    assert any("change colour over time" in w for w in result.warnings)


def test_harmonics_are_rotated_to_the_object_frame(world, options, tmp_path):
    scene = imported(world, options, tmp_path).scene
    for track in (3, 8):
        given = track_of(scene, track)
        path = given.trajectory
        turn = path.transform((path.start_us + path.end_us) // 2)[:3, :3]
        part = world.state()[f"obj_{track:03d}"]
        direction = np.array([0.48, -0.6, 0.64])
        basis = sh_basis(direction, 1)
        wanted = np.einsum("k,nkc->nc", basis[1:], part["feature_rest"].detach().numpy())
        local = sh_basis(turn.T @ direction, 1)
        seen = np.einsum("k,nkc->nc", local[1:], given.cloud.sh[:, 1:].numpy())
        np.testing.assert_allclose(seen, wanted, atol=1e-5)


def test_the_sky_keeps_its_directions(plain, tmp_path):
    world, options = plain
    sky = imported(world, options, tmp_path).scene.sky
    directions = torch.nn.functional.normalize(
        torch.randn(500, 3, generator=torch.Generator().manual_seed(0))
    )
    seen = sky.sample(directions) * 2 - 1
    # Colours encode view directions. At 8 pixels per face they are at most 13 degrees apart.
    assert (torch.nn.functional.normalize(seen) * directions).sum(1).min() > np.cos(0.2)


def test_sizes_are_the_maximum_over_all_frames(world, options, tmp_path):
    scene = imported(world, options, tmp_path).scene
    assert track_of(scene, 7).size == pytest.approx((4.7, 1.8, 2.0))
    assert track_of(scene, 3).size == pytest.approx((4.3, 1.8, 1.5))
    assert (track_of(scene, 7).category, track_of(scene, 8).category) == ("car", "pedestrian")


def test_the_dataset_provides_cameras_ego_and_times(plain, tmp_path):
    world, options = plain
    scene = imported(world, options, tmp_path).scene
    assert scene.frame_times_us.tolist() == [round(world.seconds(f) * 1e6) for f in world.frames]
    for frame in world.frames:
        given = scene.ego.transform(round(world.seconds(frame) * 1e6))
        np.testing.assert_allclose(given, world.ego_in_scene(frame), atol=1e-6)
    assert scene.rig.names == ("front", "front_left")
    camera = scene.rig["front_left"]
    assert (camera.width, camera.height) == (1920, 1280)
    assert camera.K.tolist() == [[2001, 0, 960], [0, 2001, 640], [0, 0, 1]]
    assert camera.T_vehicle_camera[:3, 3].tolist() == [1.5, 0.1, 2]


def test_image_files_determine_the_camera_size(plain, tmp_path):
    world, options = plain
    head = b"\x89PNG\r\n\x1a\n" + bytes(8) + (640).to_bytes(4, "big") + (427).to_bytes(4, "big")
    (options.dataset / "images" / "000010_1.png").write_bytes(head)
    rig = imported(world, options, tmp_path).scene.rig
    assert (rig["front_left"].width, rig["front_left"].height) == (640, 427)
    assert rig["front"].width == 1920


def test_without_corrections_the_dataset_tracks_are_used(world, options, tmp_path):
    scene = imported(world, options, tmp_path, actor_pose={}).scene
    position, _ = world.given_in_vehicle(12, 8)
    given = track_of(scene, 8).trajectory.transform(round(world.seconds(12) * 1e6))
    expected = world.ego_in_scene(12) @ np.append(position, 1)
    np.testing.assert_allclose(given[:3, 3], expected[:3], atol=1e-6)


def test_an_imported_scene_is_saved_as_a_bundle(world, options, tmp_path):
    scene = imported(world, options, tmp_path).scene
    save_scene(scene, tmp_path / "a.r2s")
    loaded = load_scene(tmp_path / "a.r2s")
    assert (loaded.name, loaded.provenance["iteration"]) == ("002", 50_000)
    assert loaded.provenance["cameras"] == [0, 1]


def test_a_checkpoint_is_recognised_by_its_keys(plain, tmp_path):
    world, options = plain
    torch.save(world.state(), tmp_path / "a.pth")
    assert import_checkpoint(tmp_path / "a.pth", options).scene.provenance["source"] == (
        "Street Gaussians checkpoint"
    )


def test_intermediate_checkpoints_are_read(plain, tmp_path):
    world, options = plain
    background = street_model(30) | {
        "spatial_lr_scale": np.float64(10.0),
        "active_sh_degree": 1,
        "optimizer": {"state": {0: {"step": torch.tensor(3.0)}}, "param_groups": [{"lr": 0.1}]},
    }
    assert len(imported(world, options, tmp_path, background=background).scene.background) == 30


def test_unsupported_parts_are_named(plain, tmp_path):
    world, options = plain
    params = {"params": {"affine_trans": torch.zeros(2, 3, 4)}}
    codebook = {"params": {"sky_codebook": torch.zeros(32, 12)}}
    result = imported(world, options, tmp_path, color_correction=params, sky_cubemap=codebook)
    assert result.scene.sky is None
    assert any("colour corrections" in w for w in result.warnings)
    assert any("codebook" in w for w in result.warnings)


def test_parked_tracks_do_not_become_objects(plain, tmp_path):
    _, options = plain
    world = StreetWorld(rows={10: [5], 11: [5]}, columns={}, width=1)
    world.write_folder(options.dataset)
    scene = imported(world, options, tmp_path).scene
    assert dict(scene.objects) == {}


# Invalid input


@pytest.mark.parametrize(
    ("parts", "reason"),
    [
        ({"background": None}, "'background' is missing; found: actor_pose"),
        ({"background": 3}, "'background' is a int, not a table"),
        ({"obj_007": None}, r"only in the folder: \['obj_007'\]; frames, cameras"),
        ({"obj_055": street_model(3)}, r"only in the file: \['obj_055'\]"),
        ({"actor_pose": {"params": {}}}, "actor_pose: 'opt_trans' is missing"),
        ({"actor_pose": {"other": {}}}, "'params' is missing; found: other"),
        ({"sky_cubemap": {"params": {}}}, "'sky_cube_map' is missing"),
        (
            {"sky_cubemap": {"params": {"sky_cube_map": torch.zeros(6, 4, 8, 3)}}},
            r"faces are \(4, 8\), not square",
        ),
        ({"background": street_model(9) | {"rotation": torch.zeros(9, 4)}}, "length zero"),
        (
            {"background": street_model(9) | {"xyz": torch.full((9, 3), float("nan"))}},
            "background: 27 of 27 values of 'xyz' are NaN or infinite",
        ),
        ({"background": street_model(9) | {"opacity": [1.0]}}, "'opacity' is a list, not a tensor"),
        (
            {"background": street_model(9) | {"scaling": torch.zeros(8, 3)}},
            r"'scaling' is \[8, 3\], not \[9, 3\]",
        ),
        ({"background": street_model(9, harmonics=5)}, "6 harmonics; allowed are 1, 4, 9, 16"),
    ],
)
def test_inconsistent_checkpoints_are_refused(plain, tmp_path, parts, reason):
    world, options = plain
    with pytest.raises(CheckpointError, match=reason) as refused:
        imported(world, options, tmp_path, **parts)
    assert "iteration_50000.pth" in str(refused.value)


def test_corrections_with_a_wrong_shape_are_refused(plain, tmp_path):
    world, options = plain
    params = {"opt_trans": torch.zeros(4, 9, 3), "opt_rots": torch.zeros(4, 9, 1)}
    with pytest.raises(CheckpointError, match=r"'opt_trans' is \[4, 9, 3\], not \[4, 2, 3\]"):
        imported(world, options, tmp_path, actor_pose={"params": params})


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"dataset": None}, "name the dataset folder it was trained on"),
        ({"last_frame": 16}, "ego_pose: has frames 0 to 15, not 10 to 16"),
        ({"last_frame": 12}, "is not|are not|not the moving tracks|'opt_trans' is"),
        ({"cameras": (7,)}, "camera 7; allowed are 0 to 4"),
        ({"cameras": (4,)}, "not the moving tracks of the dataset folder"),
        ({"tracker": True}, "track_info_castrack.txt: cannot be read"),
    ],
)
def test_mismatched_options_are_refused(plain, tmp_path, change, reason):
    world, options = plain
    with pytest.raises(CheckpointError, match=reason):
        imported(world, replace(options, **change), tmp_path)


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        ("timestamps.json", "{", "timestamps.json: is not JSON"),
        ("timestamps.json", "[]", "timestamps.json: must hold a JSON object"),
        ("timestamps.json", '{"FRAME": {"000010": 1}}', "FRAME must hold seconds .* '000011'"),
        ("ego_pose/000004.txt", "1 2 3", "000004.txt: must hold a rigid 4x4 transform"),
        ("ego_pose/000004.txt", "one", "000004.txt: must hold numbers only"),
        ("ego_pose/000020.txt", "1", "ego_pose: frames are missing or doubled, the first: .16"),
        ("intrinsics/1.txt", "1 2", "1.txt: must hold fx, fy, cx, cy, not 2 numbers"),
        ("extrinsics/1.txt", "", "1.txt: must hold a rigid"),
        ("images/000010_0.png", "GIF", "000010_0.png: is neither PNG nor JPEG"),
        ("track/track_info.txt", "head\n10 7 vehicle 1 2", "line 2 must be: frame track class"),
        (
            "track/track_info.txt",
            "head\n10 7 vehicle 0 1 0 1 2 3 4 0 1",
            "line 2: box of no size or not finite",
        ),
        ("track/track_camera_vis.json", "{}", "says nothing of track 7 in frame 2"),
    ],
)
def test_malformed_dataset_files_are_refused(plain, tmp_path, name, text, reason):
    world, options = plain
    (options.dataset / name).write_text(text)
    with pytest.raises(CheckpointError, match=reason):
        imported(world, options, tmp_path)


def test_timestamps_must_increase(plain, tmp_path):
    world, options = plain
    stamps = {f"{f:06d}": 5.0 for f in range(16)}
    (options.dataset / "timestamps.json").write_text(json.dumps({"FRAME": stamps}))
    with pytest.raises(CheckpointError, match="time stamps of FRAME do not increase"):
        imported(world, options, tmp_path)


def test_a_folder_without_poses_is_refused(plain, tmp_path):
    world, options = plain
    for file in (options.dataset / "ego_pose").iterdir():
        file.unlink()
    with pytest.raises(CheckpointError, match=r"ego_pose: holds no poses such as 000000\.txt"):
        imported(world, options, tmp_path)
