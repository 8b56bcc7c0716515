"""The writer contract, and each format checked by a reader that shares no code with its writer."""

from __future__ import annotations

import base64
import dataclasses
import functools
import json
import lzma
import tarfile
import zlib
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from real2sim.cli import build_app
from real2sim_server.datasets.clips import POINT, Clip
from real2sim_server.datasets.writers import WRITERS
from real2sim_server.datasets.writers.categories import CATEGORIES
from real2sim_server.datasets.writers.kitti import VELODYNE, link_or_copy, write_scans
from real2sim_server.logs import LogError, open_log
from real2sim_server.logs.readers.common import compensate_sweep
from real2sim_server.scene.io import save_scene

FRAMES, CAMERAS = 5, 2
FRONTS = {"image_02", "cam_front", "ring_front_center", "front"}


def labels(exported: Path, clip: str = "0000") -> dict:
    return json.loads((exported / "labels" / clip / "labels.json").read_text())


def tables(exported: Path) -> dict[str, list[dict]]:
    folder = exported / "nuscenes" / "v1.0-real2sim"
    return {path.stem: json.loads(path.read_text()) for path in folder.glob("*.json")}


@pytest.mark.parametrize("writer", WRITERS, ids=lambda w: w.name)
def test_a_writer_fills_its_folder_and_lists_the_files(exported, writer):
    files = [path for path in (exported / writer.name).rglob("*") if path.is_file()]
    assert files
    assert all(path.stat().st_size for path in files if path.suffix != ".txt")
    assert writer.holds
    assert not any(str(exported.parent).encode() in p.read_bytes() for p in files)


def open_first_clip(exported: Path, folder: str, sequence: str | None):
    if folder == "argoverse2":
        sweep = next(exported.glob("argoverse2/*/*/sensors/lidar/0.feather"))
        return open_log(sweep.parents[2])
    if folder == "waymo":
        poses = next(exported.glob("waymo/*/vehicle_pose/*_0000.parquet"))
        return open_log(poses.parents[1], sequence=poses.stem)
    return open_log(exported / folder, sequence=sequence)


@pytest.mark.parametrize(
    ("folder", "sequence"),
    [
        ("kitti", "0000"),
        ("kitti_raw", "2011_09_26_drive_0000_sync"),
        ("nuscenes", "scene-0000"),
    ],
)
def test_the_folder_of_a_format_is_opened_as_a_log(exported, folder, sequence):
    assert open_log(exported / folder, sequence=sequence).frame_count > 1


def test_a_data_set_with_several_formats_lists_its_logs(exported):
    with pytest.raises(LogError, match=r"open one of these folders: .*kitti/tracking \(kitti\)"):
        open_log(exported)


def boxes_of_log(log, t_us: int):
    return {
        track.object_id: (track.trajectory.transform(t_us), track.size)
        for track in log.tracks
        if track.trajectory.covers(t_us)
    }


@pytest.mark.parametrize(
    ("folder", "sequence"),
    [
        ("kitti/tracking", "0000"),
        ("kitti_raw/2011_09_26", "2011_09_26_drive_0000_sync"),
        ("nuscenes", "scene-0000"),
        ("argoverse2", None),
        ("waymo", None),
    ],
)
def test_our_own_reader_finds_every_box_in_place(exported, folder, sequence):
    log = open_first_clip(exported, folder, sequence)
    frame = labels(exported)["frames"][0]
    first = np.array(frame["T_world_ego"])
    found = boxes_of_log(log, int(log.frame_times_us[0]))
    assert len(found) == len(frame["objects"]) == 3
    for given in frame["objects"]:
        errors = [
            np.abs(first @ pose - given["T_world_object"]).max()
            + np.abs(np.array(size) - given["size"]).max()
            for pose, size in found.values()
        ]
        assert min(errors) < 1e-6


