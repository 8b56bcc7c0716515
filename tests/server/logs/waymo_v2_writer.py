"""Write a DrivingLog in the layout of the Waymo Open Dataset v2 (see readers/waymo_v2.py).

Round trips are exact for times, poses, box sizes and calibrations (float64), and for images with
``image_format="png"`` (the data set itself holds JPEG). Boxes keep only their rotation about the
vehicle's z axis. Ranges and pixel poses are float32, so points are accurate to 0.1 mm in worlds of
up to 1 km.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from real2sim_server.geometry import (
    Float,
    apply_transform,
    invert_transform,
    matrix_to_quaternion,
    quaternion_yaw,
    slerp,
    transform_from,
)
from real2sim_server.logs.driving_log import DrivingLog, LidarSweep, LogError
from real2sim_server.logs.images import encode_image
from real2sim_server.logs.readers.waymo_common import CAMERA_NAMES, FRONT, TOP, angles
from real2sim_server.logs.readers.waymo_v2 import (
    BOX,
    CALIBRATION,
    CAMERA,
    IMAGE,
    INTRINSICS,
    LASER,
    LIDAR,
    LIDAR_CALIBRATION,
    LIDAR_POSE,
    OBJECT,
    POSE,
    TIME,
)
from real2sim_server.scene.camera import T_VEHICLE_OPTICAL

SEGMENT = "key.segment_context_name"
TYPES = {"pedestrian": 2, "sign": 3, "cyclist": 4, "other": 0}
VEHICLE = 1
GLOBAL_SHUTTER = 5
OFF_GRID = 0.02
"""Largest distance of a point from the centre of its range image cell [cells]."""


@dataclass(frozen=True, eq=False)
class RangeGrid:
    """The beams of a spinning LiDAR.

    Attributes:
        inclinations: [H] float64 [rad], ascending.
        columns: azimuth steps W per sweep; column i looks at pi - 2 pi (i + 0.5) / W.
    """

    inclinations: Float
    columns: int


@dataclass(frozen=True, eq=False)
class _Layout:
    """Camera numbers by name, the LiDAR's beams or None, and the image suffix."""

    numbers: Mapping[str, int]
    grid: RangeGrid | None
    suffix: str


