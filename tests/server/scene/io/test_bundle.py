import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_server.scene import (
    Asset,
    BrownConrady,
    BundleError,
    Camera,
    CameraRig,
    Fisheye,
    GaussianCloud,
    Scene,
    Shutter,
    Sky,
    Trajectory,
)
from real2sim_server.scene.camera import Optics
from real2sim_server.scene.io import (
    load_asset,
    load_scene,
    read_scene_summary,
    save_asset,
    save_scene,
)

CAMERA_KEYS = {"name", "width", "height", "K", "T_vehicle_camera"}
CLOUD_FIELDS = ("means", "quats", "scales", "opacities", "sh")


def same_bits(a: torch.Tensor, b: torch.Tensor) -> bool:
    return torch.equal(a.view(torch.int32), b.view(torch.int32))


def assert_same_cloud(a: GaussianCloud, b: GaussianCloud) -> None:
    for name in CLOUD_FIELDS:
        assert same_bits(getattr(a, name), getattr(b, name)), name


def assert_same_trajectory(a: Trajectory, b: Trajectory) -> None:
    for name in ("times_us", "positions", "quaternions"):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes(), name


def assert_same_camera(a: Camera, b: Camera) -> None:
    assert (a.name, a.width, a.height) == (b.name, b.width, b.height)
    assert a.K.tobytes() == b.K.tobytes()
    assert a.T_vehicle_camera.tobytes() == b.T_vehicle_camera.tobytes()


def test_a_scene_round_trips_exactly(scene, tmp_path):
    saved = save_scene(scene, tmp_path / "a.r2s")
    loaded = load_scene(tmp_path / "a.r2s")
    assert loaded.name == scene.name
    assert loaded.content_hash == saved.content_hash
    assert loaded.provenance == scene.provenance
    assert loaded.ego_size == scene.ego_size
    assert loaded.frame_times_us.tobytes() == scene.frame_times_us.tobytes()
    assert list(loaded.objects) == list(scene.objects)
    assert_same_cloud(loaded.background, scene.background)
    assert_same_trajectory(loaded.ego, scene.ego)
    assert same_bits(loaded.sky.faces, scene.sky.faces)
    for a, b in zip(loaded.rig, scene.rig, strict=True):
        assert_same_camera(a, b)
    for a, b in zip(loaded.objects.values(), scene.objects.values(), strict=True):
        assert (a.object_id, a.category, a.size) == (b.object_id, b.category, b.size)
        assert_same_cloud(a.cloud, b.cloud)
        assert_same_trajectory(a.trajectory, b.trajectory)


def test_an_empty_scene_round_trips(scene, tmp_path):
    bare = replace(
        scene,
        background=GaussianCloud.empty(sh_degree=3),
        objects={},
        sky=None,
        rig=CameraRig(()),
        frame_times_us=np.array([], dtype=np.int64),
    )
    save_scene(bare, tmp_path / "bare")
    loaded = load_scene(tmp_path / "bare")
    assert (len(loaded.background), loaded.background.sh_degree, loaded.sky) == (0, 3, None)
    assert (len(loaded.objects), len(loaded.rig), len(loaded.frame_times_us)) == (0, 0, 0)


def test_objects_that_share_a_cloud_are_saved(scene, tmp_path):
    twins = {k: replace(o, cloud=scene.background) for k, o in scene.objects.items()}
    save_scene(replace(scene, objects=twins), tmp_path / "a")
    loaded = load_scene(tmp_path / "a")
    assert_same_cloud(loaded.object("car_3").cloud, scene.background)


def test_views_of_larger_tensors_are_saved(scene, tmp_path, make_cloud):
    every_other = GaussianCloud(*(getattr(make_cloud(40), name)[::2] for name in CLOUD_FIELDS))
    save_scene(replace(scene, background=every_other), tmp_path / "a")
    assert_same_cloud(load_scene(tmp_path / "a").background, every_other)


def test_loading_without_verification_gives_the_same_scene(scene, bundle):
    assert_same_cloud(load_scene(bundle, verify=False).background, scene.background)