@pytest.mark.parametrize(
    ("folder", "sequence"),
    [
        ("kitti/tracking", "0000"),
        ("kitti_raw/2011_09_26", "2011_09_26_drive_0000_sync"),
        ("nuscenes", "scene-0000"),
        ("argoverse2", None),
        ("waymo", None),
    ],
)
def test_our_own_reader_finds_camera_images_and_points(exported, tiny_scene, folder, sequence):
    log = open_first_clip(exported, folder, sequence)
    given = tiny_scene.rig["front"]
    camera = next(c for c in log.rig if c.name in FRONTS)
    np.testing.assert_allclose(camera.K, given.K, atol=1e-6)
    np.testing.assert_allclose(camera.T_vehicle_camera, given.T_vehicle_camera, atol=1e-6)
    written = cv2.imread(str(exported / "labels/0000/rgb/front/000001.png"))[..., ::-1]
    difference = np.abs(log.image(camera.name, 1).astype(int) - written)
    assert difference.mean() < 3
    points = np.load(exported / "labels/0000/points/000000.npy")
    found = log.lidar(0).points
    assert found.shape == points["xyz"].shape
    # Range images have their own order.
    away, nearest = KDTree(found).query(points["xyz"])
    assert away.max() < 1e-4
    assert len(np.unique(nearest)) == len(found)


KITTI_SCANS = {
    "kitti": "t*/training/velodyne/{}/*.bin",
    "kitti_raw": "*/*_drive_{}_sync/velodyne_points/data/*.bin",
}


@pytest.mark.parametrize("folder", KITTI_SCANS)
def test_the_kitti_sequences_of_all_cameras_have_one_copy_of_each_sweep(exported, folder):
    front, left = (
        sorted((exported / folder).glob(KITTI_SCANS[folder].format(name)))
        for name in ("0000", "0001")
    )
    assert len(front) == len(labels(exported)["frames"])
    assert all(one.samefile(other) for one, other in zip(front, left, strict=True))
    names = {path.stat().st_ino for path in (exported / folder).rglob("*.bin")}
    assert len(names) == FRAMES


@pytest.mark.parametrize(
    ("folder", "sequence"),
    [("kitti/tracking", "0001"), ("kitti_raw/2011_09_26", "2011_09_26_drive_0001_sync")],
)
def test_kitti_points_and_boxes_of_a_side_camera_are_in_place(
    exported, tiny_scene, folder, sequence
):
    log = open_first_clip(exported, folder, sequence)
    to_camera = np.linalg.inv(log.rig["image_02"].T_vehicle_camera)
    given_to_camera = np.linalg.inv(tiny_scene.rig["left"].T_vehicle_camera)
    frame = labels(exported)["frames"][1]
    points = np.load(exported / "labels/0000/points/000001.npy")["xyz"]
    found = log.lidar(1).points
    np.testing.assert_allclose(
        found @ to_camera[:3, :3].T + to_camera[:3, 3],
        points @ given_to_camera[:3, :3].T + given_to_camera[:3, 3],
        atol=1e-4,
    )
    t_us = int(log.frame_times_us[1])
    T_camera_world = to_camera @ np.linalg.inv(log.ego.transform(t_us))
    places = [T_camera_world @ pose for pose, _ in boxes_of_log(log, t_us).values()]
    for subject in frame["objects"]:
        truth = given_to_camera @ subject["T_ego_object"]
        assert min(np.abs(pose - truth).max() for pose in places) < 1e-6


def test_kitti_scans_of_a_curve_have_every_point_in_place_or_not_at_all(tmp_path):
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("z", [[0.0], [0.02], [0.04]]).as_matrix()
    poses[:, 0, 3] = 0, 1.2, 2.4
    rng = np.random.default_rng(0)
    rows = np.zeros(20_000, POINT)
    azimuth, away = rng.uniform(-np.pi, np.pi, len(rows)), rng.uniform(4, 60, len(rows))
    rows["xyz"] = np.stack([away * np.cos(azimuth), away * np.sin(azimuth), np.ones(len(rows))], -1)
    (tmp_path / "points").mkdir()
    for k in range(3):
        np.save(tmp_path / "points" / f"{k:06d}.npy", rows)
    frames = [{"T_world_ego": pose.tolist()} for pose in poses]
    paths = write_scans(Clip(tmp_path, "0000", "train", frames), tmp_path)
    scan = np.fromfile(paths[1], np.float32).reshape(-1, 4)[:, :3].astype(np.float64)
    offset = -np.arctan2(scan[:, 1], scan[:, 0]) / (2 * np.pi)
    found = compensate_sweep(scan + VELODYNE, offset, poses, 1)
    assert len(found) > 0.99 * len(rows)
    assert KDTree(rows["xyz"]).query(found)[0].max() < 1e-3


