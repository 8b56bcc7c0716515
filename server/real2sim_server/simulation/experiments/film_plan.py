"""How an experiment is filmed, kept beside its result so that it can be filmed again."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..._files import atomic_file
from ...geometry.rotation import Float, matrix_to_quaternion
from ...geometry.transform import apply_transform
from ...physics.colliders import Box, Plane
from ...physics.errors import PhysicsError
from ...scene import GaussianCloud
from .setup import Experiment

FILE = "film.json"
SLAB = (0.3, 2.6, 1.2)
"""Depth, width and height of what is shown of a virtual wall, around the focus [m]."""
PITCH = 0.07
"""Of Gaussians on an obstacle [m]."""
THIN = 0.008
"""Of these Gaussians across their face [m]."""
CONCRETE, STEEL = (0.56, 0.55, 0.52), (0.3, 0.33, 0.34)
SLENDER = 0.6
"""What is narrower than this is a post of steel [m]."""
SUN = np.array([0.4, 0.3, 0.87])
SH_0 = 0.28209479177387814
Obstacle = tuple[Float, Float]
"""Pose [4, 4] of a box and its size [3] [m]."""


@dataclass(frozen=True, eq=False)
class FilmPlan:
    """What a film shows and from where.

    Attributes:
        focus: [3] point of the world that the near camera faces [m].
        side: [3] direction from the focus to the near camera.
        distance: of that camera [m].
        start_us: scene time of the start [us].
        without: objects that are not shown.
        slow: how many times slower it plays than it was.
        obstacles: boxes that vehicles run into, which no recording shows.
        follows: object that focus and near camera move along with; None: they stay.
    """

    focus: Float
    side: Float
    distance: float
    start_us: int
    without: frozenset[str] = frozenset()
    slow: float = 1.0
    obstacles: tuple[Obstacle, ...] = ()
    follows: str | None = None

    @classmethod
    def of(cls, experiment: Experiment, height: Callable[[float, float], float]) -> FilmPlan:
        """Of an experiment; ``height``: of the ground at a place [m]."""
        solid: list[Obstacle] = []
        for collider in experiment.options.colliders:
            if collider.name in experiment.options.road:
                continue
            if isinstance(collider, Box):
                solid.append((np.asarray(collider.T_world_box), np.asarray(collider.size)))
            elif isinstance(collider, Plane):
                solid.append(_slab(collider, experiment.focus, height))
        return cls(
            experiment.focus,
            experiment.side,
            experiment.distance,
            experiment.options.start_us,
            experiment.without,
            experiment.slow,
            tuple(solid),
            experiment.follows,
        )

    def save(self, folder: Path) -> None:
        """Write FILE into a folder."""
        record = {
            "focus": self.focus.tolist(),
            "side": self.side.tolist(),
            "distance": self.distance,
            "start_us": self.start_us,
            "without": sorted(self.without),
            "slow": self.slow,
            "follows": self.follows,
            "obstacles": [{"pose": p.tolist(), "size": s.tolist()} for p, s in self.obstacles],
        }
        with atomic_file(folder / FILE) as file:
            file.write(json.dumps(record, indent=1).encode())

    @classmethod
    def load(cls, folder: Path) -> FilmPlan:
        """Read what :meth:`save` wrote.

        Raises:
            PhysicsError: there is none, or none that can be read.
        """
        try:
            record: dict[str, Any] = json.loads((folder / FILE).read_text())
            return cls(
                np.array(record["focus"], dtype=np.float64),
                np.array(record["side"], dtype=np.float64),
                float(record["distance"]),
                int(record["start_us"]),
                frozenset(record["without"]),
                float(record["slow"]),
                tuple((np.array(o["pose"]), np.array(o["size"])) for o in record["obstacles"]),
                record.get("follows"),
            )
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise PhysicsError(
                f"{folder / FILE}: no readable plan of a film ({error}); `real2sim simulate` "
                "leaves one beside each result"
            ) from error


def _slab(wall: Plane, focus: Float, height: Callable[[float, float], float]) -> Obstacle:
    """The part of a virtual wall near the focus, behind its surface and standing on the ground."""
    point, normal = np.asarray(wall.point), np.asarray(wall.normal)
    foot = focus - ((focus - point) @ normal + SLAB[0] / 2) * normal
    pose = np.eye(4)
    across = np.cross([0.0, 0.0, 1.0], normal)
    across /= max(float(np.linalg.norm(across)), 1e-9)
    pose[:3, :3] = np.stack([normal, across, np.cross(normal, across)], axis=1)
    pose[:3, 3] = foot
    pose[2, 3] = height(foot[0], foot[1]) + SLAB[2] / 2
    return pose, np.array(SLAB)


def obstacle_cloud(obstacle: Obstacle) -> GaussianCloud:
    """Gaussians on the faces of a box, in the world: concrete, or steel where it is slender."""
    pose, size = obstacle
    colour = np.array(STEEL if size[:2].max() < SLENDER else CONCRETE)
    places, turns, lit = [], [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            points = _face(size, axis, side)
            normal = pose[:3, axis] * side
            brightness = 0.55 + 0.5 * max(float(normal @ SUN), 0.0)
            places.append(apply_transform(pose, points))
            turns.append(np.tile(np.roll(pose[:3, :3], 2 - axis, axis=1), (len(points), 1, 1)))
            lit.append(np.full(len(points), brightness))
    means, light = np.concatenate(places), np.concatenate(lit)
    rough = np.random.default_rng(7).normal(1.0, 0.05, (len(means), 1))
    rgb = colour * light[:, None] * rough
    proper = np.concatenate(turns)
    proper[np.linalg.det(proper) < 0, :, 0] *= -1
    n = len(means)
    return GaussianCloud(
        _tensor(means),
        _tensor(matrix_to_quaternion(proper)),
        _tensor(np.tile([0.6 * PITCH, 0.6 * PITCH, THIN], (n, 1))),
        _tensor(np.full(n, 0.98)),
        _tensor(((rgb - 0.5) / SH_0)[:, None, :]),
    )


def _face(size: Float, axis: int, side: float) -> Float:
    """[K, 3] points over one face of a box, in its frame."""
    one, two = (axis + 1) % 3, (axis + 2) % 3
    grids = [
        (np.arange(max(round(size[a] / PITCH), 1)) + 0.5) / max(round(size[a] / PITCH), 1) - 0.5
        for a in (one, two)
    ]
    u, v = np.meshgrid(grids[0] * size[one], grids[1] * size[two], indexing="ij")
    points = np.zeros((u.size, 3))
    points[:, axis], points[:, one], points[:, two] = side * size[axis] / 2, u.ravel(), v.ravel()
    return points


def _tensor(values: NDArray[np.float64]) -> torch.Tensor:
    return torch.from_numpy(np.asarray(values, dtype=np.float32))