def test_a_loaded_scene_outlives_its_folder(scene, bundle):
    loaded = load_scene(bundle)
    shutil.rmtree(bundle)
    assert_same_cloud(loaded.background, scene.background)


def test_a_bundle_can_be_moved(scene, bundle, tmp_path):
    moved = tmp_path / "elsewhere" / "renamed"
    moved.parent.mkdir()
    bundle.rename(moved)
    assert load_scene(moved).name == scene.name


# Content hash


def test_equal_scenes_have_equal_hashes(scene, tmp_path):
    copy = replace(
        scene,
        name="another name",
        provenance={"written": "later"},
        background=GaussianCloud(*(getattr(scene.background, f).clone() for f in CLOUD_FIELDS)),
    )
    first = save_scene(scene, tmp_path / "a")
    second = save_scene(copy, tmp_path / "deep" / "b.r2s")
    assert first.content_hash == second.content_hash
    assert len(first.content_hash) == 64


def test_saving_a_loaded_scene_keeps_the_hash(bundle, tmp_path):
    loaded = load_scene(bundle)
    assert save_scene(loaded, tmp_path / "again").content_hash == loaded.content_hash


def test_lenses_and_shutters_round_trip_exactly(scene, tmp_path):
    lens, shutter = Fisheye((0.1, -0.01, 0.0, 1 / 3), 1.6), Shutter("right_to_left", 20_000)
    known = Optics(scene.rig["rear"].K * [[1.1], [1.1], [1]], BrownConrady(), shutter)
    front, rear = scene.rig
    rig = CameraRig((replace(front, lens=lens, shutter=shutter), replace(rear, recorded=known)))
    save_scene(replace(scene, rig=rig), tmp_path / "lens.r2s")
    read = load_scene(tmp_path / "lens.r2s").rig
    assert (read["front"].lens, read["front"].shutter) == (lens, shutter)
    assert (read["rear"].lens, read["rear"].shutter) == (None, Shutter())
    np.testing.assert_array_equal(read["rear"].recorded.K, known.K)
    assert (read["rear"].recorded.lens, read["rear"].recorded.shutter) == (known.lens, shutter)


def test_pinhole_cameras_are_written_without_optics(bundle):
    document = json.loads((bundle / "scene.json").read_text())
    assert all(set(c) == CAMERA_KEYS for c in document["content"]["cameras"])


def test_json_key_order_does_not_matter(scene, bundle):
    file = bundle / "scene.json"
    file.write_text(json.dumps(json.loads(file.read_text()), sort_keys=True, indent=2))
    assert load_scene(bundle).name == scene.name


def flipped_bit(cloud: GaussianCloud, name: str) -> GaussianCloud:
    tensor = getattr(cloud, name).clone()
    tensor.view(torch.int32).view(-1)[5] ^= 1
    return replace(cloud, **{name: tensor})


def moved_a_little(path: Trajectory) -> Trajectory:
    positions = path.positions.copy()
    positions[2, 1] = np.nextafter(positions[2, 1], 1)
    return Trajectory(path.times_us, positions, path.quaternions)


def with_object(scene: Scene, **change: object) -> Scene:
    changed = replace(scene.object("car_3"), **change)
    return replace(scene, objects=dict(scene.objects) | {"car_3": changed})


CHANGES = {
    "ego": lambda s: replace(s, ego=moved_a_little(s.ego)),
    "ego size": lambda s: replace(s, ego_size=(4.6, 1.85, 1.61)),
    "frame times": lambda s: replace(s, frame_times_us=s.frame_times_us + 1),
    "camera": lambda s: replace(
        s, rig=CameraRig((replace(s.rig["front"], width=641), s.rig["rear"]))
    ),
    "camera order": lambda s: replace(s, rig=CameraRig((s.rig["rear"], s.rig["front"]))),
    "object order": lambda s: replace(s, objects=dict(reversed(s.objects.items()))),
    "object category": lambda s: with_object(s, category="truck"),
    "object path": lambda s: with_object(s, trajectory=moved_a_little(s.ego)),
    "object cloud": lambda s: with_object(s, cloud=flipped_bit(s.object("car_3").cloud, "sh")),
    "no sky": lambda s: replace(s, sky=None),
    "sky": lambda s: replace(s, sky=Sky(s.sky.faces * 0.999)),
    **{
        f"background {name}": lambda s, name=name: replace(
            s, background=flipped_bit(s.background, name)
        )
        for name in CLOUD_FIELDS
    },
}


