from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from real2sim_server.logs import LogError, open_log, write_native_log
from real2sim_server.logs.images import write_image
from real2sim_server.synthetic import SyntheticLog

from .reader_contract import told_about

DEVICE = {
    "K": [[60.0, 0, 48], [0, 60, 32], [0, 0, 1]],
    "lens": {"model": "fisheye", "k": [0.1, 0, 0, 0], "max_angle": None},
    "shutter": {"direction": "top_to_bottom", "readout_us": 20_000},
}


def test_round_trip_is_exact(tiny_log: SyntheticLog, written_native: Path) -> None:
    back = open_log(written_native)
    assert back.name == tiny_log.name
    assert (back.frame_times_us == tiny_log.frame_times_us).all()
    for frame in range(tiny_log.frame_count):
        for camera in tiny_log.rig.names:
            assert (back.image(camera, frame) == tiny_log.image(camera, frame)).all()
        for field in ("points", "intensity", "offset_us", "origin"):
            given, read = (getattr(log.lidar(frame), field) for log in (tiny_log, back))
            assert given.dtype == read.dtype
            assert (given == read).all()


def test_round_trip_keeps_cameras_and_tracks(tiny_log: SyntheticLog, written_native: Path) -> None:
    back = open_log(written_native)
    for camera in tiny_log.rig:
        assert (back.rig[camera.name].K == camera.K).all()
        assert (back.rig[camera.name].T_vehicle_camera == camera.T_vehicle_camera).all()
    for one, two in zip(tiny_log.tracks, back.tracks, strict=True):
        assert (one.object_id, one.category, one.size) == (two.object_id, two.category, two.size)
        assert (one.trajectory.positions == two.trajectory.positions).all()
        np.testing.assert_allclose(
            one.trajectory.quaternions, two.trajectory.quaternions, atol=1e-15
        )


def test_round_trip_keeps_recorded_optics(native_folder: Path, tmp_path: Path) -> None:
    _edit(native_folder, lambda m: m["cameras"][0].update(recorded=DEVICE))
    camera = next(iter(open_log(native_folder).rig))
    assert camera.is_pinhole
    assert camera.as_recorded().shutter.readout_us == 20_000
    again = write_native_log(open_log(native_folder), tmp_path / "again")
    assert json.loads((again / "log.json").read_text())["cameras"][0]["recorded"] == DEVICE


def test_a_camera_with_an_invalid_lens_is_left_out(native_folder: Path) -> None:
    wrong = {**DEVICE, "lens": {"model": "fisheye", "k": [1.0]}}
    _edit(native_folder, lambda m: m["cameras"][0].update(recorded=wrong))
    (told,) = open_log(native_folder).left_out["cameras"]
    assert "k must be 4 finite numbers" in told