def test_kitti_scans_are_copied_where_links_are_refused(tmp_path, monkeypatch):
    def refuse(*_args: object) -> None:
        raise PermissionError

    monkeypatch.setattr("os.link", refuse)
    (tmp_path / "one").write_bytes(b"scan")
    link_or_copy(tmp_path / "one", tmp_path / "there" / "two")
    assert (tmp_path / "there" / "two").read_bytes() == b"scan"


def test_kitti_object_rows_have_fifteen_columns_for_visible_objects(exported):
    rows = (exported / "kitti/object/training/label_2/000000.txt").read_text().splitlines()
    seen = [v for v in labels(exported)["frames"][0]["views"]["front"] if v["box_2d_modal"]]
    assert len(rows) == len(seen) > 0
    for row, view in zip(rows, seen, strict=True):
        words = row.split()
        assert len(words) == 15
        box = np.maximum(np.array(view["box_2d_modal"]) - 0.5, 0)
        np.testing.assert_allclose([float(word) for word in words[4:8]], box)


def test_nuscenes_has_no_dangling_tokens(exported):
    found = tables(exported)
    assert len(found) == 15
    tokens = {name: {row["token"] for row in rows} for name, rows in found.items()}
    assert all(len(tokens[name]) == len(rows) for name, rows in found.items())
    everywhere = set().union(*tokens.values())
    for rows in found.values():
        for row in rows:
            for key, value in row.items():
                given = value if isinstance(value, list) else [value]
                if key in {"prev", "next"} or key.endswith(("_token", "_tokens")):
                    assert {v for v in given if v} <= everywhere, (key, row)


def test_nuscenes_lists_are_linked_and_files_exist(exported):
    found = tables(exported)
    rows = {row["token"]: row for row in found["sample_data"]}
    assert len(rows) == FRAMES * (CAMERAS + 1)
    for row in rows.values():
        assert (exported / "nuscenes" / row["filename"]).is_file()
        assert row["filename"].startswith("samples" if row["is_key_frame"] else "sweeps")
        if row["next"]:
            assert rows[row["next"]]["prev"] == row["token"]
            assert rows[row["next"]]["timestamp"] > row["timestamp"]
    counts = [row["num_lidar_pts"] for row in found["sample_annotation"]]
    assert sum(counts) > 0


def decoded(counts: str, size: list[int]) -> np.ndarray:
    """A run-length mask as COCO's own decoder reads it."""
    lengths, place = [], 0
    while place < len(counts):
        value, shift, more = 0, 0, True
        while more:
            group = ord(counts[place]) - 48
            value |= (group & 31) << shift
            more, shift, place = bool(group & 32), shift + 5, place + 1
            if not more and group & 16:
                value |= -1 << shift
        lengths.append(value + (lengths[-2] if len(lengths) > 2 else 0))
    flat = np.repeat(np.arange(len(lengths)) % 2, lengths).astype(bool)
    return flat.reshape(size, order="F")


def test_coco_masks_are_the_pixels_of_their_objects(exported):
    content = json.loads((exported / "coco/annotations/instances_train.json").read_text())
    images = {image["id"]: image for image in content["images"]}
    assert content["annotations"]
    for row in content["annotations"]:
        mask = decoded(row["segmentation"]["counts"], row["segmentation"]["size"])
        image = images[row["image_id"]]
        name = f"{image['frame_index']:06d}.png"
        path = exported / "labels" / image["clip"] / "instance" / image["camera"] / name
        instance = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert mask.sum() == row["area"]
        assert (instance[mask] == row["track_id"]).all()
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        x, y, width, height = row["bbox"]
        assert (x, y) == (columns[0], rows[0])
        assert (x + width, y + height) == (columns[-1] + 1, rows[-1] + 1)


