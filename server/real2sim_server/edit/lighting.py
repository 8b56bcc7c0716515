"""The light that an asset is put into: brightness and tint of the scene around it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ..scene import GaussianCloud, Scene
from ..scene.spherical_harmonics import SH_C0

Colour = tuple[float, float, float]

AROUND = 20.0
"""Background this far around the ego's path gives the ambient light [m]."""

HEIGHTS = (-2.0, 6.0)
"""And this far below and above it: the street, not the tree tops [m]."""

GAIN_RANGE = (0.5, 2.0)
"""Colours are never changed by more; beyond, the guess is likelier wrong than the asset."""

LUMA = (0.2126, 0.7152, 0.0722)


def ambient_colour(scene: Scene) -> Colour:
    """Mean colour of the street around the ego's path, each Gaussian by the area it shows."""
    cloud = scene.background
    path = torch.from_numpy(scene.ego.positions).to(cloud.means)
    low, high = path.min(dim=0).values, path.max(dim=0).values
    reach = torch.tensor([AROUND, AROUND, 0.0]).to(cloud.means)
    below, above = (torch.tensor([0.0, 0.0, h]).to(cloud.means) for h in HEIGHTS)
    near = (cloud.means >= low - reach + below) & (cloud.means <= high + reach + above)
    chosen = near.all(dim=1)
    mean = mean_colour(cloud.select(chosen)) if bool(chosen.any()) else mean_colour(cloud)
    return mean or (0.5, 0.5, 0.5)


def mean_colour(cloud: GaussianCloud) -> Colour | None:
    """Mean RGB of a cloud, each Gaussian by opacity and area; None where it shows nothing."""
    if not len(cloud):
        return None
    largest = cloud.scales.double().topk(2, dim=1).values.prod(dim=1)
    weights = cloud.opacities.double() * largest
    if float(weights.sum()) <= 0:
        return None
    rgb = (cloud.sh[:, 0].double() * SH_C0 + 0.5).clamp(0.0, 1.0)
    red, green, blue = ((rgb * weights[:, None]).sum(dim=0) / weights.sum()).tolist()
    return (red, green, blue)


def relighting_gain(scene: Scene, cloud: GaussianCloud, ambient: Colour | None) -> Colour:
    """Factors on the colours of an asset that bring it into the light of ``scene``.

    Where the light is known that the asset was recorded in, they are the ratio of the two ambient
    colours. Else its brightness is brought to that of the scene's own objects; its tint stays.

    Args:
        scene: where the asset is put.
        cloud: of the asset.
        ambient: see :func:`ambient_colour`, of where the asset was cut out.
    """
    if ambient is not None:
        here = ambient_colour(scene)
        red, green, blue = (_bounded(h / max(a, 1e-3)) for h, a in zip(here, ambient, strict=True))
        return (red, green, blue)
    own = mean_colour(cloud)
    others = [mean_colour(o.cloud) for o in scene.objects.values()]
    lumas = [_luma(colour) for colour in others if colour is not None]
    if own is None or not lumas:
        return (1.0, 1.0, 1.0)
    factor = _bounded(float(np.median(lumas)) / max(_luma(own), 1e-3))
    return (factor, factor, factor)


def relit(cloud: GaussianCloud, gain: Colour) -> GaussianCloud:
    """The cloud with its colours multiplied by ``gain``; itself where that is 1."""
    if gain == (1.0, 1.0, 1.0):
        return cloud
    factors: Tensor = torch.tensor(gain).to(cloud.sh)
    sh = cloud.sh * factors
    # The renderer adds 0.5 to what the harmonics give; that part has to be multiplied too.
    sh[:, 0] += (factors - 1.0) * 0.5 / SH_C0
    return replace(cloud, sh=sh)


def _luma(colour: Colour) -> float:
    return sum(w * c for w, c in zip(LUMA, colour, strict=True))


def _bounded(factor: float) -> float:
    low, high = GAIN_RANGE
    return min(high, max(low, factor))
