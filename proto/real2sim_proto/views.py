"""Pictures of a scene from anywhere: `POST /v1/scenes/{scene}/render`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from .base import Codec, Identifier, Microseconds, Modality, Model, Pose
from .cameras import CameraEffects, LensSpec, PinholeLens
from .episode import MAX_SENSORS

MAX_POSED = 4096

SHORTEST_FOCAL = 0.1
"""[px]."""

Pixels = Annotated[float, Field(ge=-1e6, le=1e6)]
Row = tuple[Pixels, Pixels, Pixels]


def _intrinsics(K: tuple[Row, Row, Row]) -> tuple[Row, Row, Row]:
    (fx, skew, _), (below, fy, _), last = K
    if min(fx, fy) < SHORTEST_FOCAL or skew != 0 or below != 0 or last != (0.0, 0.0, 1.0):
        raise ValueError(
            f"K {K!r} is not that of a pinhole camera: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], "
            f"fx and fy {SHORTEST_FOCAL} pixels or more"
        )
    return K


class FreeCamera(Model):
    """A camera somewhere in the world."""

    name: Identifier = Field(description="of its frames")
    width: int = Field(ge=16, le=8192, description="[px]")
    height: int = Field(ge=16, le=8192, description="[px]")
    K: Annotated[tuple[Row, Row, Row], AfterValidator(_intrinsics)] = Field(
        description="3x3 intrinsics [px]; pixel centres lie at +0.5"
    )
    lens: LensSpec = PinholeLens()
    pose: Pose = Field(description="T_world_camera; x right, y down, z forward")
    modalities: list[Modality] = Field(default=["rgb"], min_length=1, max_length=6)
    codec: Codec = Field(default="raw", description="of rgb; all else is raw or png")
    quality: int = Field(default=90, ge=1, le=100, description="of jpeg")
    effects: CameraEffects | None = Field(
        default=None, description="what a real camera does to its colour images; default: nothing"
    )


class PosedObject(Model):
    """Where an object is in one picture."""

    object_id: Identifier
    pose: Pose = Field(description="T_world_object; its origin is the box centre")


class SceneView(Model):
    """Body of `POST /v1/scenes/{scene}/render`: one instant, from cameras anywhere."""

    t_us: Microseconds | None = Field(
        default=None, description="where objects are that are not posed; default: the start"
    )
    cameras: list[FreeCamera] = Field(min_length=1, max_length=MAX_SENSORS)
    objects: list[PosedObject] = Field(default_factory=list, max_length=MAX_POSED)
    others: Literal["recorded", "parked", "none"] = Field(
        default="recorded",
        description="objects that are not posed: as recorded at `t_us`; of these, only those whose "
        "recording leads nowhere; or none",
    )

    @model_validator(mode="after")
    def _names_differ(self) -> SceneView:
        for what, names in (
            ("cameras", [camera.name for camera in self.cameras]),
            ("objects", [posed.object_id for posed in self.objects]),
        ):
            if len(set(names)) != len(names):
                raise ValueError(f"{what} name one twice: {names[:8]}")
        return self


__all__ = ["FreeCamera", "PosedObject", "SceneView"]
