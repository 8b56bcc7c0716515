"""Text tables of numbers and checks that the readers fraction; every failure is a LogError."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ....geometry.rotation import Float, is_rotation
from ....scene import Trajectory
from ...driving_log import LogError


def read_lines(path: Path) -> list[str]:
    """Lines of a text file without trailing blank ones.

    Raises:
        LogError: the file is missing, not text, or empty.
    """
    try:
        text = path.read_text(encoding="utf-8").rstrip()
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise LogError(f"{path}: is not a text file ({error})") from error
    if not text:
        raise LogError(f"{path}: is empty")
    return text.split("\n")


def parse_numbers(words: list[str], where: str) -> Float:
    """Finite float64 numbers of ``words``; ``where`` names file and line in the LogError."""
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise LogError(f"{where}: expected numbers, {error}") from error
    if not np.isfinite(values).all():
        raise LogError(f"{where}: holds a value that is not finite")
    return values


def read_number_table(path: Path, *, columns: int, what: str) -> Float:
    """Rows [N, columns] float64 of a whitespace-separated table.

    Raises:
        LogError: with the line, for a wrong number of columns or values that are not finite.
    """
    rows = []
    for number, line in enumerate(read_lines(path), start=1):
        words = line.split()
        where = f"{path} line {number}"
        if len(words) != columns:
            raise LogError(f"{where}: expected {columns} numbers ({what}), found {len(words)}")
        rows.append(parse_numbers(words, where))
    return np.array(rows)


def check_rigid(matrix: Float, where: str) -> Float:
    """The matrix [4, 4] itself when it is a finite rigid transform.

    Raises:
        LogError: otherwise.
    """
    if not np.isfinite(matrix).all():
        raise LogError(f"{where}: holds a value that is not finite")
    if not is_rotation(matrix[:3, :3]):
        raise LogError(f"{where}: its left 3x3 block is no rotation matrix")
    return matrix


def check_frame_times(times_us: NDArray[np.int64], where: str) -> NDArray[np.int64]:
    """The time stamps themselves when they increase strictly and there is at least one.

    Raises:
        LogError: naming the first frame that is out of order.
    """
    if len(times_us) == 0:
        raise LogError(f"{where}: a log needs at least one frame")
    unordered = np.flatnonzero(np.diff(times_us) <= 0)
    if len(unordered):
        i = int(unordered[0])
        raise LogError(
            f"{where}: frame times must increase strictly, but frame {i} is at {times_us[i]} us "
            f"and frame {i + 1} at {times_us[i + 1]} us"
        )
    return times_us


def check_ego_covers(ego: Trajectory, times_us: NDArray[np.int64], where: str) -> None:
    """Refuse ego poses that do not reach over all frames.

    Raises:
        LogError: otherwise.
    """
    if not (ego.covers(int(times_us[0])) and ego.covers(int(times_us[-1]))):
        raise LogError(
            f"{where}: ego poses cover [{ego.start_us}, {ego.end_us}] us, but the frames go from "
            f"{times_us[0]} to {times_us[-1]} us"
        )