@pytest.fixture(scope="module")
def exports(tiny_scene, tmp_path_factory):
    """Exports by the command of scenes whose objects have the given categories."""
    folder = tmp_path_factory.mktemp("categories")

    @functools.cache
    def export(*categories: str) -> Path:
        name = "_".join(categories)
        objects = {
            key: dataclasses.replace(subject, category=category)
            for (key, subject), category in zip(
                tiny_scene.objects.items(), categories, strict=False
            )
        }
        scene = dataclasses.replace(tiny_scene, objects=objects)
        save_scene(scene, folder / f"{name}.r2s")
        given = ["export-dataset", folder / f"{name}.r2s", "--out", folder / name, "--no-flow"]
        given += ["-f", "coco", "-f", "nuscenes", "--period", 1, "--width", 64, "--end-us", 10**6]
        done = CliRunner().invoke(build_app(), [str(a) for a in given])
        assert done.exit_code == 0, done.output
        return folder / name

    return export


def test_category_ids_do_not_depend_on_which_are_present(exports):
    found = []
    for folder in (exports("cyclist", "kiosk", "car"), exports("cyclist", "kiosk")):
        kinds = ("instances", "panoptic")
        paths = [folder / f"coco/annotations/{kind}_train.json" for kind in kinds]
        ids = [
            {c["id"]: c["name"] for c in json.loads(path.read_text())["categories"]}
            for path in paths
        ]
        rows = json.loads(next(folder.rglob("v1.0-real2sim/category.json")).read_text())
        found.append([*ids, {row["name"]: row["index"] for row in rows}])
    assert found[0] == found[1]
    instances, panoptic, lidarseg = found[0]
    coco = ["person", "bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck"]
    assert {1, 2, 3, 4, 6, 7, 8} <= set(instances) <= set(panoptic)
    assert all(coco[number - 1] == instances[number] for number in (1, 2, 3, 4, 6, 7, 8))
    assert instances[94] == "cyclist"
    assert (instances[106], "kiosk" in instances.values()) == ("other", False)
    assert len(lidarseg) == 32
    assert (lidarseg["vehicle.car"], lidarseg["flat.driveable_surface"]) == (17, 24)


def test_coco_exports_of_different_objects_can_be_merged(exports):
    """Concatenated annotations are counted right by the categories of either file."""
    one, other = (
        json.loads((folder / "coco/annotations/instances_train.json").read_text())
        for folder in (exports("cyclist", "kiosk", "car"), exports("cyclist", "kiosk"))
    )
    assert one["categories"] == other["categories"]
    names = {row["id"]: row["name"] for row in one["categories"]}
    merged = one["annotations"] + other["annotations"]
    assert {"cyclist", "kiosk"} <= {row["category"] for row in merged}
    for row in merged:
        wanted = "other" if row["category"] == "kiosk" else row["category"]
        assert names[row["category_id"]] == wanted


def test_the_manifest_counts_boxes_of_categories_that_a_format_lacks(exports):
    folder = exports("cyclist", "kiosk", "car")
    statistics = json.loads((folder / "manifest.json").read_text())["statistics"]
    kiosks = statistics["boxes"]["kiosk"]
    assert statistics["boxes_of_other_categories"] == {
        name: {"kiosk": kiosks} for name in ("coco", "nuscenes")
    }


def test_the_table_of_categories_is_documented():
    page = Path(__file__).parents[3] / "docs" / "datasets.md"
    rows = [
        "| "
        + " | ".join([f"`{name}`", f"{c.coco[0]} {c.coco[1]}", *(str(v or "–") for v in c[1:])])
        + " |"
        for name, c in CATEGORIES.items()
    ]
    assert "\n".join(rows) in page.read_text(encoding="utf-8")


def test_pycocotools_gives_labels_used_as_detections_a_perfect_score(exported):
    coco = pytest.importorskip("pycocotools.coco", exc_type=ImportError)
    evaluation = pytest.importorskip("pycocotools.cocoeval", exc_type=ImportError)
    truth = coco.COCO(str(exported / "coco/annotations/instances_train.json"))
    rows = truth.dataset["annotations"]
    fields = ("image_id", "category_id", "bbox", "segmentation")
    found = truth.loadRes([{**{k: row[k] for k in fields}, "score": 1.0} for row in rows])
    for kind in ("bbox", "segm"):
        run = evaluation.COCOeval(truth, found, kind)
        run.evaluate()
        run.accumulate()
        run.summarize()
        assert run.stats[0] == 1.0


