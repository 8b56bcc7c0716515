"""What cameras are beyond their K: lens, shutter and what becomes of their images."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Annotated, Literal

from pydantic import Field, model_validator

from .base import Model

ShutterDirection = Literal[
    "global", "top_to_bottom", "bottom_to_top", "left_to_right", "right_to_left"
]

Number = Annotated[float, Field(ge=-1e6, le=1e6)]
Angle = Annotated[float, Field(gt=0, le=math.pi)]


class PinholeLens(Model):
    """No distortion."""

    model: Literal["pinhole"] = "pinhole"


class BrownConradyLens(Model):
    """OpenCV's rational model; refused where the image reaches beyond where it folds."""

    model: Literal["brown_conrady"] = "brown_conrady"
    radial: tuple[Number, Number, Number, Number, Number, Number] = Field(
        default=(0.0,) * 6, description="k1 to k6"
    )
    tangential: tuple[Number, Number] = Field(default=(0.0,) * 2, description="p1, p2")
    thin_prism: tuple[Number, Number, Number, Number] = Field(
        default=(0.0,) * 4, description="s1 to s4"
    )


class FisheyeLens(Model):
    """OpenCV's fisheye (Kannala and Brandt)."""

    model: Literal["fisheye"] = "fisheye"
    k: tuple[Number, Number, Number, Number] = Field(default=(0.0,) * 4, description="k1 to k4")
    max_angle: Angle | None = Field(
        default=None,
        description="from the axis, beyond which nothing is seen [rad]; null: as far as it maps",
    )


class OmnidirectionalLens(Model):
    """OpenCV's omnidirectional model (Mei and Rives)."""

    model: Literal["omnidirectional"] = "omnidirectional"
    xi: float = Field(default=1.0, ge=0, le=100)
    k: tuple[Number, Number] = Field(default=(0.0,) * 2, description="k1, k2")
    p: tuple[Number, Number] = Field(default=(0.0,) * 2, description="p1, p2")


class FThetaLens(Model):
    """NVIDIA's f-theta model; radii in focal lengths of K: a polynomial in pixels is divided by
    fx (or, taking radii, its coefficient of power n multiplied by fx^n)."""

    model: Literal["f_theta"] = "f_theta"
    polynomial: list[Number] = Field(
        default=[0.0, 1.0], min_length=2, max_length=6, description="from the constant (0) on"
    )
    reference: Literal["angle", "radius"] = Field(
        default="angle", description="what the polynomial takes"
    )
    linear: tuple[Number, Number, Number] = Field(default=(1.0, 0.0, 0.0), description="c, d, e")
    max_angle: Angle = Field(default=math.pi, description="[rad]")


LensSpec = Annotated[
    PinholeLens | BrownConradyLens | FisheyeLens | OmnidirectionalLens | FThetaLens,
    Field(discriminator="model"),
]


class ShutterSpec(Model):
    """How an image is read out. Its instant is the middle of the read-out."""

    direction: ShutterDirection = "global"
    readout_us: int = Field(
        default=0, ge=0, le=200_000, description="first to last line; 0 where global"
    )


Pixels = Annotated[float, Field(ge=-1e6, le=1e6)]
Row = tuple[Pixels, Pixels, Pixels]


class OpticsSpec(Model):
    """A device of one's own in the place of a recorded camera."""

    K: tuple[Row, Row, Row] | None = Field(
        default=None, description="3x3 at the recorded size [px]; default: the camera's own"
    )
    lens: LensSpec = PinholeLens()
    shutter: ShutterSpec = ShutterSpec()


Optics = Literal["pinhole", "recorded"] | OpticsSpec

Gain = Annotated[float, Field(ge=0.05, le=20)]


class NoiseSpec(Model):
    """Noise of a sensor in linear light, where white is 1: of variance
    `photon` x signal + `read`^2; the same for the same seed, camera and instant."""

    photon: float = Field(default=0.0, ge=0, le=0.1)
    read: float = Field(default=0.0, ge=0, le=0.5)
    seed: int = Field(default=0, ge=0, lt=2**63)


class MotionBlurSpec(Model):
    """The mean light of several images within an exposure, each drawn: `samples` times the work."""

    exposure_us: int = Field(ge=1, le=200_000)
    samples: int = Field(default=5, ge=2, le=16)


class CameraEffects(Model):
    """What a real camera does to its colour images, each off unless given; in this order."""

    motion_blur: MotionBlurSpec | None = None
    vignetting: tuple[float, float, float] | None = Field(
        default=None,
        description="a, b, c: light falls by 1 + a r^2 + b r^4 + c r^6, at least 0, r from the "
        "middle of the image over half its diagonal",
    )
    exposure_ev: float = Field(default=0.0, ge=-10, le=10, description="light times 2^ev")
    white_balance: tuple[Gain, Gain, Gain] | None = Field(
        default=None, description="gains of red, green and blue light"
    )
    noise: NoiseSpec | None = None
    tone_curve: list[Annotated[float, Field(ge=0, le=1)]] | None = Field(
        default=None,
        min_length=2,
        max_length=64,
        description="display values for evenly spaced ones from 0 to 1; never falling",
    )
    jpeg_quality: int | None = Field(
        default=None, ge=1, le=100, description="of the camera's own compression"
    )

    @model_validator(mode="after")
    def _fits(self) -> CameraEffects:
        curve = self.tone_curve
        if curve is not None and any(b < a for a, b in pairwise(curve)):
            raise ValueError(f"tone_curve {curve!r} falls somewhere")
        if self.vignetting is not None and max(map(abs, self.vignetting)) > 10:
            raise ValueError(f"vignetting {self.vignetting!r} has numbers beyond 10")
        return self

    @property
    def names(self) -> list[str]:
        """Those that are on, in their order."""
        return [name for name in type(self).model_fields if getattr(self, name) not in (None, 0.0)]


def is_plain(optics: Optics, effects: CameraEffects | None) -> bool:
    """Whether images are those of a pinhole, as they are drawn."""
    return optics == "pinhole" and effects is None
