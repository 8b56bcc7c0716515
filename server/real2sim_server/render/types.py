"""Inputs and outputs of rasterize()."""

from __future__ import annotations

import functools
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from real2sim_proto.conventions import STATIC, UNLABELED

from ..scene import GaussianCloud, Sky, TimeColour

Detail = Literal["full", "auto"]
SMALL_IMAGE_PIXELS = 128 * 128
"""Maximum number of pixels of a small image."""


class RenderError(ValueError):
    """An invalid render request; the message names the allowed values."""


@dataclass(frozen=True, eq=False)
class Instance:
    """One cluster of Gaussians placed in the world. The cloud is shared, never copied.

    Attributes:
        cloud: Gaussians in their own frame.
        T_world_object: [4, 4] rigid transform, float64; None for the identity (background). A
            tensor (float32 or float64) that requires grad receives the gradient of the pose.
        instance_id: value in instance images, 0 (background) to 65535.
        scale: [3] scales the cloud about its origin along its own axes.
        covars: [N, 3, 3] float32, covariances in the cloud frame that replace quats and scales
            (deformed clouds), or None.
        colour: time-dependent colours of the cloud, or None.
        t_us: time at which ``colour`` is evaluated [us].
        semantic: value in semantic images; the same for all instances of an ``instance_id``.
        twist: [6] float64, velocity of its origin [m/s] and angular velocity [rad/s], world frame,
            for cameras with a rolling shutter; None if stationary.
    """

    cloud: GaussianCloud
    T_world_object: NDArray[np.float64] | Tensor | None = None
    instance_id: int = 0
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    covars: Tensor | None = None
    colour: TimeColour | None = None
    t_us: int = 0
    semantic: int = STATIC
    twist: NDArray[np.float64] | None = None


@dataclass(frozen=True, eq=False)
class WorldViews:
    """C cameras in W worlds with the same K instances.

    Attributes:
        things: K instances; their poses and times are ignored.
        poses: [W, K, 4, 4] float64, ``T_world_object``.
        shown: [W, K] bool, whether each instance is present.
        times_us: [W] int64, times at which colours are evaluated [us].
        viewmats: [W, C, 4, 4] float64, ``T_camera_world``.
        Ks: [C, 3, 3] float64 [px].
    """

    things: tuple[Instance, ...]
    poses: NDArray[np.float64]
    shown: NDArray[np.bool_]
    times_us: NDArray[np.int64]
    viewmats: NDArray[np.float64]
    Ks: NDArray[np.float64]


@dataclass(frozen=True)
class RasterOptions:
    """Options of rasterize(), named after gsplat.rasterization.

    Attributes:
        near_plane, far_plane: depth range of Gaussian centres; others are dropped [m].
        eps2d: added to the diagonal of projected covariances [px^2].
        radius_clip: Gaussians with at most this extent on screen are dropped [px].
        rasterize_mode: ``classic``, or ``antialiased`` (opacity compensated for ``eps2d``).
        background: RGB in [0, 1] behind everything, if there is no sky.
        depth, instance: whether to draw these images in addition to RGB and alpha.
        median_depth: whether to draw that image, see RenderOutput.
        track_screen: whether to collect ScreenStatistics for densification; only in passes that
            carry gradients.
        detail: ``full``: draw every visible Gaussian. ``auto``: draw images of at most
            SMALL_IMAGE_PIXELS from Gaussians merged to about two pixels, antialiased and with the
            blur of one pixel. That is much faster and closer to a downscaled large image. Larger
            images, and all images on backends without levels of detail, are bitwise equal to
            ``full``.
    """

    near_plane: float = 0.01
    far_plane: float = 1e10
    eps2d: float = 0.3
    radius_clip: float = 0.0
    rasterize_mode: str = "classic"
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    depth: bool = True
    instance: bool = True
    median_depth: bool = False
    track_screen: bool = False
    detail: Detail = "full"


