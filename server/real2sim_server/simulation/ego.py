"""The recording vehicle as a visible, deformable object of its scene.

Recordings do not show it, so it is a generic car of its size made of Gaussians: bonnet, cabin with
dark glass, wheels. Its box follows the recorded rear axle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch

from ..geometry.transform import Float, quaternion_to_matrix
from ..scene import GaussianCloud, Scene, SceneObject, Trajectory
from .playback import PlacedObject, PlacedObjects

EGO = "ego"
"""Id of the ego as an object of a simulation."""
REAR_OVERHANG = 0.95
"""Distance from the rear axle to the rear end of its box [m], as in the closed loop."""
STEP = 0.07
"""Between Gaussians over its surface [m]."""
PAINT, GLASS, RUBBER, LAMP = (0.16, 0.27, 0.42), (0.05, 0.06, 0.08), (0.03,) * 3, (0.75, 0.74, 0.68)
SILL, BELT, BONNET = 0.17, 0.58, 0.60
"""Fractions of the height: underside of its body, lower edge of its windows, and its bonnet."""
ROOFLINE = np.array(
    [[0.0, 0.62], [0.02, 0.66], [0.14, 0.72], [0.3, 0.98], [0.42, 1.0], [0.58, 0.97], [0.74, 0.66],
     [0.97, 0.57], [1.0, 0.5]]
)  # fmt: skip
"""Fractions of length from the rear and of height along its middle, seen from the side."""
WHEEL = 0.33
"""Radius of its wheels [m]."""
SH_DC = 0.28209479177387814


@dataclass(frozen=True, eq=False)
class PlacedEgo:
    """The ego among a scenario's objects; see ``PlacedObject``."""

    scaled_size: tuple[float, float, float]
    trajectory: Trajectory
    instance_id: int
    object_id: str = EGO
    source_id: str = EGO
    category: str = "car"
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class WithEgo:
    """A scenario's objects and the ego.

    Attributes:
        visible: all of them, the ego last.
    """

    visible: tuple[PlacedObject, ...]


def with_ego(scene: Scene, state: PlacedObjects) -> tuple[Scene, PlacedObjects]:
    """A scene and its objects including the ego; unchanged if an object already has its id."""
    if any(o.object_id == EGO for o in state.visible):
        return scene, state
    trajectory = _boxes(scene.ego, scene.ego_size)
    instance = 1 + max((o.instance_id for o in state.visible), default=0)
    own = SceneObject(EGO, "car", scene.ego_size, ego_cloud(scene.ego_size), trajectory)
    complete = replace(scene, objects={**scene.objects, EGO: own.to(scene.background.device)})
    placed = PlacedEgo(scene.ego_size, trajectory, instance)
    return complete, WithEgo((*state.visible, placed))


def _boxes(ego: Trajectory, size: tuple[float, float, float]) -> Trajectory:
    """Poses of the ego's box, from those of its rear axle on the ground."""
    ahead = np.array([size[0] / 2 - REAR_OVERHANG, 0.0, size[2] / 2])
    shift = quaternion_to_matrix(ego.quaternions) @ ahead
    return Trajectory(ego.times_us, ego.positions + shift, ego.quaternions)


@lru_cache(maxsize=4)
def ego_cloud(size: tuple[float, float, float]) -> GaussianCloud:
    """Surface Gaussians of a generic car of this size [m], box frame."""
    length, _, height = size
    along = _ticks(length)
    top = height * np.interp(along / length, ROOFLINE[:, 0], ROOFLINE[:, 1])
    parts = [
        *(_side(along, top, size, sign) for sign in (-1.0, 1.0)),
        _upper(along, top, size),
        _end(top[0], size, rear=True),
        _end(top[-1], size, rear=False),
        *(_wheel(size, x, y) for x in (-0.3, 0.3) for y in (-1.0, 1.0)),
    ]
    points = np.concatenate([p for p, _ in parts]).astype(np.float32)
    colours = np.concatenate([c for _, c in parts]).astype(np.float32)
    n = len(points)
    return GaussianCloud(
        means=torch.from_numpy(points),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        scales=torch.full((n, 3), 0.65 * STEP),
        opacities=torch.full((n,), 0.95),
        sh=torch.from_numpy((colours - 0.5) / SH_DC)[:, None],
    )