def test_coco_panoptic_png_holds_its_segments(exported):
    content = json.loads((exported / "coco/annotations/panoptic_train.json").read_text())
    row = content["annotations"][0]
    path = exported / "coco/annotations/panoptic_train" / row["file_name"]
    coded = cv2.imread(str(path))[..., ::-1].astype(int)
    ids = coded[..., 0] + 256 * coded[..., 1] + 65536 * coded[..., 2]
    areas = {segment["id"]: segment["area"] for segment in row["segments_info"]}
    assert {int(i): int((ids == i).sum()) for i in np.unique(ids) if i} == areas
    known = {category["id"] for category in content["categories"]}
    assert {segment["category_id"] for segment in row["segments_info"]} <= known


def test_webdataset_groups_the_files_of_a_sample(exported):
    shards = sorted((exported / "webdataset").glob("*.tar"))
    assert [path.name for path in shards] == ["train-000000.tar", "val-000000.tar"]
    keys = []
    for path in shards:
        with tarfile.open(path) as shard:
            members = shard.getmembers()
            assert {(m.mtime, m.uid, m.uname) for m in members} == {(0, 0, "")}
            keys += [member.name.split(".", maxsplit=1)[0] for member in members]
    changes = sum(one != two for one, two in pairwise(keys))
    assert changes + 1 == len(set(keys)) == FRAMES * CAMERAS


def test_mcap_holds_labelled_points_boxes_and_images(exported):
    reader = pytest.importorskip("mcap.reader")
    with (exported / "mcap" / "0000.mcap").open("rb") as file:
        found = {}
        for _, channel, message in reader.make_reader(file).iter_messages():
            found.setdefault(channel.topic, []).append(json.loads(message.data))
    frames = labels(exported)["frames"]
    assert len(found["/lidar"]) == len(found["/boxes"]) == len(frames)
    cloud = found["/lidar"][0]
    stride, fields = cloud["point_stride"], {f["name"]: f["offset"] for f in cloud["fields"]}
    data = np.frombuffer(base64.b64decode(cloud["data"]), np.uint8).reshape(-1, stride)
    points = np.load(exported / "labels/0000/points/000000.npy")
    place = fields["instance"]
    assert (data[:, place : place + 2].copy().view("<u2")[:, 0] == points["instance"]).all()
    ids = [entity["id"] for entity in found["/boxes"][0]["entities"]]
    assert ids == [subject["object_id"] for subject in frames[0]["objects"]]
    image = base64.b64decode(found["/camera/front/instance"][0]["data"])
    assert image == (exported / "labels/0000/instance/front/000000.png").read_bytes()


def waymo(exported: Path, component: str) -> dict[str, list]:
    path = next(exported.glob(f"waymo/*/{component}/*_0000.parquet"))
    return pq.read_table(path).to_pydict()


