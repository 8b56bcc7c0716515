"""REST models of the asset library: objects to insert into scenarios."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

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


class AssetUpload(Model):
    """Fields of `POST /v1/assets` as a form, beside the part `file`."""

    asset_id: Identifier | None = Field(default=None, description="default: the file's name")
    category: Category = "car"
    up_axis: UpAxis = Field(default="-y", description="which axis of the file points up")
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
    size: tuple[float, float, float] = Field(description="length, width, height [m]")
    gaussians: int
    bytes: int
    content_hash: str
    ambient: tuple[float, float, float] | None = Field(
        default=None, description="mean colour of where it was seen; None where that is unknown"
    )
    provenance: dict[str, Any] = Field(default_factory=dict)


class AssetList(Reply):
    """The asset library, in the order of ids."""

    assets: list[AssetInfo]
