from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_server.reconstruct.imports import (
    CheckpointError,
    CheckpointOptions,
    import_checkpoint,
    import_drivestudio,
)
from real2sim_server.scene.cloud import sh_basis
from real2sim_server.scene.io import load_scene, save_scene

from .worlds import pose, studio_model, studio_state, write_matrix


def imported(tmp_path, options=None, **models):
    torch.save(studio_state(**models), tmp_path / "checkpoint_final.pth")
    return import_drivestudio(tmp_path / "checkpoint_final.pth", options)


def rigid(**parts):
    return studio_state()["models"]["RigidNodes"] | parts


def test_gaussians_are_activated(tmp_path):
    cloud = imported(tmp_path).scene.background
    part = studio_model(40, seed=1)
    torch.testing.assert_close(cloud.means, part["_means"])
    torch.testing.assert_close(cloud.scales, part["_scales"].exp())
    torch.testing.assert_close(cloud.opacities, part["_opacities"].sigmoid()[:, 0])
    torch.testing.assert_close(cloud.quats, torch.nn.functional.normalize(part["_quats"]))
    expected = torch.cat([part["_features_dc"][:, None], part["_features_rest"]], dim=1)
    torch.testing.assert_close(cloud.sh, expected)


def test_instances_become_objects_with_their_poses(tmp_path):
    scene = imported(tmp_path).scene
    assert list(scene.objects) == ["vehicle_0", "vehicle_1"]
    assert scene.objects["vehicle_1"].size == (8.0, 2.5, 3.0)
    assert scene.objects["vehicle_0"].trajectory.times_us.tolist() == [
        0,
        100_000,
        200_000,
        300_000,
        400_000,
    ]
    assert scene.objects["vehicle_1"].trajectory.times_us.tolist() == [100_000, 200_000, 300_000]
    for i in (0, 1):
        given = scene.objects[f"vehicle_{i}"].trajectory.transform(200_000)
        np.testing.assert_allclose(given, pose(10 * i + 2, 2, 0.5, 0.3 * i + 0.2), atol=1e-6)


def test_gaussians_are_assigned_to_their_instances(tmp_path):
    scene = imported(tmp_path).scene
    means = rigid()["_means"]
    for i in (0, 1):
        assert torch.equal(scene.objects[f"vehicle_{i}"].cloud.means, means[i::3])


def test_frame_times_follow_the_frame_rate(tmp_path):
    scene = imported(tmp_path, CheckpointOptions(frame_rate=2.0)).scene
    assert scene.frame_times_us.tolist() == [0, 500_000, 1_000_000, 1_500_000, 2_000_000]


def test_harmonics_are_rotated_to_the_object_frame(tmp_path):
    scene = imported(tmp_path).scene
    given = scene.objects["vehicle_1"]
    turn = given.trajectory.transform(200_000)[:3, :3]
    direction = np.array([0.48, -0.6, 0.64])
    wanted = np.einsum(
        "k,nkc->nc", sh_basis(direction, 1)[1:], rigid()["_features_rest"][1::3].numpy()
    )
    local = sh_basis(turn.T @ direction, 1)[1:]
    seen = np.einsum("k,nkc->nc", local, given.cloud.sh[:, 1:].numpy())
    np.testing.assert_allclose(seen, wanted, atol=1e-5)


def test_colours_without_harmonics_use_a_sigmoid(tmp_path):
    cloud = imported(tmp_path, Background=studio_model(9, harmonics=0)).scene.background
    rgb = 0.5 + 0.28209479177387814 * cloud.sh[:, 0]
    torch.testing.assert_close(rgb, studio_model(9, harmonics=0)["_features_dc"].sigmoid())


@pytest.mark.parametrize("columns", [1, 2])
def test_spheres_and_discs_get_three_scales(tmp_path, columns):
    cloud = imported(tmp_path, Background=studio_model(9, scales=columns)).scene.background
    given = studio_model(9, scales=columns)["_scales"].exp()
    torch.testing.assert_close(cloud.scales[:, :columns], given)
    if columns == 1:
        torch.testing.assert_close(cloud.scales, given.expand(9, 3))
    else:
        assert (cloud.scales[:, 2] < 1e-3 * given.amin(1)).all()


