"""How uncertain is what a pixel shows: a pass in which uncertainties take the place of colours.

Gaussians, sky and blending are those of the colour image, so that a pixel's value is the mean of
what it shows, by how much of it each takes; merged Gaussians of small images have the mean of those
they stand for. Backends know nothing of it.
"""

from __future__ import annotations

from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..scene import UNSEEN, GaussianCloud, Sky
from ..scene.spherical_harmonics import SH_C0
from .backends.base import RasterRequest
from .types import Instance, RenderError

UNCERTAINTY = "uncertainty"
"""Name of the modality."""
WITHOUT = (
    "it is not known of this scene how well its training rays determine what it shows; train it "
    "again, or run `real2sim fit-uncertainty SCENE LOG`"
)
"""Why a scene has no such images."""

# Clouds and skies are immutable and shared, and backends keep what they prepare of each.
_clouds: WeakKeyDictionary[GaussianCloud, GaussianCloud] = WeakKeyDictionary()
_skies: WeakKeyDictionary[Sky, Sky] = WeakKeyDictionary()


def uncertainty_request(request: RasterRequest) -> RasterRequest:
    """The pass whose image's channels are the uncertainty, in [0, 1].

    What has no uncertainties (an inserted asset, a shadow that an edit has made) counts as UNSEEN,
    and so does what is behind everything where there is no sky.

    Raises:
        RenderError: nothing of what is drawn has any.
    """
    if all(instance.cloud.uncertainties is None for instance in request.instances):
        raise RenderError(WITHOUT)
    options = replace(
        request.options,
        background=(UNSEEN, UNSEEN, UNSEEN),
        depth=False,
        instance=False,
        median_depth=False,
    )
    return replace(
        request,
        instances=tuple(map(shown_as_colour, request.instances)),
        sky=None if request.sky is None else _sky(request.sky),
        options=options,
    )


def shown_as_colour(instance: Instance) -> Instance:
    """The instance with uncertainties in place of its colours."""
    found = _clouds.get(instance.cloud)
    if found is None:
        cloud = instance.cloud.with_uncertainties()
        assert cloud.uncertainties is not None
        sh = _grey((cloud.uncertainties - 0.5) / SH_C0)[:, None].contiguous()
        found = _clouds.setdefault(instance.cloud, replace(cloud, sh=sh, uncertainties=None))
    return replace(instance, cloud=found, colour=None)


def uncertainty_picture(uncertainty: NDArray[np.float32]) -> NDArray[np.uint8]:
    """RGB [H, W, 3] of an image [H, W] for people: from black (0) to pale yellow (UNSEEN)."""
    import cv2

    levels = np.rint(np.clip(uncertainty / UNSEEN, 0, 1) * 255).astype(np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO)[..., ::-1])


def _sky(sky: Sky) -> Sky:
    found = _skies.get(sky)
    if found is None:
        known = sky.uncertainties
        faces = torch.full_like(sky.faces, UNSEEN) if known is None else _grey(known).contiguous()
        found = _skies.setdefault(sky, Sky(faces))
    return found


def _grey(values: Tensor) -> Tensor:
    """[..., 3]."""
    return values[..., None].expand(*values.shape, 3)