def write_waymo_v2(
    log: DrivingLog,
    path: str | Path,
    *,
    segment: str | None = None,
    image_format: str = "png",
    grid: RangeGrid | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write ``log`` to the folder ``path``, which appears only once it is complete.

    Args:
        log: a log with at most five cameras and an upright LiDAR.
        path: a new or empty folder.
        segment: name of the files, by default the log's name.
        image_format: ``png`` (exact) or ``jpg`` (quality 95).
        grid: the LiDAR's beams, by default those of the synthetic generator. Points must lie on
            them.
        on_progress: called with (done, total) after each frame.

    Returns:
        ``path``.

    Raises:
        LogError: the folder is not empty, the cameras do not fit, points lie off the grid, or an
            image or sweep is broken.
    """
    target = Path(path)
    if image_format not in ("png", "jpg"):
        raise LogError(f"image_format must be 'png' or 'jpg', not {image_format!r}")
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise LogError(f"{target}: is there already; name a folder that is new or empty")
    layout = _Layout(_camera_numbers(log), grid or _synthetic_grid(log), f".{image_format}")
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    try:
        with _Writer(partial, segment or log.name) as writer:
            _write_calibrations(writer, layout, log)
            for frame in range(log.frame_count):
                _write_frame(writer, layout, log, frame)
                if on_progress is not None:
                    on_progress(frame + 1, log.frame_count)
        partial.chmod(0o755)
        os.replace(partial, target)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    return target


def _camera_numbers(log: DrivingLog) -> dict[str, int]:
    by_name = {name: number for number, name in CAMERA_NAMES.items()}
    if set(log.rig.names) <= set(by_name):
        return {name: by_name[name] for name in log.rig.names}
    if len(log.rig) > len(CAMERA_NAMES):
        raise LogError(
            f"log {log.name!r} has {len(log.rig)} cameras; the layout holds {len(CAMERA_NAMES)}"
        )
    return {name: i for i, name in enumerate(log.rig.names, start=1)}


def _synthetic_grid(log: DrivingLog) -> RangeGrid | None:
    from real2sim_server.synthetic.log import LIDAR_ELEVATION

    config = log.provenance.get("config", {})
    if "lidar_beams" in config and config["lidar_beams"] > 0:
        beams = np.linspace(*LIDAR_ELEVATION, config["lidar_beams"])
        return RangeGrid(beams, int(config["lidar_columns"]))
    if any(len(log.lidar(frame).points) for frame in range(log.frame_count)):
        raise LogError(f"log {log.name!r} has LiDAR points: name the beams they lie on with grid")
    return None


class _Writer:
    """One Parquet file per component, one row group per frame."""

    def __init__(self, folder: Path, segment: str) -> None:
        self._folder, self._segment = folder, segment
        self._open: dict[str, Any] = {}

    def __enter__(self) -> _Writer:
        return self

    def __exit__(self, *_: object) -> None:
        for writer in self._open.values():
            writer.close()

    def write(self, component: str, columns: Mapping[str, Any]) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        rows = len(next(iter(columns.values())))
        table = pa.table({SEGMENT: [self._segment] * rows, **columns})
        if component not in self._open:
            path = self._folder / component / f"{self._segment}.parquet"
            path.parent.mkdir()
            self._open[component] = pq.ParquetWriter(path, table.schema)
        self._open[component].write_table(table)


def _fixed(matrices: Float) -> Any:
    """Matrices [N, 4, 4] as lists of 16 float64."""
    import pyarrow as pa

    return pa.FixedSizeListArray.from_arrays(pa.array(np.ravel(matrices)), 16)


def _write_calibrations(writer: _Writer, layout: _Layout, log: DrivingLog) -> None:
    import pyarrow as pa

    numbers, grid = layout.numbers, layout.grid
    rows = [(c.K[0, 0], c.K[1, 1], c.K[0, 2], c.K[1, 2], 0.0, 0.0, 0.0, 0.0, 0.0) for c in log.rig]
    optical = np.linalg.inv(T_VEHICLE_OPTICAL)
    writer.write(
        "camera_calibration",
        {
            CAMERA: pa.array([numbers[c.name] for c in log.rig], pa.int8()),
            **{
                f"{CALIBRATION}.intrinsic.{name}": pa.array([row[i] for row in rows], pa.float64())
                for i, name in enumerate(INTRINSICS)
            },
            f"{CALIBRATION}.extrinsic.transform": _fixed(
                np.array([c.T_vehicle_camera @ optical for c in log.rig])
            ),
            f"{CALIBRATION}.width": pa.array([c.width for c in log.rig], pa.int32()),
            f"{CALIBRATION}.height": pa.array([c.height for c in log.rig], pa.int32()),
            f"{CALIBRATION}.rolling_shutter_direction": pa.array(
                [GLOBAL_SHUTTER] * len(log.rig), pa.int8()
            ),
        },
    )
    if grid is not None:
        prefix = f"{LIDAR_CALIBRATION}.beam_inclination"
        writer.write(
            "lidar_calibration",
            {
                LASER: pa.array([TOP], pa.int8()),
                f"{LIDAR_CALIBRATION}.extrinsic.transform": _fixed(_laser_pose(log)[None]),
                f"{prefix}.min": [float(grid.inclinations[0])],
                f"{prefix}.max": [float(grid.inclinations[-1])],
                f"{prefix}.values": pa.array([grid.inclinations], pa.list_(pa.float64())),
            },
        )


def _laser_pose(log: DrivingLog) -> Float:
    pose = np.eye(4)
    pose[:3, 3] = log.lidar(0).origin
    return pose


def _write_frame(writer: _Writer, layout: _Layout, log: DrivingLog, frame: int) -> None:
    import pyarrow as pa

    turn_us = _turn_us(log)
    start = pa.array([_start_us(log, frame, layout.numbers, turn_us)], pa.int64())
    pose = log.ego.transform(int(log.frame_times_us[frame]))
    writer.write("vehicle_pose", {TIME: start, POSE: _fixed(pose[None])})
    _write_images(writer, layout, log, frame, start)
    _write_boxes(writer, log, frame, start)
    if layout.grid is not None:
        _write_sweep(writer, log, frame, start, layout.grid)


def _turn_us(log: DrivingLog) -> int:
    times = log.frame_times_us
    return int(np.median(np.diff(times))) if len(times) > 1 else 100_000


def _start_us(log: DrivingLog, frame: int, numbers: Mapping[str, int], turn_us: int) -> int:
    """Start of the frame's revolution [us]. Its pose applies half a revolution later."""
    t_us = int(log.frame_times_us[frame])
    for name, number in numbers.items():
        if number == FRONT and log.image_time_us(name, frame) != t_us:
            raise LogError(
                f"log {log.name!r}: camera {name!r} takes its image of frame {frame} at another "
                "time than the frame's; the layout needs its front camera to give the time"
            )
    return t_us - turn_us // 2


def _write_images(
    writer: _Writer, layout: _Layout, log: DrivingLog, frame: int, start: Any
) -> None:
    import pyarrow as pa

    prefix = f"{IMAGE}.rolling_shutter_params"
    for name, number in layout.numbers.items():
        t_us = log.image_time_us(name, frame)
        seconds = [t_us * 1e-6]
        writer.write(
            "camera_image",
            {
                TIME: start,
                CAMERA: pa.array([number], pa.int8()),
                f"{IMAGE}.image": pa.array([encode_image(log.image(name, frame), layout.suffix)]),
                f"{IMAGE}.pose.transform": _fixed(log.ego.transform(t_us)[None]),
                f"{IMAGE}.pose_timestamp": seconds,
                f"{prefix}.shutter": [0.0],
                f"{prefix}.camera_trigger_time": seconds,
                f"{prefix}.camera_readout_done_time": seconds,
            },
        )


def _write_boxes(writer: _Writer, log: DrivingLog, frame: int, start: Any) -> None:
    import pyarrow as pa

    t_us = int(log.frame_times_us[frame])
    to_vehicle = invert_transform(log.ego.transform(t_us))
    seen = [t for t in log.tracks if t.trajectory.covers(t_us)]
    poses = [to_vehicle @ t.trajectory.transform(t_us) for t in seen]
    numbers = {
        f"{BOX}.box.{part}.{axis}": pa.array([row[i] for row in rows], pa.float64())
        for part, rows in (("center", [p[:3, 3] for p in poses]), ("size", [t.size for t in seen]))
        for i, axis in enumerate("xyz")
    }
    headings = [float(quaternion_yaw(matrix_to_quaternion(p[:3, :3]))) for p in poses]
    types = [TYPES.get(t.category, VEHICLE) for t in seen]
    writer.write(
        "lidar_box",
        {
            TIME: pa.array(start.to_pylist() * len(seen), pa.int64()),
            OBJECT: pa.array([t.object_id for t in seen], pa.string()),
            **numbers,
            f"{BOX}.box.heading": pa.array(headings, pa.float64()),
            f"{BOX}.type": pa.array(types, pa.int8()),
        },
    )


def _write_sweep(writer: _Writer, log: DrivingLog, frame: int, start: Any, grid: RangeGrid) -> None:
    import pyarrow as pa

    sweep = log.lidar(frame)
    values, poses = _range_image(log, frame, sweep, grid)
    keys = {TIME: start, LASER: pa.array([TOP], pa.int8())}
    first, second = (f"{LIDAR}.range_image_return{i}" for i in (1, 2))
    nothing = np.zeros((0, 0, values.shape[2]), np.float32)
    writer.write("lidar", {**keys, **_image_cells(first, values), **_image_cells(second, nothing)})
    writer.write("lidar_pose", {**keys, **_image_cells(LIDAR_POSE, poses)})


def _image_cells(prefix: str, image: NDArray[np.float32]) -> dict[str, Any]:
    import pyarrow as pa

    return {
        f"{prefix}.values": pa.array([image.ravel()], pa.list_(pa.float32())),
        f"{prefix}.shape": pa.array([list(image.shape)], pa.list_(pa.int32(), 3)),
    }


def _range_image(
    log: DrivingLog, frame: int, sweep: LidarSweep, grid: RangeGrid
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """[H, W, 4] range, intensity, elongation, no-label zone; and pixel poses [H, W, 6]."""
    t_us = int(log.frame_times_us[frame])
    offsets = sweep.offset_us.astype(np.float64)
    moved = _ego_at(log, t_us + offsets)
    in_world = apply_transform(log.ego.transform(t_us), sweep.points.astype(np.float64))
    local = np.einsum("nji,nj->ni", moved[:, :3, :3], in_world - moved[:, :3, 3])
    x, y, z = (local - sweep.origin).T
    row, column = _cells(log, frame, grid, np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)))
    values = np.zeros((len(grid.inclinations), grid.columns, 4), np.float32)
    values[row, column, 0] = np.sqrt(x * x + y * y + z * z)
    values[row, column, 1] = sweep.intensity
    poses = np.zeros((*values.shape[:2], 6), np.float32)
    poses[row, column] = np.concatenate([angles(moved[:, :3, :3]), moved[:, :3, 3]], axis=1)
    return values, poses


