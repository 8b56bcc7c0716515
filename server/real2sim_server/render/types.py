"""Input and output of rasterize()."""

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
    """A render request that cannot be answered; the message says what is allowed."""


@dataclass(frozen=True, eq=False)
class Instance:
    """One cluster of Gaussians placed in the world. The cloud is shared, never copied.

    Attributes:
        cloud: Gaussians in their own frame.
        T_world_object: [4, 4] rigid transform, float64; None for the identity (background). A
            tensor (float32 or float64) that requires grad gets the gradient of the pose.
        instance_id: value in instance images, 0 (background) to 65535.
        scale: [3] multiplies the cloud about its own origin along its own axes.
        covars: [N, 3, 3] float32, covariances in the cloud's frame that replace quats and scales
            (deformed clouds), or None.
        colour: how the cloud's colours change over time, or None.
        t_us: instant at which ``colour`` is taken [us].
        semantic: value in semantic images; instances of one ``instance_id`` have one.
        twist: [6] float64, velocity [m/s] of its origin and angular velocity [rad/s] in the world,
            for cameras with a rolling shutter; None: it stands.
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
    """What C cameras see in W worlds that are made of the same K things.

    Attributes:
        things: K of them; where they stand and their instants are said below.
        poses: [W, K, 4, 4] float64, ``T_world_object``.
        shown: [W, K] bool, which of them are there.
        times_us: [W] int64, instants at which their colours are taken [us].
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
        near_plane, far_plane: Gaussians whose centre depth is outside are dropped [m].
        eps2d: added to the diagonal of projected covariances [px^2].
        radius_clip: Gaussians whose extent on screen is not larger are dropped [px].
        rasterize_mode: ``classic``, or ``antialiased`` (opacity compensated for ``eps2d``).
        background: RGB in [0, 1] behind everything where there is no sky.
        depth, instance: whether these images are made besides RGB and alpha.
        median_depth: whether that image is made, see RenderOutput.
        track_screen: whether ScreenStatistics are gathered, which densification reads; only in
            passes that carry gradients.
        detail: ``full``: every Gaussian that an image shows is drawn; ``auto``: images of at most
            SMALL_IMAGE_PIXELS are drawn from Gaussians merged to about two pixels, antialiased and
            with the blur of a pixel alone, in a fraction of the time and nearer to a large image
            scaled down; larger ones, and all on backends that merge nothing, as with ``full``,
            bit for bit.
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
    """How the Gaussians of each instance showed on the images, in the order of the instances.

    Attributes:
        radii: [C, N] float32 each, half the longer side of the box about what is drawn [px],
            rounded up; 0 where a Gaussian was not drawn.
        gradients: [N, 2] float32 each, zero until backward fills them in: sums over cameras of
            the norm of the loss gradient by the centre on the image. Column 0 takes the gradient
            itself, column 1 the sum over pixels of its absolute value (absgrad, Ye et al. 2024).
            Before the norm x is multiplied by C width / 2 and y by C height / 2, as gsplat's
            DefaultStrategy does, so that its thresholds hold. A second backward adds to them.
    """

    radii: tuple[Tensor, ...]
    gradients: tuple[Tensor, ...]

    def first(self, count: int) -> ScreenStatistics:
        """Of the first instances alone."""
        return ScreenStatistics(self.radii[:count], self.gradients[:count])


@dataclass(frozen=True, eq=False)
class RenderOutput:
    """Images of C cameras.

    Attributes:
        rgb: [C, H, W, 3] float32, blended over sky or background, not clamped above 1.
        alpha: [C, H, W] float32 in [0, 1], accumulated opacity.
        depth: [C, H, W] float32, expected depth along the camera z axis [m], that is
            sum(w z) / sum(w); 0 where alpha is 0. None when not asked for.
        instance: [C, H, W] uint16, instance_id of the Gaussian at which transmittance first falls
            to 0.5 or below; 0 where it never does. None when not asked for.
        median_depth: [C, H, W] float32, depth of that Gaussian [m]; 0 where there is none, and
            without gradients. None when not asked for.
        uncertainty: [C, H, W] float32, see :mod:`.frame`; None where not requested.
        classes: [65536] uint8, of ``instance`` by id; None where not requested.
        behind: class of a pixel at which transmittance stays above 0.5.
        timing_ms: milliseconds by stage (``project``, ``sort``, ``blend``, ``sky`` ...).
        screen: sizes and gradients on the image; None when not asked for or without gradients.
        between: of the request; for what is done with large images afterwards.
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
    """Pixels [top:bottom, left:right] of an image in which an object is also requested alone."""

    instance_id: int
    left: int
    top: int
    right: int
    bottom: int


@dataclass(frozen=True, eq=False)
class LabelOutput:
    """One camera's picture and labels.

    Attributes:
        rgb: [H, W, 3] float32, as of RenderOutput.
        depth: [H, W] float32 along the camera's z axis, of each pixel's front [m], 0 for none.
        instance: [H, W] uint16, object of the front; 0 also where there is none.
        alone: by window, depths [h, w] float32 of the object's own fronts, whatever hides it.
        timing_ms: by stage.
    """

    rgb: Tensor
    depth: NDArray[np.float32]
    instance: NDArray[np.uint16]
    alone: Sequence[NDArray[np.float32]]
    timing_ms: dict[str, float] = field(default_factory=dict)


# Results cached for as long as an immutable object lives

Source = TypeVar("Source")
Made = TypeVar("Made")


def weak_cache(make: Callable[[Source], Made]) -> Callable[[Source], Made]:
    """``make`` with its results cached by weak reference to the source."""
    kept: weakref.WeakKeyDictionary[Source, Made] = weakref.WeakKeyDictionary()

    @functools.wraps(make)
    def get(source: Source) -> Made:
        found = kept.get(source)
        if found is None:
            found = kept[source] = make(source)
        return found

    return get
