"""The ground of a scene: one grid of heights that everything which stands or falls asks."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.transform import Float
from .errors import SceneError
from .ground_kernels import height_at, heights_at, normals_at, pose_at


@dataclass(frozen=True, eq=False)
class Ground:
    """Heights on a grid in the world. Immutable and shared.

    Between cell centres heights are bilinear; outside the grid the nearest place of its rim
    counts. The ground has one height at each place: of a bridge and the road below it, it is the
    one that was driven.

    Attributes:
        origin: [2] float64, corner of cell (0, 0) [m].
        cell: edge of a cell [m].
        heights: [X, Y] float32, z at cell centres [m], finite; X and Y are at least 2.
        is_ground: [X, Y] bool, where ground is known: measured or driven, between measurements,
            under boxes. Elsewhere heights are continued from there.

    Raises:
        SceneError: shapes differ, a side is below 2, values are not finite, no positive cell.
    """

    origin: Float
    cell: float
    heights: NDArray[np.float32]
    is_ground: NDArray[np.bool_]

    def __post_init__(self) -> None:
        origin = np.array(self.origin, dtype=np.float64)
        heights = np.array(self.heights, dtype=np.float32, order="C")
        is_ground = np.array(self.is_ground, dtype=np.bool_, order="C")
        if origin.shape != (2,) or not np.isfinite(origin).all():
            raise SceneError(f"origin of the ground must be two numbers, not {origin}")
        if heights.ndim != 2 or min(heights.shape) < 2 or heights.shape != is_ground.shape:
            raise SceneError(
                f"ground of heights {list(heights.shape)} and is_ground {list(is_ground.shape)}; "
                "both must be [X, Y] with X, Y >= 2"
            )
        if not np.isfinite(heights).all():
            raise SceneError("heights of the ground hold values that are not finite")
        if not (np.isfinite(self.cell) and self.cell > 0):
            raise SceneError(f"cell of the ground must be a positive length, not {self.cell!r}")
        for array in (origin, heights, is_ground):
            array.flags.writeable = False
        object.__setattr__(self, "origin", origin)
        object.__setattr__(self, "cell", float(self.cell))
        object.__setattr__(self, "heights", heights)
        object.__setattr__(self, "is_ground", is_ground)

    @classmethod
    def level(cls, z: float) -> Ground:
        """Ground at height ``z`` [m] everywhere."""
        return cls(np.zeros(2), 1.0, np.full((2, 2), z), np.ones((2, 2), dtype=np.bool_))

    def height_at(self, points: ArrayLike) -> Float:
        """z [S] float64 [m] below ``points`` [S, 2] [m] of the world."""
        found: Float = heights_at(*self.grid, np.ascontiguousarray(points, dtype=np.float64))
        return found

    def height(self, x: float, y: float) -> float:
        """z [m] at one place [m]: the same for one, in about a microsecond."""
        found: float = height_at(*self.grid, x, y)
        return found

    def normal_at(self, points: ArrayLike) -> Float:
        """Unit normals [S, 3] float64 below ``points`` [S, 2], over the size of a vehicle."""
        found: Float = normals_at(*self.grid, np.ascontiguousarray(points, dtype=np.float64))
        return found

    def pose_on(self, x: float, y: float, yaw: float) -> Float:
        """``T_world_vehicle`` [4, 4] float64 of a vehicle that stands at (x, y) [m].

        Its x axis seen from above has heading ``yaw`` [rad]; its z axis is normal to the ground
        between its wheels.
        """
        found: Float = pose_at(*self.grid, x, y, yaw)
        return found

    def covers(self, points: Float) -> NDArray[np.bool_]:
        """Whether ``points`` [S, 2] lie where ground is known, [S] bool."""
        index = np.floor((points - self.origin) / self.cell).astype(np.int64)
        inside = ((index >= 0) & (index < self.heights.shape)).all(axis=1)
        index = np.clip(index, 0, np.array(self.heights.shape) - 1)
        return inside & self.is_ground[index[:, 0], index[:, 1]]

    @property
    def first_centre(self) -> Float:
        """[2] float64, centre of cell (0, 0) [m]."""
        return self.origin + self.cell / 2

    @property
    def centres(self) -> Float:
        """[X * Y, 2] float64, centres of all cells, row by row [m]."""
        cells = np.indices(self.heights.shape).reshape(2, -1).T.astype(np.float64)
        return cells * self.cell + self.first_centre

    @property
    def nbytes(self) -> int:
        """Memory of the grid [bytes]."""
        return self.heights.nbytes + self.is_ground.nbytes

    @cached_property
    def grid(self) -> tuple[NDArray[np.float32], Float]:
        """What kernels take: the heights, and where and how large their cells are."""
        return self.heights, np.append(self.first_centre, self.cell)


_of_bundles: WeakValueDictionary[str, Ground] = WeakValueDictionary()
_making = threading.Lock()


def of_bundle(content_hash: str, make: Callable[[], Ground]) -> Ground:
    """The ground of the bundle with that hash: the one in memory, or what ``make`` makes now. So a
    scene and summaries of it share one, and none is fitted twice."""
    with _making:
        known = _of_bundles.get(content_hash)
        if known is None:
            known = _of_bundles[content_hash] = make()
        return known