def _cells(
    log: DrivingLog, frame: int, grid: RangeGrid, azimuth: Float, elevation: Float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Row and column of every point. Raises LogError if points are off the grid."""
    where = f"log {log.name!r}, sweep of frame {frame}"
    column = (np.pi - azimuth) / (2 * np.pi) * grid.columns - 0.5
    whole = np.round(column)
    beams = grid.inclinations
    nearest = np.abs(elevation[:, None] - beams).argmin(axis=1)
    spacing = np.diff(beams).min() if len(beams) > 1 else np.pi
    off = np.maximum(np.abs(column - whole), np.abs(elevation - beams[nearest]) / spacing)
    if len(off) and off.max() > OFF_GRID:
        raise LogError(
            f"{where}: {int((off > OFF_GRID).sum())} of {len(off)} points do not lie on the beams "
            "of the grid"
        )
    row, column_index = len(beams) - 1 - nearest, whole.astype(np.intp) % grid.columns
    if len(np.unique(row * grid.columns + column_index)) != len(row):
        raise LogError(f"{where}: several points lie in one cell of the grid")
    return row, column_index


def _ego_at(log: DrivingLog, times_us: Float) -> Float:
    """``T_world_vehicle`` [N, 4, 4], extrapolated linearly outside the log."""
    known = log.ego.times_us
    if len(known) == 1:
        return np.tile(log.ego.transform(int(known[0])), (len(times_us), 1, 1))
    before = np.clip(np.searchsorted(known, times_us, side="right") - 1, 0, len(known) - 2)
    fraction = (times_us - known[before]) / (known[before + 1] - known[before])
    start, end = log.ego.positions[before], log.ego.positions[before + 1]
    rotations = slerp(
        log.ego.quaternions[before], log.ego.quaternions[before + 1], np.clip(fraction, 0, 1)
    )
    return transform_from(start + fraction[:, None] * (end - start), rotations)
