"""Typical mistakes in user-written logs raise questions; good logs do not."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from real2sim_server.geometry import (
    apply_transform,
    invert_transform,
    matrix_to_quaternion,
    transform_from,
)
from real2sim_server.logs import LogError, inspect_log, open_log, usable_log, write_native_log
from real2sim_server.logs.readers.native import POSE_KEYS
from real2sim_server.scene import Trajectory
from real2sim_server.synthetic import generate_log

from .conftest import TINY

Manifest = dict[str, Any]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user-written log, long enough for all movers to move."""
    log = generate_log(replace(TINY, frames=10, width=24, height=16))
    return write_native_log(log, tmp_path_factory.mktemp("own") / "drive")


@pytest.fixture
def own(drive: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(drive, tmp_path / "drive"))


def change(folder: Path, how: Callable[[Manifest], None]) -> Path:
    manifest = folder / "log.json"
    content = json.loads(manifest.read_text())
    how(content)
    manifest.write_text(json.dumps(content))
    return folder


def change_sweeps(folder: Path, how: Callable[[np.ndarray, dict[str, np.ndarray]], None]) -> None:
    """Apply ``how(T_world_vehicle, arrays)`` to the sweep of each frame."""
    ego = json.loads((folder / "log.json").read_text())["ego"]
    for frame, path in enumerate(sorted((folder / "lidar").iterdir())):
        with np.load(path) as file:
            arrays = dict(file)
        how(transform_from(ego["positions"][frame], ego["quaternions"][frame]), arrays)
        np.savez(path, **arrays)


def poses_of(content: Manifest) -> list[Manifest]:
    return [content["ego"], *content["tracks"]]


def test_a_good_log_raises_no_questions(drive: Path) -> None:
    assert inspect_log(open_log(drive)).questions == ()


# --- mistakes ---------------------------------------------------------------------------------


def quaternions_from_x(content: Manifest) -> None:
    for part in poses_of(content):
        part["quaternions"] = [[x, y, z, w] for w, x, y, z in part["quaternions"]]


def quaternions_of_boxes_from_x(content: Manifest) -> None:
    for part in content["tracks"]:
        part["quaternions"] = [[x, y, z, w] for w, x, y, z in part["quaternions"]]


def poses_inverted(content: Manifest) -> None:
    ego = content["ego"]
    for i, (position, q) in enumerate(zip(ego["positions"], ego["quaternions"], strict=True)):
        inverse = invert_transform(transform_from(position, q))
        ego["positions"][i] = inverse[:3, 3].tolist()
        ego["quaternions"][i] = matrix_to_quaternion(inverse[:3, :3]).tolist()


def extrinsics_inverted(content: Manifest) -> None:
    for camera in content["cameras"]:
        camera["T_vehicle_camera"] = invert_transform(np.array(camera["T_vehicle_camera"])).tolist()


def axes_of_the_vehicle(content: Manifest) -> None:
    for camera in content["cameras"]:
        pose = np.array(camera["T_vehicle_camera"])
        x, y, z, place = pose.T
        camera["T_vehicle_camera"] = np.stack([z, -x, -y, place], axis=1).tolist()


def intrinsics_of_twice_the_size(content: Manifest) -> None:
    for camera in content["cameras"]:
        camera["K"] = [[2 * v for v in row] for row in camera["K"][:2]] + [[0, 0, 1]]


def utm(content: Manifest) -> None:
    for part in poses_of(content):
        part["positions"] = [[x + 448e3, y + 5411e3, z] for x, y, z in part["positions"]]


def boxes_left_behind_in_utm(content: Manifest) -> None:
    for part in content["tracks"]:
        part["positions"] = [[x + 448e3, y + 5411e3, z] for x, y, z in part["positions"]]


def boxes_in_the_vehicle_frame(content: Manifest) -> None:
    ego = content["ego"]
    T_vehicle_world = [
        invert_transform(transform_from(p, q))
        for p, q in zip(ego["positions"], ego["quaternions"], strict=True)
    ]
    for part in content["tracks"]:
        path = Trajectory(*(np.array(part[key]) for key in POSE_KEYS))
        times = [t for t in ego["times_us"] if path.covers(t)]
        seen = [T_vehicle_world[ego["times_us"].index(t)] @ path.transform(t) for t in times]
        moved = Trajectory.from_transforms(times, seen)
        part.update({key: getattr(moved, key).tolist() for key in POSE_KEYS})


def boxes_by_their_bottom(content: Manifest) -> None:
    for part in content["tracks"]:
        part["positions"] = [[x, y, z - part["size"][2] / 2] for x, y, z in part["positions"]]


