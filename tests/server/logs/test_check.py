from __future__ import annotations

import dataclasses
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import Result
from typer.testing import CliRunner

from real2sim.cli import build_app
from real2sim_server.logs import (
    DrivingLog,
    LogError,
    ObjectTrack,
    check_log,
    log_of_frames,
    open_log,
    usable_log,
    write_native_log,
)
from real2sim_server.logs.check import problems_of
from real2sim_server.logs.images import encode_image
from real2sim_server.scene import CameraRig, Trajectory
from real2sim_server.synthetic import SyntheticLog

LAYOUTS = ("native", "kitti", "kitti_raw", "waymo_v2", "waymo_v1", "argoverse2", "nuscenes",
           "street_gaussians", "drivestudio")  # fmt: skip


@pytest.fixture
def drivestudio(written_drivestudio: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written_drivestudio, tmp_path / "drive"))


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("contents", [False, True])
def test_good_logs_pass(layout: str, contents: bool, request: pytest.FixtureRequest) -> None:
    log, seen = open_log(request.getfixturevalue(f"written_{layout}")), []
    check = check_log(
        log, contents=contents, on_progress=lambda done, total: seen.append((done, total))
    )
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert not check.bad_images
    assert not check.bad_sweeps
    assert not problems_of(log)


@pytest.mark.parametrize("name", ["000000.png", "000001.png"])
def test_truncated_image_is_named(kitti_folder: Path, name: str) -> None:
    path = kitti_folder / "training/image_02/0007" / name
    path.write_bytes(path.read_bytes()[:-20])
    (told,) = open_log(kitti_folder).left_out["images"]
    assert f"image_02/0007/{name}: the image is cut off" in told


def test_truncated_jpeg_is_named(drivestudio: Path) -> None:
    path = drivestudio / "images/001_0.jpg"
    path.write_bytes(path.read_bytes()[:-300])
    (told,) = open_log(drivestudio).left_out["images"]
    assert "images/001_0.jpg: the image is cut off" in told


def test_damage_inside_a_jpeg_is_found_only_by_decoding(drivestudio: Path) -> None:
    path = drivestudio / "images/001_0.jpg"
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 40] = b"\xff\xd0" * 20
    path.write_bytes(data)
    log = open_log(drivestudio)
    assert log.has_image("front", 1)
    assert "images/001_0.jpg: is a damaged JPEG" in check_log(log).bad_images["front", 1]


def test_jpeg_decoding_matches_opencv(tiny_log: SyntheticLog) -> None:
    data = encode_image(tiny_log.image("front", 0), ".jpg")
    from real2sim_server.logs.images import decode_image

    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(decode_image(data, "here").astype(int) - expected).max() <= 2


def told(folder: Path, *options: str) -> Result:
    return CliRunner().invoke(build_app(), ["log-info", str(folder), *options])


def test_the_report_takes_a_drive_that_is_one_file(written_waymo_v1: Path) -> None:
    done = told(written_waymo_v1 / "tiny.tfrecord")
    assert done.exit_code == 0
    assert "frames    3 in 0.2 s" in done.output