@dataclass(frozen=True, eq=False)
class ScreenStatistics:
    """Screen-space statistics of the Gaussians of each instance, in the order of the instances.

    Attributes:
        radii: [C, N] float32 each, half the longer side of the screen bounding box [px], rounded
            up; 0 if a Gaussian was not drawn.
        gradients: [N, 2] float32 each, zero until backward: sums over cameras of the norm of the
            loss gradient with respect to the screen position. Column 0 uses the gradient, column 1
            the sum over pixels of its absolute value (absgrad, Ye et al. 2024). Before the norm, x
            is multiplied by C width / 2 and y by C height / 2 as in gsplat's DefaultStrategy, so
            that its thresholds apply. A second backward adds to them.
    """

    radii: tuple[Tensor, ...]
    gradients: tuple[Tensor, ...]

    def first(self, count: int) -> ScreenStatistics:
        """Statistics of the first ``count`` instances."""
        return ScreenStatistics(self.radii[:count], self.gradients[:count])


@dataclass(frozen=True, eq=False)
class RenderOutput:
    """Images of C cameras.

    Attributes:
        rgb: [C, H, W, 3] float32, blended over sky or background, not clamped above 1.
        alpha: [C, H, W] float32 in [0, 1], accumulated opacity.
        depth: [C, H, W] float32, expected depth along the camera z axis [m], that is
            sum(w z) / sum(w); 0 where alpha is 0. None if not requested.
        instance: [C, H, W] uint16, instance_id of the Gaussian at which transmittance first falls
            to 0.5 or below; 0 if it never does. None if not requested.
        median_depth: [C, H, W] float32, depth of that Gaussian [m]; 0 if none. Has no gradients.
            None if not requested.
        uncertainty: [C, H, W] float32, see :mod:`.frame`; None if not requested.
        classes: [65536] uint8, class by instance id; None if not requested.
        behind: class of pixels whose transmittance stays above 0.5.
        timing_ms: milliseconds by stage (``project``, ``sort``, ``blend``, ``sky`` ...).
        screen: screen-space statistics; None if not requested or without gradients.
        between: callback of the request, for later processing of large images.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor | None
    instance: Tensor | None
    timing_ms: dict[str, float] = field(default_factory=dict)
    screen: ScreenStatistics | None = None
    between: Callable[[], object] | None = None
    median_depth: Tensor | None = None
    uncertainty: Tensor | None = None
    classes: NDArray[np.uint8] | None = None
    behind: int = UNLABELED


__all__ = [
    "Instance",
    "RasterOptions",
    "RenderError",
    "RenderOutput",
    "ScreenStatistics",
    "Sky",
    "WorldViews",
]


@dataclass(frozen=True)
class Window:
    """Pixels [top:bottom, left:right] in which an object is also labelled without occluders."""

    instance_id: int
    left: int
    top: int
    right: int
    bottom: int


@dataclass(frozen=True, eq=False)
class LabelOutput:
    """Image and labels of one camera.

    Attributes:
        rgb: [H, W, 3] float32, as in RenderOutput.
        depth: [H, W] float32 depth of each pixel's front along the camera z axis [m], 0 if none.
        instance: [H, W] uint16, instance id of the front; 0 for background or without front.
        alone: by window, depths [h, w] float32 of the object without occluders [m].
        timing_ms: milliseconds by stage.
    """

    rgb: Tensor
    depth: NDArray[np.float32]
    instance: NDArray[np.uint16]
    alone: Sequence[NDArray[np.float32]]
    timing_ms: dict[str, float] = field(default_factory=dict)


# Results cached for the lifetime of an immutable object

Source = TypeVar("Source")
Made = TypeVar("Made")


def weak_cache(make: Callable[[Source], Made]) -> Callable[[Source], Made]:
    """Cache the results of ``make`` by weak reference to the source."""
    kept: weakref.WeakKeyDictionary[Source, Made] = weakref.WeakKeyDictionary()

    @functools.wraps(make)
    def get(source: Source) -> Made:
        found = kept.get(source)
        if found is None:
            found = kept[source] = make(source)
        return found

    return get
