"""A soft contact shadow: what makes an object that an edit has placed stand on the road.

Recorded objects have theirs in the background. One shared cloud of flat dark Gaussians, stretched
to the footprint of each object, costs no memory and works in every backend and camera.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import torch

from ..geometry.box import bottom_centres
from ..geometry.rotation import Float, yaw_quaternion
from ..geometry.transform import transform_from
from ..render.types import Instance
from ..scene import GaussianCloud, Ground
from ..scene.spherical_harmonics import SH_C0

MARGIN = 0.35
"""The shadow reaches this far beyond the footprint [m], fading."""

LIFT = 0.04
"""Above the ground [m], so that it lies in front of the ground's own Gaussians."""

DARKNESS = 0.22
"""Opacity of each Gaussian in full shadow. About three overlap at any point: half the light."""

FADE_HEIGHT = 1.0
"""Objects this high above the ground cast no contact shadow [m]."""

LEVELS = 8
"""Shades between none and full."""

CELLS = (20, 12)
COLOUR = (0.02, 0.02, 0.025)


def contact_shadow(
    T_world_object: Float,
    size: tuple[float, float, float],
    ground: Ground,
    *,
    device: torch.device,
) -> Instance | None:
    """The shadow of a box; None where it is too far above the ground.

    Args:
        T_world_object: [4, 4] float64, of the box centre.
        size: (length, width, height) [m].
        ground: below it.
        device: where the shadow's Gaussians should live.
    """
    bottom = bottom_centres(T_world_object[None], size)[0]
    height = ground.height(float(bottom[0]), float(bottom[1]))
    clearance = max(0.0, float(bottom[2]) - height)
    level = round(LEVELS * (1 - clearance / FADE_HEIGHT))
    if level <= 0:
        return None
    forward = T_world_object[:3, 0]
    yaw = np.arctan2(forward[1], forward[0])
    level_ground = transform_from([bottom[0], bottom[1], height + LIFT], yaw_quaternion(float(yaw)))
    footprint = (size[0] + 2 * MARGIN, size[1] + 2 * MARGIN, 1.0)
    return Instance(_decal(level, str(device)), level_ground, instance_id=0, scale=footprint)


@cache
def _decal(level: int, device: str) -> GaussianCloud:
    """A unit square of flat Gaussians, darkest in the middle, nothing at the rim."""
    columns, rows = CELLS
    x, y = np.meshgrid(
        (np.arange(columns) + 0.5) / columns - 0.5,
        (np.arange(rows) + 0.5) / rows - 0.5,
        indexing="ij",
    )
    inside = np.clip((0.5 - np.maximum(np.abs(x), np.abs(y))) / 0.2, 0.0, 1.0)
    corner = np.clip((0.62 - np.hypot(x, y)) / 0.2, 0.0, 1.0)
    shade = (inside * inside * (3 - 2 * inside) * corner).ravel()
    count = len(shade)
    means = np.stack([x.ravel(), y.ravel(), np.zeros(count)], axis=1)
    spread = [0.7 / columns, 0.7 / rows, 0.004]
    colour = (torch.tensor(COLOUR) - 0.5) / SH_C0
    decal = GaussianCloud(
        means=torch.from_numpy(means).float(),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        scales=torch.tensor(spread).repeat(count, 1),
        opacities=torch.from_numpy(shade * DARKNESS * level / LEVELS).float(),
        sh=colour.expand(count, 1, 3).contiguous(),
    )
    return decal.to(device)