def test_progress_counts_up_to_the_total(tiny_log: SyntheticLog, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    write_native_log(tiny_log, tmp_path / "log", on_progress=lambda *at: seen.append(at))
    total = tiny_log.frame_count * (len(tiny_log.rig) + 1)
    assert seen == [(i + 1, total) for i in range(total)]


def test_failed_writing_leaves_nothing_behind(tiny_log: SyntheticLog, tmp_path: Path) -> None:
    def stop(done: int, total: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_native_log(tiny_log, tmp_path / "log", on_progress=stop)
    assert list(tmp_path.iterdir()) == []


def test_existing_log_is_not_overwritten(tiny_log: SyntheticLog, native_folder: Path) -> None:
    with pytest.raises(LogError, match="is there already"):
        write_native_log(tiny_log, native_folder)


def test_log_without_lidar_gives_empty_sweeps(native_folder: Path) -> None:
    _edit(native_folder, lambda content: content.update(lidar=False))
    assert open_log(native_folder).lidar(0).points.shape == (0, 3)


def test_provenance_is_optional(native_folder: Path) -> None:
    _edit(native_folder, lambda m: m.pop("provenance"))
    assert open_log(native_folder).provenance == {}


def _edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    content = json.loads((folder / "log.json").read_text())
    change(content)
    (folder / "log.json").write_text(json.dumps(content))


BAD_MANIFESTS: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "newer version": (lambda c: c.update(version=2), "is version 2; this program reads 1"),
    "other format": (lambda c: c.update(format="x"), "real2sim-log"),
    "no frames": (lambda c: c.update(frame_times_us=[]), "at least one frame"),
    "unsorted times": (lambda c: c["frame_times_us"].reverse(), "frame times must increase"),
    "fractional times": (lambda c: c.update(frame_times_us=[0.5]), "whole numbers"),
    "NaN pose": (lambda c: c["ego"]["positions"][1].__setitem__(0, float("nan")), "not finite"),
    "short ego": (
        lambda c: [c["ego"][key].pop() for key in ("times_us", "positions", "quaternions")],
        "ego poses cover",
    ),
    "long quaternion": (lambda c: c["ego"]["quaternions"].__setitem__(0, [2, 0, 0, 0]), "unit"),
    "ragged positions": (lambda c: c["ego"]["positions"][0].pop(), "'positions' must be"),
    "not a rotation": (
        lambda c: c["cameras"][0]["T_vehicle_camera"][0].__setitem__(2, 3.0), "rigid transform"
    ),
    "camera name with a slash": (lambda c: c["cameras"][0].update(name="a/b"), "folder name"),
    "camera twice": (lambda c: c["cameras"].append(c["cameras"][0]), "only once"),
    "zero size": (lambda c: c["tracks"][1].update(size=[4, 0, 1]), r"tracks\[1\].*positive"),
    "track twice": (lambda c: c["tracks"].append(c["tracks"][0]), "used twice"),
    "no tracks key": (lambda c: c.pop("tracks"), "'tracks' must be list, found nothing"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_MANIFESTS)
def test_damage_of_the_manifest_is_told(native_folder: Path, case: str) -> None:
    change, message = BAD_MANIFESTS[case]
    _edit(native_folder, change)
    refused, told = told_about(native_folder)
    assert re.search(message, told)
    assert "log.json" in told
    assert refused == (case in REFUSED)


REFUSED = {"newer version", "other format", "no frames", "unsorted times", "fractional times",
           "ragged positions", "no tracks key"}  # fmt: skip


@pytest.mark.parametrize("coding", ["utf-8-sig", "utf-16"])
def test_a_manifest_may_have_a_byte_order_mark(native_folder: Path, coding: str) -> None:
    manifest = native_folder / "log.json"
    manifest.write_text(manifest.read_text().replace("\n", "\r\n"), encoding=coding)
    assert open_log(native_folder).frame_count == 3


def test_broken_json_is_refused(native_folder: Path) -> None:
    (native_folder / "log.json").write_text('{"format": ')
    with pytest.raises(LogError, match=r"log\.json: is not a JSON file"):
        open_log(native_folder)


def test_missing_image_is_found(native_folder: Path) -> None:
    (native_folder / "images/front/000001.png").unlink()
    log = open_log(native_folder)
    assert log.absent_images == {("front", 1)}
    (told,) = log.left_out["images"]
    assert "front/000001.png" in told


def test_a_camera_without_its_folder_is_left_out(native_folder: Path) -> None:
    (native_folder / "images/front_left").rename(native_folder / "images/other")
    log = open_log(native_folder)
    assert "front_left" not in log.rig.names
    (told,) = log.left_out["cameras"]
    assert "camera 'front_left': has no usable image" in told


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_image_of_another_size_is_found(native_folder: Path, suffix: str) -> None:
    path = native_folder / "images/front/000001.png"
    write_image(path.with_suffix(suffix), np.zeros((10, 12, 3), np.uint8))
    path.with_suffix(suffix).rename(path)
    (problem,) = open_log(native_folder).left_out["images"]
    assert problem.endswith("000001.png: is 12x10, but the calibration says 120x80")


def test_truncated_image_is_left_out(native_folder: Path) -> None:
    path = native_folder / "images/front/000001.png"
    path.write_bytes(path.read_bytes()[:60])
    log = open_log(native_folder)
    assert "000001.png: the image is cut off" in log.left_out["images"][0]
    with pytest.raises(LogError, match="camera 'front' has no usable image at frame 1"):
        log.image("front", 1)


def test_text_in_place_of_an_image_is_found(native_folder: Path) -> None:
    (native_folder / "images/front/000001.png").write_text("no image")
    (problem,) = open_log(native_folder).left_out["images"]
    assert "expected a PNG or JPEG" in problem


def test_missing_sweep_is_found(native_folder: Path) -> None:
    (native_folder / "lidar/000002.npz").unlink()
    (problem,) = open_log(native_folder).left_out["sweeps"]
    assert "000002.npz: no such file" in problem


def test_truncated_sweep_is_left_out(native_folder: Path) -> None:
    path = native_folder / "lidar/000000.npz"
    path.write_bytes(path.read_bytes()[:500])
    log = open_log(native_folder)
    assert "000000.npz: expected an .npz" in log.left_out["sweeps"][0]
    assert len(log.lidar(0).points) == 0


def test_sweep_with_inconsistent_arrays_is_refused(native_folder: Path) -> None:
    np.savez(
        native_folder / "lidar/000000.npz",
        points=np.zeros((4, 3), np.float32),
        intensity=np.zeros(3, np.float32),
        offset_us=np.zeros(4, np.int32),
        origin=np.zeros(3, np.float32),
    )
    assert "intensity must be" in open_log(native_folder).left_out["sweeps"][0]


def test_sweep_with_pickled_objects_is_not_loaded(native_folder: Path) -> None:
    np.savez(native_folder / "lidar/000000.npz", points=np.array([{}], dtype=object))
    assert "000000.npz" in open_log(native_folder).left_out["sweeps"][0]


def test_documented_example_is_a_valid_log(tmp_path: Path) -> None:
    page = Path(__file__).resolve().parents[3] / "docs" / "log_format.md"
    example = page.read_text().split("```json")[1].split("```")[0]
    (tmp_path / "log.json").write_text(example)
    for folder in ("images/front", "lidar"):
        (tmp_path / folder).mkdir(parents=True)
    for frame in range(2):
        write_image(tmp_path / f"images/front/{frame:06d}.png", np.zeros((400, 640, 3), np.uint8))
        np.savez(
            tmp_path / f"lidar/{frame:06d}.npz",
            points=np.zeros((1, 3)),
            intensity=np.zeros(1),
            offset_us=np.zeros(1),
            origin=np.zeros(3),
        )
    log = open_log(tmp_path)
    assert log.rig.names == ("front",)
    assert log.tracks[0].object_id == "car_0"


def test_image_times_are_preserved(tiny_log: SyntheticLog, tmp_path: Path) -> None:
    late = {"front_left": tiny_log.frame_times_us - [0, 3000, 9000]}
    given = dataclasses.replace(tiny_log, image_times_us=late)
    read = open_log(write_native_log(given, tmp_path / "late"))
    assert [read.image_time_us("front_left", f) for f in range(3)] == late["front_left"].tolist()
    assert read.image_time_us("front", 2) == tiny_log.frame_times_us[2]


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ({"rear": [0, 1, 2]}, "image_times_us: rear: there is no usable camera"),
        ({"front": [0, 1]}, "front: 2 times for 3 frames"),
        ({"front": [0, 2, 1]}, "front: frame times must increase"),
        ({"front": [0, 1, 10**9]}, "'front' at frame 2: was taken at 1000000000 us, but ego poses"),
    ],
)
def test_bad_image_times_are_told(
    native_folder: Path, times: dict[str, list[int]], message: str
) -> None:
    manifest = native_folder / "log.json"
    content = json.loads(manifest.read_text())
    content["image_times_us"] = times
    manifest.write_text(json.dumps(content))
    assert message in told_about(native_folder)[1]