def view_directions(sky, directions):
    return torch.nn.functional.normalize(sky.sample(directions) * 2 - 1)


@pytest.fixture
def directions():
    random = torch.Generator().manual_seed(0)
    return torch.nn.functional.normalize(torch.randn(500, 3, generator=random))


def test_the_sky_uses_the_axes_of_drivestudio(tmp_path, directions):
    sky = imported(tmp_path).scene.sky
    x, y, z = directions.unbind(1)
    # The drivestudio shader maps view directions (x, y, z) to (x, z, -y).
    expected = torch.stack([x, z, -y], dim=1)
    assert (view_directions(sky, directions) * expected).sum(1).min() > np.cos(0.2)


def test_a_front_camera_world_is_rotated_upright(tmp_path, directions):
    options = CheckpointOptions(world="front_camera")
    upright, given = imported(tmp_path, options).scene, imported(tmp_path).scene
    # Right, down, ahead become ahead, left, up.
    means = given.background.means
    expected = torch.stack([means[:, 2], -means[:, 0], -means[:, 1]], dim=1)
    torch.testing.assert_close(upright.background.means, expected)
    a = given.objects["vehicle_1"].trajectory.transform(200_000)[:3, 3]
    b = upright.objects["vehicle_1"].trajectory.transform(200_000)[:3, 3]
    np.testing.assert_allclose(b, [a[2], -a[0], -a[1]], atol=1e-9)
    assert torch.equal(
        upright.objects["vehicle_1"].cloud.means, given.objects["vehicle_1"].cloud.means
    )
    turned = torch.stack([directions[:, 2], -directions[:, 0], -directions[:, 1]], dim=1)
    torch.testing.assert_close(
        upright.sky.sample(turned), given.sky.sample(directions), atol=1e-5, rtol=0
    )


def test_unsupported_models_are_named(tmp_path):
    result = imported(
        tmp_path,
        DeformableNodes={"a": torch.zeros(1)},
        SMPLNodes={},
        Affine={},
        CamPose={},
        Fog={},
        Sky={"sky_head.layers.0.weight": torch.zeros(3)},
    )
    text = "\n".join(result.warnings)
    for part in ("deformable", "pedestrians", "colour corr", "camera poses", "'Fog'", "network"):
        assert part in text
    assert result.scene.sky is None
    assert "1 instances without Gaussians or visible frames" in text


def test_without_a_dataset_the_scene_has_one_fixed_camera(tmp_path):
    result = imported(tmp_path)
    scene = result.scene
    assert scene.rig.names == ("front",)
    np.testing.assert_array_equal(scene.ego.transform(scene.end_us), np.eye(4))
    assert any("without the dataset folder" in w for w in result.warnings)


def ego(frame):
    return pose(500.0 + 2 * frame, 300.0 - frame, 10.0, 0.7 + 0.01 * frame)


def write_folder(folder, *, waymo_axes):
    for name in ("ego_pose", "extrinsics", "intrinsics"):
        (folder / name).mkdir(parents=True)
    for frame in range(20):
        write_matrix(folder / "ego_pose" / f"{frame:03d}.txt", ego(frame))
    for camera, yaw in enumerate([0.0, 0.8, 3.0]):
        mounted = pose(1.5, 0.2 * camera, 1.8, yaw)
        optical = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
        given = mounted if waymo_axes else mounted @ optical
        write_matrix(folder / "extrinsics" / f"{camera}.txt", given)
        write_matrix(folder / "intrinsics" / f"{camera}.txt", [900, 901, 480, 320, 0, 0, 0, 0, 0])
    return folder


@pytest.mark.parametrize("waymo_axes", [True, False])
def test_the_dataset_provides_cameras_and_the_ego_trajectory(tmp_path, waymo_axes):
    folder = write_folder(tmp_path / "023", waymo_axes=waymo_axes)
    scene = imported(tmp_path, CheckpointOptions(dataset=folder, first_frame=7)).scene
    assert scene.name == "023"
    for i in range(5):
        expected = np.linalg.inv(ego(7)) @ ego(7 + i)
        np.testing.assert_allclose(scene.ego.transform(100_000 * i), expected, atol=1e-6)
    assert scene.rig.names == ("camera_0", "camera_1", "camera_2")
    camera = scene.rig["camera_1"]
    assert (camera.width, camera.height) == (960, 640)
    ahead = camera.T_vehicle_camera[:3, 2]
    np.testing.assert_allclose(ahead, [np.cos(0.8), np.sin(0.8), 0], atol=1e-6)
    np.testing.assert_allclose(camera.T_vehicle_camera[:3, 1], [0, 0, -1], atol=1e-6)


