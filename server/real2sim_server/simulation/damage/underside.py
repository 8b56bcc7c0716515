"""The underside of a vehicle that turns over.

No recording shows it. What is learned there, where wheels meet the road, is the dark of the contact
shadow with blurred edges; turned up it would be a ragged plate above the wheels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from ...geometry.rotation import quaternion_to_matrix
from ...scene import GaussianCloud
from .parts import AXLES, in_wheels

SH_0 = 0.28209479177387814
SHADOW, SILLS = 0.1, 0.3
"""What is below sills and reaches so far down is shadow or tyre: heights over the road [m]."""
FLOOR = 0.2
"""Height of a floor over the road [m]."""
INSET = (0.16, 0.06)
"""Of the floor from the ends and from the sides [m]."""
ROUNDED = 4.0
"""Exponent of its outline, which has no corners where bumpers are round."""
PITCH, THICK = 0.07, 0.012
"""Of its Gaussians, and half their thickness [m]."""
SHEET, FRAME, EXHAUST = 0.12, 0.2, 0.34
"""Brightness of the floor, of axles and sills, of the exhaust."""
ROUGH = 0.12
"""By how much ribs and covers are lighter and darker."""
AXLE, PIPE = 0.09, 0.06
"""Half widths of an axle and of an exhaust [m]."""


def with_underside(cloud: GaussianCloud, size: Sequence[float]) -> GaussianCloud:
    """A vehicle with a floor instead of its shadow.

    Args:
        cloud: its Gaussians at rest, object frame.
        size: (length, width, height) [m].
    """
    points = cloud.means.detach().cpu().numpy().astype(np.float64)
    height = points[:, 2] + size[2] / 2
    axes = quaternion_to_matrix(cloud.quats.detach().cpu().numpy())
    reach = 2 * np.abs(axes[:, 2] * cloud.scales.detach().cpu().numpy()).max(axis=1)
    shadow = (height < SILLS) & (height - reach < SHADOW) & ~in_wheels(points, size)
    if not shadow.any():
        return cloud
    kept = torch.from_numpy(np.flatnonzero(~shadow)).to(cloud.device)
    pattern = torch.from_numpy(np.flatnonzero(shadow)[:1]).to(cloud.device)
    return GaussianCloud.concatenate([cloud.select(kept), _floor(cloud.select(pattern), size)])


def _floor(pattern: GaussianCloud, size: Sequence[float]) -> GaussianCloud:
    """Gaussians of a floor, with all else as the one of ``pattern`` has it."""
    length, width, height = size
    x, y = (
        np.linspace(-half, half, max(round(2 * half / PITCH), 2))
        for half in (length / 2 - INSET[0], width / 2 - INSET[1])
    )
    along, across = (a.ravel() for a in np.meshgrid(x, y, indexing="ij"))
    within = np.abs(along / x[-1]) ** ROUNDED + np.abs(across / y[-1]) ** (3 * ROUNDED) <= 1
    along, across = along[within], across[within]
    axle = np.abs(np.abs(along) - AXLES * length) < AXLE
    grey = np.where(axle | (np.abs(across) > width / 2 - 0.2), FRAME, SHEET)
    pipe = (np.abs(across - 0.15 * width) < PIPE) & (along < AXLES * length)
    grey = np.where(pipe, EXHAUST, grey)
    grey = grey * (1 + ROUGH * np.sin(9.0 * along) * np.sin(14.0 * across))
    means = np.stack([along, across, np.full(len(along), FLOOR - height / 2)], axis=1)
    count = len(means)
    each = pattern.select(torch.zeros(count, dtype=torch.int64, device=pattern.device))
    sh = torch.zeros_like(each.sh)
    sh[:, 0] = _tensor((grey - 0.5) / SH_0, sh)[:, None]
    return replace(
        each,
        means=_tensor(means, sh),
        quats=_tensor(np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)), sh),
        scales=_tensor(np.tile([0.6 * PITCH, 0.6 * PITCH, THICK], (count, 1)), sh),
        opacities=torch.full_like(each.opacities, 0.98),
        sh=sh,
    )


def _tensor(values: np.ndarray, like: torch.Tensor) -> torch.Tensor:
    return torch.from_numpy(values.astype(np.float32)).to(like.device)