def _ticks(extent: float) -> Float:
    """Evenly spaced positions from 0 to an extent, ends included [m]."""
    return np.linspace(0.0, extent, max(round(extent / STEP), 2) + 1)


def _coloured(points: Float, rgb: tuple[float, ...]) -> tuple[Float, Float]:
    return points, np.tile(np.array(rgb), (len(points), 1))


def _narrowing(z: Float, size: tuple[float, float, float]) -> Float:
    """Fraction of the width at heights above the underside of the box: windows lean inwards."""
    return 1.0 - 0.18 * np.clip(z / size[2] - BELT, 0.0, 1.0) / (1.0 - BELT)


def _side(
    along: Float, top: Float, size: tuple[float, float, float], sign: float
) -> tuple[Float, Float]:
    length, width, height = size
    x, z = np.meshgrid(along, _ticks(height), indexing="ij")
    kept = (z > SILL * height) & (z <= top[:, None])
    for axle in (-0.3, 0.3):
        kept &= np.hypot(x - length / 2 - axle * length, z - WHEEL) > WHEEL
    x, z = x[kept], z[kept]
    y = sign * width / 2 * _narrowing(z, size)
    points = np.stack([x - length / 2, y, z - height / 2], axis=1)
    colours = np.tile(np.array(PAINT), (len(points), 1))
    pillar = np.abs(x / length - 0.46) < 0.012
    roof = z > np.interp(x, along, top) - STEP
    colours[(z > BELT * height + STEP) & ~pillar & ~roof] = GLASS
    return points, colours


def _upper(along: Float, top: Float, size: tuple[float, float, float]) -> tuple[Float, Float]:
    """Bonnet, windscreens and roof."""
    length, width, height = size
    x, v = np.meshgrid(along, _ticks(width) / width - 0.5, indexing="ij")
    z = np.broadcast_to(top[:, None], x.shape)
    y = v * width * _narrowing(z, size)
    points = np.stack([x - length / 2, y, z - height / 2], axis=-1).reshape(-1, 3)
    steep = np.abs(np.gradient(top, along)) > 0.5
    glass = steep & (top > BONNET * height) & (along > 0.08 * length) & (along < 0.8 * length)
    colours = np.tile(np.array(PAINT), (len(points), 1))
    colours[np.repeat(glass, x.shape[1])] = GLASS
    return points, colours


def _end(top: float, size: tuple[float, float, float], *, rear: bool) -> tuple[Float, Float]:
    length, width, height = size
    y, z = np.meshgrid(_ticks(width) - width / 2, _ticks(top), indexing="ij")
    kept = z > SILL * height
    y, z = y[kept], z[kept]
    x = np.full(len(y), -length / 2 if rear else length / 2)
    colours = np.tile(np.array(PAINT), (len(y), 1))
    lamps = (np.abs(y) > 0.32 * width) & (z > 0.36 * height) & (z < 0.48 * height)
    colours[lamps] = (0.5, 0.04, 0.04) if rear else LAMP
    colours[z < 0.26 * height] = RUBBER
    return np.stack([x, y, z - height / 2], axis=1), colours


def _wheel(size: tuple[float, float, float], axle: float, side: float) -> tuple[Float, Float]:
    length, width, height = size
    u, w, v = np.meshgrid(
        _ticks(2 * WHEEL) - WHEEL, _ticks(0.2), _ticks(2 * WHEEL) - WHEEL, indexing="ij"
    )
    kept = np.hypot(u, v) <= WHEEL
    y = side * (width / 2 - w[kept])
    points = np.stack([u[kept] + axle * length, y, v[kept] + WHEEL - height / 2], axis=1)
    return _coloured(points, RUBBER)
