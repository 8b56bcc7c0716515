"""File output of sweeps: point clouds (.ply), arrays (.npz) and images (.png)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..._files import atomic_file
from ...scene import Lidar
from ..images import write_png
from .sensors import Sweep

SUFFIXES = (".ply", ".npz", ".png")
TOP_SIZE = 800
"""Width and height of the view from above [px]."""
ROW_HEIGHT = 3
"""Height of a row of the range image [px]."""
COLUMNS = 1600
FAR = 80.0
"""Largest range in images [m]."""

Picture = NDArray[np.uint8]


def write_sweep(sweep: Sweep, lidar: Lidar, path: Path) -> None:
    """Write ``sweep`` in the format of the suffix of ``path``, one of SUFFIXES.

    ``.ply`` has the returned points, in the sensor frame at the time of each ray, with intensity,
    ring or ray, instance and time. ``.npz`` has all arrays of the sweep and the angles.
    """
    suffix = path.suffix.lower()
    if suffix == ".ply":
        with atomic_file(path) as file:
            file.write(ply_bytes(sweep))
    elif suffix == ".npz":
        with atomic_file(path) as file:
            arrays: dict[str, Any] = _arrays(sweep, lidar)
            np.savez_compressed(file, **arrays)
    elif suffix == ".png":
        write_png(path, sweep_picture(sweep, lidar))
    else:
        raise ValueError(f"{path}: a sweep is written as {', '.join(SUFFIXES)}")


def ply_bytes(sweep: Sweep) -> bytes:
    """The returned points as binary PLY."""
    hit = sweep.hit
    rows = np.broadcast_to(np.arange(hit.shape[0]).reshape(-1, *[1] * (hit.ndim - 1)), hit.shape)
    fields: list[tuple[str, str, NDArray[Any]]] = [
        *((axis, "float", sweep.points[..., k][hit]) for k, axis in enumerate("xyz")),
        ("intensity", "float", sweep.intensity[hit]),
        ("time_us", "float", sweep.time_us[hit]),
        ("row", "int", rows[hit]),
        ("instance", "ushort", sweep.instance[hit]),
    ]
    kinds = {"float": "<f4", "int": "<i4", "ushort": "<u2"}
    table = np.zeros(int(hit.sum()), dtype=[(name, kinds[kind]) for name, kind, _ in fields])
    for name, _, values in fields:
        table[name] = values
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    head += [f"property {kind} {name}" for name, kind, _ in fields]
    return "\n".join([*head, "end_header", ""]).encode("ascii") + table.tobytes()


def _arrays(sweep: Sweep, lidar: Lidar) -> dict[str, NDArray[Any]]:
    arrays = {
        name: getattr(sweep, name)
        for name in ("range", "intensity", "hit", "drop_probability", "instance", "time_us")
    }
    arrays |= {f"range_{name}": values for name, values in sweep.returns.items()}
    if sweep.velocity is not None:
        arrays["velocity"] = sweep.velocity
    return arrays | {
        "points": sweep.points,
        "azimuth": lidar.beams.azimuth,
        "elevation": lidar.beams.elevation,
        "T_vehicle_lidar": lidar.T_vehicle_lidar,
    }


def sweep_picture(sweep: Sweep, lidar: Lidar) -> Picture:
    """RGB image: top view (forward is up), range image and intensity image, stacked vertically."""
    import cv2

    above = _from_above(sweep)
    images = [
        _colours(np.where(sweep.hit, 1 - np.sqrt(np.clip(sweep.range / FAR, 0, 1)), -1)),
        _colours(np.where(sweep.hit, np.clip(sweep.intensity * 1.5, 0, 1), -1)),
    ]
    bands = [_unrolled(image, lidar) for image in images]
    canvas = np.zeros((TOP_SIZE, COLUMNS, 3), np.uint8)
    left = (COLUMNS - TOP_SIZE) // 2
    canvas[:, left : left + TOP_SIZE] = above
    gap = np.full((6, COLUMNS, 3), 40, np.uint8)
    parts = [canvas]
    for band in bands:
        parts += [gap, np.asarray(cv2.resize(band, (COLUMNS, band.shape[0]), interpolation=0))]
    return np.concatenate(parts)


def _from_above(sweep: Sweep) -> Picture:
    """Top view of the points within FAR / 2, forward up, coloured by intensity."""
    scale = TOP_SIZE / FAR
    points, shown = sweep.points[sweep.hit], sweep.intensity[sweep.hit]
    colours = _colours(np.clip(shown * 1.5, 0, 1))
    row = np.floor(TOP_SIZE / 2 - points[:, 0] * scale).astype(int)
    column = np.floor(TOP_SIZE / 2 - points[:, 1] * scale).astype(int)
    inside = (row >= 0) & (row < TOP_SIZE) & (column >= 0) & (column < TOP_SIZE)
    picture = np.zeros((TOP_SIZE, TOP_SIZE, 3), np.uint8)
    picture[row[inside], column[inside]] = np.maximum(colours[inside], 60)
    return picture


def _unrolled(image: Picture, lidar: Lidar) -> Picture:
    """An image over azimuth (left is left) and elevation (up is up)."""
    azimuth, elevation = lidar.beams.azimuth, lidar.beams.elevation
    if len(lidar.shape) == 2:
        rows = np.argsort(-elevation[:, 0], kind="stable")
        columns = np.argsort(-azimuth[0], kind="stable")
        return np.repeat(image[rows][:, columns], ROW_HEIGHT, axis=0)
    height, width = 64 * ROW_HEIGHT, COLUMNS // 2
    spans = [max(float(np.ptp(angle)), 1e-6) for angle in (azimuth, elevation)]
    column = ((azimuth.max() - azimuth) / spans[0] * (width - 1)).astype(int)
    row = ((elevation.max() - elevation) / spans[1] * (height - 1)).astype(int)
    picture = np.zeros((height, width, 3), np.uint8)
    picture[row, column] = image
    return picture


def _colours(values: NDArray[Any]) -> Picture:
    """RGB [..., 3] of values 0 to 1 (blue to red); black below 0."""
    import cv2

    levels = (np.clip(values, 0, 1) * 255).astype(np.uint8)
    flat = np.asarray(cv2.applyColorMap(levels.reshape(-1, 1), cv2.COLORMAP_TURBO))
    colours = flat.reshape(*levels.shape, 3)[..., ::-1].copy()
    colours[values < 0] = 0
    return colours