def test_waymo_has_visible_objects_with_boxes_and_masks(exported):
    frame = labels(exported)["frames"][0]
    given = {v["object_id"]: v["box_2d_modal"] for v in frame["views"]["front"]}
    rows, name = waymo(exported, "camera_box"), "[CameraBoxComponent].box"
    first, front = min(rows["key.frame_timestamp_micros"]), 1
    found = 0
    for k, object_id in enumerate(rows["key.camera_object_id"]):
        key = rows["key.frame_timestamp_micros"][k], rows["key.camera_name"][k]
        if key == (first, front):
            left, _, right, _ = given[object_id]
            assert rows[f"{name}.center.x"][k] == (left + right) / 2
            assert rows[f"{name}.size.x"][k] == right - left
            found += 1
    assert found == sum(box is not None for box in given.values()) > 0
    masks, name = waymo(exported, "camera_segmentation"), "[CameraSegmentationLabelComponent]"
    data = np.frombuffer(masks[f"{name}.panoptic_label"][0], np.uint8)
    label = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    shown = cv2.imread(str(exported / "labels/0000/instance/front/000000.png"), -1)
    assert (label % masks[f"{name}.panoptic_label_divisor"][0] == shown).all()
    assert (label[shown > 0] // 1000 == 2).any()


def test_waymo_points_name_their_object(exported):
    points = np.load(exported / "labels/0000/points/000000.npy")
    rows = waymo(exported, "lidar_segmentation")
    name = "[LiDARSegmentationLabelComponent].range_image_return1"
    shape = rows[f"{name}.shape"][0]
    label = np.array(rows[f"{name}.values"][0]).reshape(shape)
    assert np.unique(label[..., 0]).tolist() == np.unique([0, *points["instance"]]).tolist()
    for number in np.unique(points["instance"]):
        count = int((points["instance"] == number).sum())
        assert number == 0 or (label[..., 0] == number).sum() == count


def ncore_store(exported: Path) -> Path:
    return next(exported.glob("ncore/*/*_0000.ncore4.zarr"))


def test_ncore_has_consolidated_metadata(exported):
    cbor2 = pytest.importorskip("cbor2")
    root = ncore_store(exported)
    content = cbor2.loads(lzma.decompress((root / ".zmetadata.cbor.xz").read_bytes()))
    files = [p for name in (".zgroup", ".zattrs", ".zarray") for p in root.rglob(name)]
    assert content["zarr_consolidated_format"] == 1
    assert len(files) == len(content["metadata"])
    for path in files:
        kept = content["metadata"][path.relative_to(root).as_posix()]
        assert kept == json.loads(path.read_text())


def test_ncore_stores_are_valid_zarr(exported):
    frame = labels(exported)["frames"][1]
    here = ncore_store(exported) / "lidars/lidar_top/frames" / str(frame["t_us"] + 1_000_000)
    points = np.load(exported / "labels/0000/points/000001.npy")

    def array(path: Path) -> np.ndarray:
        about = json.loads((path / ".zarray").read_text())
        data = zlib.decompress((path / ".".join("0" * len(about["shape"]))).read_bytes())
        return np.frombuffer(data, about["dtype"]).reshape(about["shape"])

    rays = array(here / "ray_bundle/direction")
    ranges = array(here / "ray_bundle_returns/distance_m")[0]
    found = rays.astype(np.float64) * ranges[:, None] + [0.9, 0.0, 1.73]
    np.testing.assert_allclose(found, points["xyz"], atol=1e-4)
    assert (array(here / "generic_data/instance") == points["instance"]).all()


def test_ncores_own_reader_opens_our_export(exported, tiny_scene):
    v4 = pytest.importorskip("ncore.data.v4")
    reader = v4.SequenceComponentGroupsReader([ncore_store(exported)])
    frame = labels(exported)["frames"][0]
    stamp = frame["t_us"] + 1_000_000

    poses = reader.open_component_readers(v4.PosesComponent.Reader)["default"]
    found, times = poses.get_dynamic_pose("rig", "world")
    np.testing.assert_allclose(found[0], frame["T_world_ego"])
    assert times[0] == stamp
    given = tiny_scene.rig["front"]
    mount = poses.get_static_pose("front", "rig")
    np.testing.assert_allclose(mount, given.T_vehicle_camera)
    lenses = reader.open_component_readers(v4.IntrinsicsComponent.Reader)["default"]
    lens = lenses.get_camera_model_parameters("front")
    np.testing.assert_allclose(lens.focal_length, [given.K[0, 0], given.K[1, 1]], rtol=1e-6)
    camera = reader.open_component_readers(v4.CameraSensorComponent.Reader)["front"]
    image = np.asarray(camera.get_frame_image(stamp))
    written = cv2.imread(str(exported / "labels/0000/rgb/front/000000.png"))[..., ::-1]
    assert np.abs(image.astype(int) - written).mean() < 3
    shown = cv2.imread(str(exported / "labels/0000/instance/front/000000.png"), -1)
    assert (camera.get_frame_generic_data(stamp, "instance") == shown).all()
    lidar = reader.open_component_readers(v4.LidarSensorComponent.Reader)["lidar_top"]
    points = np.load(exported / "labels/0000/points/000000.npy")
    assert lidar.get_frame_ray_bundle_count(stamp) == len(points)
    assert lidar.get_frame_ray_bundle_return_valid_mask(stamp).all()
    boxes = reader.open_component_readers(v4.CuboidsComponent.Reader)["default"]
    first = [o for o in boxes.get_observations() if o.timestamp_us == stamp]
    for box, subject in zip(first, frame["objects"], strict=True):
        assert (box.track_id, box.source.name) == (subject["object_id"], "GT_SYNTHETIC")
        np.testing.assert_allclose(box.bbox3.centroid, np.array(subject["T_ego_object"])[:3, 3])