def sizes_from_width(content: Manifest) -> None:
    for part in content["tracks"]:
        length, width, height = part["size"]
        part["size"] = [width, length, height]


def sizes_in_centimetres(content: Manifest) -> None:
    for part in content["tracks"]:
        part["size"] = [100 * v for v in part["size"]]


def categories_of_a_data_set(content: Manifest) -> None:
    for part in content["tracks"]:
        part["category"] = part["category"].capitalize()


def times_in_milliseconds(content: Manifest) -> None:
    content["frame_times_us"] = [t // 1000 for t in content["frame_times_us"]]
    for part in poses_of(content):
        part["times_us"] = [t // 1000 for t in part["times_us"]]


MISTAKES: dict[str, tuple[Callable[[Manifest], None], str]] = {
    "quaternions from x": (quaternions_from_x, "the ego .* are its quaternions x y z w"),
    "boxes' quaternions from x": (quaternions_of_boxes_from_x, "vehicles .* quaternions x y z w"),
    "inverted poses": (poses_inverted, "are its poses inverted"),
    "inverted extrinsics": (extrinsics_inverted, "camera 'front' .* T_vehicle_camera inverted"),
    "cameras' axes": (axes_of_the_vehicle, "camera 'front' .* must be x right, y down, z forward"),
    "K of another size": (intrinsics_of_twice_the_size, "is K of another size"),
    "UTM": (utm, r"5,411 km from the world's origin, .* 5e\+02 mm: subtract"),
    "boxes in UTM": (boxes_left_behind_in_utm, "the nearest box is .* in the world's frame"),
    "boxes of the vehicle": (
        boxes_in_the_vehicle_frame,
        "moving vehicles do not .* are its poses T_world_object",
    ),
    "boxes' bottoms": (boxes_by_their_bottom, "must be the box's centre"),
    "width first": (sizes_from_width, "is size length, width, height"),
    "centimetres": (sizes_in_centimetres, "is size in metres"),
    "categories": (categories_of_a_data_set, "of category 'Car', .* did you mean 'car'"),
    "milliseconds": (times_in_milliseconds, r"1e\+04 frames a second: are times in milliseconds"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_raises_a_question(own: Path, mistake: str) -> None:
    how, question = MISTAKES[mistake]
    questions = inspect_log(open_log(change(own, how))).questions
    assert any(re.search(question, p) for p in questions), questions


def test_points_in_the_world_frame_raise_a_question(own: Path) -> None:
    def moved(T_world_vehicle: np.ndarray, sweep: dict[str, np.ndarray]) -> None:
        sweep["points"] = apply_transform(T_world_vehicle, sweep["points"]).astype(np.float32)

    change_sweeps(own, moved)
    questions = inspect_log(open_log(own)).questions
    assert any("are points in the world's frame?" in p for p in questions), questions


def test_intensities_up_to_255_raise_a_question(own: Path) -> None:
    def scaled(_: np.ndarray, sweep: dict[str, np.ndarray]) -> None:
        sweep["intensity"] = sweep["intensity"] * 255

    change_sweeps(own, scaled)
    questions = inspect_log(open_log(own)).questions
    assert any("LiDAR intensity is up to" in p for p in questions), questions


def test_training_far_from_the_origin_is_refused(own: Path) -> None:
    with pytest.raises(
        LogError, match=r"5,411 km from the world's origin.* only move in steps of 0\.5 m"
    ):
        usable_log(open_log(change(own, utm)))


@pytest.mark.parametrize(
    ("where", "key", "meant"),
    [
        ("log", "image_time_us", "image_times_us"),
        ("cameras", "T_vehicle_cam", "T_vehicle_camera"),
        ("ego", "quaternion", "quaternions"),
        ("tracks", "categorie", "category"),
    ],
)
def test_misspelt_keys_are_refused(own: Path, where: str, key: str, meant: str) -> None:
    def misspelt(content: Manifest) -> None:
        part = content if where == "log" else content[where]
        part = part[0] if isinstance(part, list) else part
        part[key] = part.pop(meant, {})

    with pytest.raises(LogError, match=f"unknown key '{key}'; did you mean '{meant}'"):
        open_log(change(own, misspelt))


def test_a_stationary_ego_raises_no_questions_about_its_motion(own: Path) -> None:
    def parked(content: Manifest) -> None:
        for name in ("positions", "quaternions"):
            content["ego"][name] = [content["ego"][name][0]] * len(content["ego"][name])
        content["tracks"] = [t for t in content["tracks"] if len(t["times_us"]) <= 2]

    questions = inspect_log(open_log(change(own, parked))).questions
    assert not any("axis" in p or "inverted" in p for p in questions), questions
