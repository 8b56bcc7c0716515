"""REST models of the asset library: objects to insert into scenarios."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, WithJsonSchema

from .base import Identifier, Model
from .scenes import Reply

UpAxis = Literal["z", "y", "-y"]

Category = Annotated[str, Field(pattern=r"^[A-Za-z0-9_\-]{1,40}$")]


class AssetCut(Model):
    """Body of `POST /v1/assets` as JSON: an object cut out of a scene."""

    scene: Identifier
    object_id: Identifier
    asset_id: Identifier | None = Field(default=None, description="default: the object's id")
    category: Category | None = Field(default=None, description="default: the object's")


Build = Literal[
    "woman", "man", "short_woman", "tall_woman", "tall_man", "slim_woman", "slim_man",
    "heavy_woman", "heavy_man", "strong_man", "old_woman", "old_man",
    "girl", "boy", "small_girl", "small_boy",
]  # fmt: skip
_NUMBERS: dict[str, Any] = {"type": "array", "minItems": 3, "maxItems": 3}
Triple = Annotated[
    tuple[float, float, float], WithJsonSchema(_NUMBERS | {"items": {"type": "number"}})
]
"""Told as a list of fixed length, since programs that check answers do not all know tuples."""
Share = Annotated[float, Field(ge=0, le=1)]
Colour = Annotated[
    tuple[Share, Share, Share],
    WithJsonSchema(_NUMBERS | {"items": {"type": "number", "minimum": 0, "maximum": 1}}),
]


class AssetPerson(Model):
    """Body of `POST /v1/assets` as JSON: a person who walks wherever a trajectory leads."""

    asset_id: Identifier
    build: Build
    height: float | None = Field(
        default=None, gt=0.4, lt=2.6, description="of the person; default: of the build [m]"
    )
    clothes: dict[
        Literal["skin", "hair", "top", "trousers", "shoes"],
        Colour,
    ] = Field(default_factory=dict, description="colours, RGB in [0, 1], where they matter")
    worn: list[Literal["long_hair", "skirt"]] = Field(default_factory=list, max_length=2)


class AssetUpload(Model):
    """Fields of `POST /v1/assets` as a form, beside the part `file`."""

    asset_id: Identifier | None = Field(default=None, description="default: the file's name")
    category: Category = "car"
    up_axis: UpAxis | None = Field(
        default=None,
        description="which axis of the file points up; default: what the file says (y for spz; an "
        "exported ply has it in its header), else -y",
    )
    yaw: float = Field(
        default=0.0, ge=-6.3, le=6.3, description="turn about z after that [rad]: front to x"
    )
    length: float | None = Field(
        default=None, gt=0, le=100, description="real length along x [m]; default: by category"
    )


class AssetInfo(Reply):
    """An asset: Gaussians in a frame with x forward, z up, origin at the box centre."""

    asset_id: str
    category: str
    size: Triple = Field(description="length, width, height [m]")
    gaussians: int
    bytes: int
    content_hash: str
    ambient: Triple | None = Field(
        default=None, description="mean colour of where it was seen; None where that is unknown"
    )
    provenance: dict[str, Any] = Field(default_factory=dict)


class AssetList(Reply):
    """The asset library, in the order of ids."""

    assets: list[AssetInfo]