@pytest.mark.parametrize("what", CHANGES)
def test_the_hash_covers_every_part_of_a_scene(scene, tmp_path, what):
    plain = save_scene(scene, tmp_path / "plain")
    changed = save_scene(CHANGES[what](scene), tmp_path / "changed")
    assert plain.content_hash != changed.content_hash


# Summary


def test_the_summary_describes_the_scene(scene, bundle):
    summary = read_scene_summary(bundle)
    assert summary.name == scene.name
    assert summary.content_hash == load_scene(bundle).content_hash
    assert summary.gaussian_count == scene.gaussian_count
    assert summary.rig.names == scene.rig.names
    assert [o.object_id for o in summary.objects] == list(scene.objects)
    assert [o.gaussians for o in summary.objects] == [20, 21, 22]
    assert (summary.start_us, summary.end_us) == (scene.start_us, scene.end_us)
    assert_same_trajectory(summary.objects[0].trajectory, scene.object("car_7").trajectory)
    assert summary.bounds[0] == tuple(scene.background.means.amin(0).tolist())
    assert summary.bounds[1] == tuple(scene.background.means.amax(0).tolist())
    assert summary.sky_resolution == 4
    loaded = load_scene(bundle)
    assert loaded.nbytes <= summary.nbytes < loaded.nbytes + 4096


def test_the_summary_does_not_need_tensor_files(bundle):
    for file in bundle.glob("*.safetensors"):
        file.unlink()
    assert read_scene_summary(bundle).name == "street"


# Assets


@pytest.fixture
def asset(make_cloud) -> Asset:
    return Asset("taxi", "car", (4.4, 1.8, 1.5), make_cloud(33, degree=3), {"source": "test"})


def test_an_asset_round_trips_exactly(asset, tmp_path):
    saved = save_asset(asset, tmp_path / "taxi.r2s")
    loaded = load_asset(tmp_path / "taxi.r2s")
    assert (loaded.asset_id, loaded.category, loaded.size) == ("taxi", "car", (4.4, 1.8, 1.5))
    assert loaded.provenance == {"source": "test"}
    assert loaded.content_hash == saved.content_hash
    assert_same_cloud(loaded.cloud, asset.cloud)


def test_scenes_and_assets_are_not_interchangeable(asset, bundle, tmp_path):
    save_asset(asset, tmp_path / "taxi.r2s")
    with pytest.raises(BundleError, match="kind 'scene', not 'asset'"):
        load_asset(bundle)
    for read in (load_scene, read_scene_summary):
        with pytest.raises(BundleError, match="kind 'asset', not 'scene'"):
            read(tmp_path / "taxi.r2s")


def test_a_damaged_asset_is_refused(asset, tmp_path):
    save_asset(asset, tmp_path / "taxi.r2s")
    file = tmp_path / "taxi.r2s" / "asset.safetensors"
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(BundleError, match=r"asset.safetensors"):
        load_asset(tmp_path / "taxi.r2s")


def test_a_broadcast_view_of_one_gaussian_is_saved(scene, tmp_path):
    asset = scene.objects[next(iter(scene.objects))]
    one = GaussianCloud(
        means=torch.zeros(1, 3),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        scales=torch.full((1, 3), 0.1),
        opacities=torch.tensor(0.5).expand(1),
        sh=torch.zeros(1, 1, 3),
    )
    save_scene(
        replace(scene, objects={asset.object_id: replace(asset, cloud=one)}), tmp_path / "a.r2s"
    )
    loaded = load_scene(tmp_path / "a.r2s").objects[asset.object_id].cloud
    assert_same_cloud(loaded, one)