def test_only_requested_cameras_are_imported(tmp_path):
    folder = write_folder(tmp_path / "023", waymo_axes=True)
    options = CheckpointOptions(dataset=folder, cameras=(2,))
    camera = imported(tmp_path, options).scene.rig["camera_2"]
    np.testing.assert_allclose(camera.T_vehicle_camera[0, 2], np.cos(3.0), atol=1e-6)


def test_a_checkpoint_is_recognised_and_saved_as_a_bundle(tmp_path):
    torch.save(studio_state(), tmp_path / "a.pth")
    save_scene(import_checkpoint(tmp_path / "a.pth").scene, tmp_path / "a.r2s")
    loaded = load_scene(tmp_path / "a.r2s")
    assert loaded.provenance["source"] == "drivestudio checkpoint"
    assert loaded.provenance["iteration"] == 30_000


def test_a_checkpoint_with_only_a_background_is_imported(tmp_path):
    scene = imported(tmp_path, RigidNodes=None, Sky=None).scene
    assert (dict(scene.objects), scene.sky) == ({}, None)
    assert scene.end_us > scene.start_us


@pytest.mark.parametrize(
    ("models", "reason"),
    [
        ({"Background": None}, "'Background' is missing; found: RigidNodes, Sky"),
        ({"RigidNodes": rigid(instances_fv=torch.zeros(5))}, "'instances_fv' is missing or not"),
        ({"RigidNodes": rigid(instances_trans=torch.zeros(4, 3, 3))}, r"is \[4, 3, 3\], not \[5"),
        ({"RigidNodes": rigid(points_ids=torch.full((24, 1), 3))}, "beyond its 3 instances"),
        ({"RigidNodes": rigid(points_ids=torch.full((24, 1), -1))}, "beyond its 3 instances"),
        ({"RigidNodes": rigid(instances_quats=torch.zeros(5, 3, 4))}, "instance 0 .* length zero"),
        ({"RigidNodes": rigid(instances_size=torch.zeros(3, 3))}, "instance 0 .*positive lengths"),
        (
            {"RigidNodes": rigid(instances_trans=torch.full((5, 3, 3), float("inf")))},
            "45 of 45 values of 'instances_trans' are NaN or infinite",
        ),
        ({"Background": studio_model(5, scales=4)}, "'_scales' has 4 columns; allowed are 1 to 3"),
        ({"Background": studio_model(5, harmonics=2)}, "3 harmonics; allowed are 1, 4, 9, 16"),
        ({"Sky": {"base": torch.zeros(5, 4, 4, 3)}}, r"'base' is \[5, 4, 4, 3\], not \[6"),
    ],
)
def test_inconsistent_checkpoints_are_refused(tmp_path, models, reason):
    with pytest.raises(CheckpointError, match=reason) as refused:
        imported(tmp_path, **models)
    assert "checkpoint_final.pth" in str(refused.value)


def test_a_clip_with_another_number_of_frames_is_refused(tmp_path):
    options = CheckpointOptions(first_frame=3, last_frame=9)
    with pytest.raises(CheckpointError, match="have 5 frames; 3 to 9 are 7"):
        imported(tmp_path, options)


def test_mismatched_dataset_folders_are_refused(tmp_path):
    folder = write_folder(tmp_path / "023", waymo_axes=True)
    options = CheckpointOptions(dataset=folder)
    with pytest.raises(CheckpointError, match=r"020\.txt: cannot be read"):
        imported(tmp_path, replace(options, first_frame=16))
    with pytest.raises(CheckpointError, match=r"9\.txt: cannot be read"):
        imported(tmp_path, replace(options, cameras=(9,)))
    with pytest.raises(CheckpointError, match="layouts without ego_pose"):
        imported(tmp_path, replace(options, dataset=tmp_path))
