"""Exports opened with their formats' official devkits, which are not project dependencies."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

FRAMES, CAMERAS = 5, 2


def labels(exported: Path, clip: str = "0000") -> dict:
    return json.loads((exported / "labels" / clip / "labels.json").read_text())


@pytest.fixture(scope="module")
def nusc(exported):
    devkit = pytest.importorskip("nuscenes.nuscenes", reason="nuscenes-devkit is not installed")
    root = str(exported / "nuscenes")
    return devkit.NuScenes(version="v1.0-real2sim", dataroot=root, verbose=False)


def test_nuscenes_devkit_walks_from_scene_to_scene_through_all_samples(nusc):
    seen = []
    for scene in nusc.scene:
        token = scene["first_sample_token"]
        while token:
            sample = nusc.get("sample", token)
            assert set(sample["data"]) == {"LIDAR_TOP", *(c for c in sample["data"] if "CAM" in c)}
            seen.append(token)
            token = sample["next"]
    assert len(seen) == len(set(seen)) == len(nusc.sample) > 0


def test_nuscenes_devkit_finds_boxes_in_the_lidar_frame(nusc, exported):
    frame = labels(exported)["frames"][0]
    (scene,) = (s for s in nusc.scene if s["name"] == "scene-0000")
    sample = nusc.get("sample", scene["first_sample_token"])
    lidar = nusc.get("sample_data", sample["data"]["LIDAR_TOP"])
    mount = nusc.get("calibrated_sensor", lidar["calibrated_sensor_token"])
    path, boxes, _ = nusc.get_sample_data(lidar["token"])
    assert Path(path).is_file()
    assert len(boxes) == len(frame["objects"])
    for box, given in zip(boxes, frame["objects"], strict=True):
        # The mount is not rotated: the two frames differ only in position.
        centre = box.center + mount["translation"]
        np.testing.assert_allclose(centre, np.array(given["T_ego_object"])[:3, 3], atol=1e-6)
        np.testing.assert_allclose(box.wlh[[1, 0, 2]], given["size"], atol=1e-9)


def test_nuscenes_devkit_finds_each_images_boxes_in_front_of_its_camera(nusc):
    cameras = [row for row in nusc.sample_data if row["sensor_modality"] == "camera"]
    assert len(cameras) == FRAMES * CAMERAS
    before = 0
    for row in cameras:
        path, boxes, K = nusc.get_sample_data(row["token"])
        assert Path(path).is_file()
        assert K.shape == (3, 3)
        before += len(boxes)
        assert all(box.center[2] > 0 for box in boxes)
    assert before > 0


def test_nuscenes_devkit_reads_a_class_and_an_instance_for_every_point(nusc, exported):
    data = pytest.importorskip("nuscenes.utils.data_io")
    classes = pytest.importorskip("nuscenes.utils.data_classes")
    assert len(nusc.lidarseg) == len(nusc.panoptic) == len(nusc.sample)
    for kind in ("lidarseg", "panoptic"):
        for row in getattr(nusc, kind):
            sweep = nusc.get("sample_data", row["sample_data_token"])
            path = exported / "nuscenes" / sweep["filename"]
            found = data.load_bin_file(str(exported / "nuscenes" / row["filename"]), type=kind)
            assert len(found) == classes.LidarPointCloud.from_file(str(path)).points.shape[1]


def test_nuscenes_devkit_finds_the_speed_of_moving_objects(nusc):
    speeds = [np.linalg.norm(nusc.box_velocity(row["token"])) for row in nusc.sample_annotation]
    known = [speed for speed in speeds if np.isfinite(speed)]
    assert known
    assert max(known) > 1.0


def test_argoverse_api_counts_the_points_in_each_box_as_we_do(exported):
    loader = pytest.importorskip(
        "av2.datasets.sensor.av2_sensor_dataloader", reason="av2 is not installed"
    )
    from av2.utils.io import read_feather, read_lidar_sweep

    counted = 0
    for split in sorted(path for path in (exported / "argoverse2").iterdir() if path.is_dir()):
        logs = loader.AV2SensorDataLoader(data_dir=split, labels_dir=split)
        for name in logs.get_log_ids():
            rows = read_feather(split / name / "annotations.feather")
            for stamp in logs.get_ordered_log_lidar_timestamps(name):
                points = read_lidar_sweep(logs.get_lidar_fpath_at_lidar_timestamp(name, stamp))
                cuboids = logs.get_labels_at_lidar_timestamp(name, stamp).cuboids
                given = rows[rows["timestamp_ns"] == stamp]["num_interior_pts"].tolist()
                found = [len(cuboid.compute_interior_points(points)[0]) for cuboid in cuboids]
                assert found == given
                counted += sum(found)
    assert counted > 0


COMPONENTS = {
    "camera_box": "CameraBoxComponent",
    "camera_calibration": "CameraCalibrationComponent",
    "camera_image": "CameraImageComponent",
    "camera_segmentation": "CameraSegmentationLabelComponent",
    "lidar": "LiDARComponent",
    "lidar_box": "LiDARBoxComponent",
    "lidar_calibration": "LiDARCalibrationComponent",
    "lidar_pose": "LiDARPoseComponent",
    "lidar_segmentation": "LiDARSegmentationLabelComponent",
    "vehicle_pose": "VehiclePoseComponent",
}


@pytest.fixture(scope="module")
def waymo(exported):
    """Rows of the first clip, as objects of the dataset's own library."""
    v2 = pytest.importorskip("waymo_open_dataset.v2", reason="waymo-open-dataset is not installed")
    from pyarrow import parquet

    def read(component: str) -> list:
        path = next(exported.glob(f"waymo/*/{component}/*_0000.parquet"))
        kind = getattr(v2, COMPONENTS[component])
        return [kind.from_dict(row) for row in parquet.read_table(path).to_pylist()]

    return read


def test_waymo_library_parses_every_row(waymo, exported):
    folders = {path.name for path in exported.glob("waymo/*/*") if path.is_dir()}
    assert folders == set(COMPONENTS)
    assert all(waymo(component) for component in COMPONENTS)


def test_waymo_library_finds_our_points_in_the_range_image(waymo, exported):
    from scipy.spatial import KDTree
    from waymo_open_dataset.v2.perception.utils import lidar_utils

    first = min(lidar.key.frame_timestamp_micros for lidar in waymo("lidar"))
    (sweep,) = (s for s in waymo("lidar") if s.key.frame_timestamp_micros == first)
    (calibration,) = waymo("lidar_calibration")
    (pixel_pose,) = (p for p in waymo("lidar_pose") if p.key.frame_timestamp_micros == first)
    (pose,) = (p for p in waymo("vehicle_pose") if p.key.frame_timestamp_micros == first)
    found = lidar_utils.convert_range_image_to_point_cloud(
        sweep.range_image_return1, calibration, pixel_pose.range_image_return1, pose
    ).numpy()
    points = np.load(exported / "labels/0000/points/000000.npy")["xyz"]
    assert len(found) == len(points)
    assert KDTree(found).query(points)[0].max() < 1e-3


def test_waymo_library_finds_boxes_where_they_are(waymo, exported):
    frame = labels(exported)["frames"][0]
    rows = waymo("lidar_box")
    first = min(row.key.frame_timestamp_micros for row in rows)
    boxes = [row.box for row in rows if row.key.frame_timestamp_micros == first]
    places = np.array([(box.center.x, box.center.y, box.center.z) for box in boxes])
    given = np.array([subject["T_ego_object"] for subject in frame["objects"]])[:, :3, 3]
    np.testing.assert_allclose(np.sort(places, axis=0), np.sort(given, axis=0), atol=1e-6)
