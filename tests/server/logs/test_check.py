from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from real2sim.cli import build_app
from real2sim_server.logs import DrivingLog, LogError, ObjectTrack, check_log, open_log
from real2sim_server.logs.images import encode_image
from real2sim_server.scene import CameraRig
from real2sim_server.synthetic import SyntheticLog

LAYOUTS = ("native", "kitti", "kitti_raw", "waymo_v2", "waymo_v1", "argoverse2", "nuscenes",
           "street_gaussians", "drivestudio")  # fmt: skip


@pytest.fixture
def drivestudio(written_drivestudio: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written_drivestudio, tmp_path / "drive"))


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("decode", [False, True])
def test_good_logs_pass(layout: str, decode: bool, request: pytest.FixtureRequest) -> None:
    log = open_log(request.getfixturevalue(f"written_{layout}"))
    seen = []
    check_log(log, decode_images=decode, on_progress=lambda done, total: seen.append((done, total)))
    assert seen == [(1, 3), (2, 3), (3, 3)]


@pytest.mark.parametrize("name", ["000000.png", "000001.png"])
def test_cut_image_is_named(kitti_folder: Path, name: str) -> None:
    path = kitti_folder / "training/image_02/0007" / name
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(LogError, match=f"image_02/0007/{name}: the image is cut off"):
        check_log(open_log(kitti_folder))


def test_cut_jpeg_is_named(drivestudio: Path) -> None:
    path = drivestudio / "images/001_0.jpg"
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(LogError, match=r"images/001_0\.jpg: the image is cut off"):
        check_log(open_log(drivestudio))


def test_damage_inside_a_jpeg_is_found_by_decoding(drivestudio: Path) -> None:
    path = drivestudio / "images/001_0.jpg"
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 40] = b"\xff\xd0" * 20
    path.write_bytes(data)
    log = open_log(drivestudio)
    check_log(log)
    with pytest.raises(LogError, match=r"images/001_0\.jpg: is a damaged JPEG"):
        check_log(log, decode_images=True)


def test_jpegs_decode_as_opencv_decodes_them(tiny_log: SyntheticLog) -> None:
    data = encode_image(tiny_log.image("front", 0), ".jpg")
    from real2sim_server.logs.images import decode_image

    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(decode_image(data, "here").astype(int) - expected).max() <= 2


def test_broken_sweep_is_named(native_folder: Path) -> None:
    (native_folder / "lidar/000002.npz").write_bytes(b"PK\x03\x04 no archive")
    with pytest.raises(LogError, match=r"lidar/000002\.npz"):
        check_log(open_log(native_folder))


def test_every_sweep_is_read(native_folder: Path) -> None:
    first, empty, broken = (native_folder / f"lidar/00000{i}.npz" for i in range(3))
    with np.load(first) as parts:
        np.savez(empty, **{k: v[:0] if k != "origin" else v for k, v in parts.items()})
    assert check_log(open_log(native_folder)) == [1]
    told = CliRunner().invoke(build_app(), ["log-info", str(native_folder), "--check"])
    assert "the sweeps of 1 frames hold no points: [1]" in told.output
    broken.write_bytes(b"PK no archive")
    told = CliRunner().invoke(build_app(), ["log-info", str(native_folder), "--check"])
    assert told.exit_code != 0
    assert "lidar/000002.npz" in told.output.replace("\n", "")


def test_log_without_images_says_which_cameras_lack_them(
    written_argoverse2: Path, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(written_argoverse2, tmp_path / "log"))
    shutil.rmtree(folder / "sensors/cameras")
    log = open_log(folder)
    assert len(log.lidar(0).points) > 1000
    with pytest.raises(LogError, match=r"cannot be trained on: its cameras \['ring_front_center',"):
        check_log(log)
    with pytest.raises(LogError, match="camera 'ring_front_left' has no images"):
        log.image("ring_front_left", 0)


def _without_cameras(log: DrivingLog) -> DrivingLog:
    return dataclasses.replace(log, rig=CameraRig(()))


def _unsorted(log: DrivingLog) -> DrivingLog:
    return dataclasses.replace(log, frame_times_us=log.frame_times_us[::-1].copy())


def _outside(log: DrivingLog) -> DrivingLog:
    return dataclasses.replace(log, image_times_us={"front": log.frame_times_us + 1})


def _too_few_times(log: DrivingLog) -> DrivingLog:
    return dataclasses.replace(log, image_times_us={"front": log.frame_times_us[1:]})


def _track(log: DrivingLog, **values: object) -> DrivingLog:
    changed: ObjectTrack = dataclasses.replace(log.tracks[1], **values)  # type: ignore[arg-type]
    return dataclasses.replace(log, tracks=(log.tracks[0], changed, *log.tracks[2:]))


BAD_LOGS: dict[str, tuple[Callable[[DrivingLog], DrivingLog], str]] = {
    "no cameras": (_without_cameras, "cannot be trained on: it has no cameras"),
    "unsorted": (_unsorted, "frame times must increase strictly"),
    "image after the last pose": (_outside, "camera 'front' takes an image at 200001 us"),
    "image times missing": (_too_few_times, "camera 'front' has 2 image times for 3 frames"),
    "flat box": (lambda log: _track(log, size=(4.0, 0.0, 1.5)), "needs a positive length"),
    "box of no number": (lambda log: _track(log, size=(np.nan, 2.0, 1.5)), "needs a positive"),
    "twice": (lambda log: _track(log, object_id=log.tracks[0].object_id), "is there twice"),
}


@pytest.mark.parametrize("case", BAD_LOGS)
def test_bad_log_is_refused(tiny_log: SyntheticLog, case: str) -> None:
    change, message = BAD_LOGS[case]
    with pytest.raises(LogError, match=message):
        check_log(change(tiny_log))