@pytest.fixture(scope="session")
def written_long(tiny_log: SyntheticLog, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight frames of the same street. A report reads frames 0, 4 and 7."""
    times = np.arange(8) * 100_000
    still = Trajectory(times[[0, 7]], np.zeros((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1)))
    frames = log_of_frames(tiny_log, [0, 1, 2, 0, 1, 2, 0, 1])
    long = dataclasses.replace(frames, frame_times_us=times, ego=still)
    return write_native_log(long, tmp_path_factory.mktemp("long") / "drive")


@pytest.fixture
def long_folder(written_long: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written_long, tmp_path / "long"))


def change_sweep(path: Path, change: Callable[[dict[str, np.ndarray]], object]) -> None:
    with np.load(path) as parts:
        arrays = dict(parts)
    change(arrays)
    np.savez(path, **arrays)  # type: ignore[arg-type]


def not_a_number(name: str) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        change_sweep(path, lambda arrays: arrays[name].flat.__setitem__(1, np.nan))

    return damage


def four_columns(path: Path) -> None:
    change_sweep(path, lambda a: a.update(points=np.c_[a["points"], a["intensity"]]))


def without_origin(path: Path) -> None:
    change_sweep(path, lambda a: a.pop("origin"))


def as_text(path: Path) -> None:
    change_sweep(path, lambda a: a.update(intensity=a["intensity"].astype(str)))


def cut_off(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def absolute_times(path: Path) -> None:
    change_sweep(
        path, lambda a: a.update(offset_us=a["offset_us"] + np.int64(1_700_000_000_000_000))
    )


HEADERS: dict[str, tuple[Callable[[Path], None], str]] = {
    "no origin": (without_origin, "has no array 'origin'"),
    "four columns": (four_columns, r"points must be \(\d+, 3\), not \(\d+, 4\)"),
    "text": (as_text, "intensity must hold real numbers"),
    "cut off": (cut_off, "is the file cut off"),
    "missing": (Path.unlink, "no such file"),
}
CONTENTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "NaN point": (not_a_number("points"), "points must be finite, but 1 of its values are NaN"),
    "NaN intensity": (not_a_number("intensity"), "intensity must be finite"),
    "NaN origin": (not_a_number("origin"), "origin must be finite"),
    "absolute times": (
        absolute_times,
        "offset_us ranges from .* must be relative",
    ),
}


@pytest.mark.parametrize("damage", HEADERS)
def test_a_sweep_with_a_bad_header_is_left_out(long_folder: Path, damage: str) -> None:
    how, message = HEADERS[damage]
    how(long_folder / "lidar/000002.npz")
    done = told(long_folder)
    assert done.exit_code == 0
    assert "left out  sweeps: 1" in done.output
    assert re.search(rf"lidar/000002\.npz: .*{message}", done.output)
    assert told(long_folder, "--strict").exit_code == 1


@pytest.mark.parametrize("damage", CONTENTS)
def test_a_sweep_with_bad_contents_is_found_only_by_reading_it(
    long_folder: Path, damage: str
) -> None:
    how, message = CONTENTS[damage]
    how(long_folder / "lidar/000002.npz")
    assert "left out" not in told(long_folder).output
    done = told(long_folder, "--check")
    assert done.exit_code == 0
    assert re.search(rf"lidar/000002\.npz: {message}", done.output)


def test_all_bad_files_are_reported_together(long_folder: Path, tmp_path: Path) -> None:
    """Bad files do not suppress the rest of the report, even in frames that it reads."""
    for frame, (damage, _) in zip((0, 1, 4, 5, 6), HEADERS.values(), strict=True):
        damage(long_folder / f"lidar/{frame:06d}.npz")
    not_a_number("points")(long_folder / "lidar/000002.npz")
    cut_off(long_folder / "images/front/000003.png")
    (long_folder / "images/front_left/000004.png").unlink()
    figures, pictures = tmp_path / "figures.json", tmp_path / "pictures"
    done = told(long_folder, "--check", "--json", str(figures), "--out", str(pictures))
    assert done.exit_code == 1
    for line in (
        "frames    8 in 0.7 s",
        "checked   22 images and 3 sweeps read\n",
        "left out  images: 2",
        "left out  sweeps: 6",
        "left out    and 1 more",
        "7 of 8 frames lack an image, a sweep or a pose; at most 20% may",
    ):
        assert line in done.output
    found = json.loads(figures.read_text())
    assert {kind: len(texts) for kind, texts in found["left_out"].items()} == {
        "images": 2,
        "sweeps": 6,
    }
    assert (pictures / "frame_000007.jpg").is_file()


def test_sweeps_without_points_are_left_out(native_folder: Path) -> None:
    empty = native_folder / "lidar/000001.npz"
    with np.load(empty) as parts:
        np.savez(empty, **{k: v[:0] if k != "origin" else v for k, v in parts.items()})
    log = open_log(native_folder)
    assert log.absent_sweeps == {1}
    assert log.left_out["sweeps"] == ("sweep of frame 1: has no points",)


def test_what_is_absent_stays_so_in_a_selection(native_folder: Path) -> None:
    (native_folder / "images/front/000002.png").write_bytes(b"no image")
    without_origin(native_folder / "lidar/000002.npz")
    selected = log_of_frames(open_log(native_folder), [0, 2])
    assert selected.absent_images == {("front", 1)}
    assert selected.absent_sweeps == {1}


def test_a_log_may_lack_a_fifth_of_its_frames_unless_strict(long_folder: Path) -> None:
    (long_folder / "images/front/000002.png").unlink()
    log = usable_log(open_log(long_folder))
    assert log.absent_images == {("front", 2)}
    with pytest.raises(LogError, match=r"is not complete:\nimages: 1\n.*front/000002\.png"):
        usable_log(log, strict=True)
    (long_folder / "images/front_left/000005.png").unlink()
    with pytest.raises(LogError, match="2 of 8 frames lack an image, a sweep or a pose"):
        usable_log(open_log(long_folder))


def test_cameras_without_images_are_named(written_argoverse2: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(written_argoverse2, tmp_path / "log"))
    shutil.rmtree(folder / "sensors/cameras")
    log = open_log(folder)
    assert len(log.lidar(0).points) > 1000
    (problem,) = problems_of(log)
    assert "cannot be trained on: it has no usable camera (camera 'ring_front_center'" in problem


def _without_cameras(log: DrivingLog) -> DrivingLog:
    return dataclasses.replace(log, rig=CameraRig(()))


def _unsorted(log: DrivingLog) -> DrivingLog:
    return dataclasses.replace(log, frame_times_us=log.frame_times_us[::-1].copy())


def _too_few_times(log: DrivingLog) -> DrivingLog:
    return dataclasses.replace(log, image_times_us={"front": log.frame_times_us[1:]})


def _track(log: DrivingLog, **values: object) -> DrivingLog:
    changed: ObjectTrack = dataclasses.replace(log.tracks[1], **values)  # type: ignore[arg-type]
    return dataclasses.replace(log, tracks=(log.tracks[0], changed, *log.tracks[2:]))


BAD_LOGS: dict[str, tuple[Callable[[DrivingLog], DrivingLog], str]] = {
    "no cameras": (_without_cameras, "cannot be trained on: it has no cameras"),
    "unsorted": (_unsorted, "frame times must increase strictly"),
    "image times missing": (_too_few_times, "camera 'front' has 2 image times for 3 frames"),
    "flat box": (lambda log: _track(log, size=(4.0, 0.0, 1.5)), "needs a positive length"),
    "box of no number": (lambda log: _track(log, size=(np.nan, 2.0, 1.5)), "needs a positive"),
    "twice": (lambda log: _track(log, object_id=log.tracks[0].object_id), "is there twice"),
}


@pytest.mark.parametrize("case", BAD_LOGS)
def test_bad_log_is_refused(tiny_log: SyntheticLog, case: str) -> None:
    change, message = BAD_LOGS[case]
    assert re.search(message, "\n".join(problems_of(change(tiny_log))))
