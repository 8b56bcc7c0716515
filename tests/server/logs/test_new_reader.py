"""A custom reader of a minimal format, registered from outside the package."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from real2sim_server.logs import DrivingLog, LidarSweep, LogError, ObjectTrack
from real2sim_server.logs.images import read_image, write_image
from real2sim_server.logs.readers import READERS, register_reader
from real2sim_server.scene import Camera, CameraRig, Trajectory

from .reader_contract import ReaderContract

HEADER = "time_us x y z qw qx qy qz"


def write_little(log: DrivingLog, folder: Path) -> None:
    """Write ``ego.txt``, ``camera.txt``, a file per box, and an image and points per frame."""
    for name in ("boxes", "images", "points"):
        (folder / name).mkdir(parents=True)
    _write_path(folder / "ego.txt", log.ego)
    camera = log.rig.cameras[0]
    np.savetxt(folder / "camera.txt", np.concatenate([camera.K, camera.T_vehicle_camera[:3]], 1))
    for track in log.tracks:
        name = "_".join([track.object_id, *map(str, track.size)])
        _write_path(folder / "boxes" / f"{name}.txt", track.trajectory)
    for frame in range(log.frame_count):
        write_image(folder / "images" / f"{frame}.png", log.image(camera.name, frame))
        sweep = log.lidar(frame)
        rows = np.column_stack([sweep.points, sweep.intensity, sweep.offset_us])
        np.savetxt(folder / "points" / f"{frame}.txt", rows)


def _write_path(path: Path, given: Trajectory) -> None:
    rows = np.column_stack([given.times_us, given.positions, given.quaternions])
    np.savetxt(path, rows, header=HEADER, fmt="%.17g")


class LittleReader:
    """Reads the format of :func:`write_little`."""

    name = "little"
    expects = "ego.txt, camera.txt, boxes/<id>_<size>.txt, images/<frame>.png, points/<frame>.txt"

    def recognises(self, path: Path) -> bool:
        return (path / "ego.txt").is_file() and (path / "camera.txt").is_file()

    def read(self, path: Path, *, sequence: str | None = None) -> DrivingLog:
        if sequence is not None:
            raise LogError(f"{path}: holds one drive; it has no sequence {sequence!r}")
        ego = _read_path(path / "ego.txt")
        matrices = np.loadtxt(path / "camera.txt")
        height, width, _ = read_image(path / "images" / "0.png").shape
        pose = np.concatenate([matrices[:, 3:], [[0, 0, 0, 1]]])
        return DrivingLog(
            name=f"little_{path.name}",
            rig=CameraRig((Camera("only", width, height, matrices[:, :3], pose),)),
            frame_times_us=ego.times_us,
            ego=ego,
            tracks=tuple(_read_box(file) for file in sorted((path / "boxes").glob("*.txt"))),
            source=LittleSource(path),
            provenance={"dataset": "little", "reader": self.name, "licence": "free to use"},
        )


def _read_path(path: Path) -> Trajectory:
    rows = np.loadtxt(path, ndmin=2)
    return Trajectory(rows[:, 0].astype(np.int64), rows[:, 1:4], rows[:, 4:8])


def _read_box(path: Path) -> ObjectTrack:
    category, number, *size = path.stem.split("_")
    length, width, height = map(float, size)
    path_of_box = _read_path(path)
    return ObjectTrack(f"{category}_{number}", category, (length, width, height), path_of_box)


@dataclass(frozen=True)
class LittleSource:
    folder: Path

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        return read_image(self.folder / "images" / f"{frame}.png")

    def lidar(self, frame: int) -> LidarSweep:
        rows = np.loadtxt(self.folder / "points" / f"{frame}.txt")
        return LidarSweep(
            points=rows[:, :3].astype(np.float32),
            intensity=rows[:, 3].astype(np.float32),
            offset_us=rows[:, 4].astype(np.int32),
            origin=np.array([0.9, 0.0, 1.73], np.float32),
        )


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    """Register the reader for one test."""
    before = list(READERS)
    register_reader(LittleReader())
    yield
    READERS[:] = before


@pytest.fixture(scope="session")
def written_little(tiny_log: DrivingLog, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("little") / "drive"
    write_little(tiny_log, folder)
    return folder


class TestLittleReader(ReaderContract):
    @pytest.fixture
    def folder(self, written_little: Path) -> Path:
        return written_little


def test_registering_a_name_twice_is_refused() -> None:
    with pytest.raises(ValueError, match="'little' is registered already"):
        register_reader(LittleReader())
