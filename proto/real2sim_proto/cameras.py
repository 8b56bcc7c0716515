"""What cameras are beyond their K: lens, shutter and what becomes of their images."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import Field

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


def lens_json(lens: LensSpec | None) -> dict[str, Any] | None:
    """JSON values of a lens; None for a pinhole."""
    if lens is None or lens.model == "pinhole":
        return None
    return lens.model_dump(mode="json")
