"""Edits of a scenario, as a discriminated union on ``op``.

Every operation names objects by id, never carries them, and has an inverse.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, TypeAdapter, field_validator

from .base import Identifier, Metres, Model, Pose, Track, Vector3

Frame = Literal["world", "object"]


class Translate(Model):
    """Shift the whole trajectory of an object."""

    op: Literal["translate"] = "translate"
    object_id: Identifier
    x: Metres = 0.0
    y: Metres = 0.0
    z: Metres = 0.0
    frame: Frame = Field(default="world", description="axes of x, y, z; 'object' turns with it")


class Rotate(Model):
    """Turn an object about its own centre, at every time stamp of its trajectory."""

    op: Literal["rotate"] = "rotate"
    object_id: Identifier
    angle: Annotated[float, Field(ge=-1e4, le=1e4)] = Field(description="[rad]")
    axis: Vector3 = Field(default=(0.0, 0.0, 1.0), description="of any length above 0")
    frame: Frame = Field(default="world", description="frame of the axis")

    @field_validator("axis")
    @classmethod
    def _axis_is_not_zero(cls, axis: Vector3) -> Vector3:
        if sum(a * a for a in axis) < 1e-12:
            raise ValueError(f"axis {axis!r} has no direction; give a vector that is not zero")
        return axis


class Scale(Model):
    """Multiply an object's size and Gaussians along its own axes."""

    op: Literal["scale"] = "scale"
    object_id: Identifier
    x: Annotated[float, Field(ge=0.01, le=100.0)] = 1.0
    y: Annotated[float, Field(ge=0.01, le=100.0)] = 1.0
    z: Annotated[float, Field(ge=0.01, le=100.0)] = 1.0
    anchor: Literal["bottom", "centre"] = Field(
        default="bottom",
        description="what stays: the centre of the box's bottom, or of the box",
    )


class SetPose(Model):
    """Place an object; it stands there for the whole time range of the scene."""

    op: Literal["set_pose"] = "set_pose"
    object_id: Identifier
    pose: Pose


class SetTrajectory(Model):
    """Replace an object's trajectory; the object exists only within its time stamps."""

    op: Literal["set_trajectory"] = "set_trajectory"
    object_id: Identifier
    trajectory: Track


class Duplicate(Model):
    """Add a copy of an object, shifted by x, y, z."""

    op: Literal["duplicate"] = "duplicate"
    object_id: Identifier
    new_id: Identifier | None = Field(default=None, description="default: <object_id>_copy<n>")
    x: Metres = 0.0
    y: Metres = 0.0
    z: Metres = 0.0
    frame: Frame = "world"


class Delete(Model):
    """Remove an object. Its id stays reserved, so that `restore` can bring it back."""

    op: Literal["delete"] = "delete"
    object_id: Identifier


class Restore(Model):
    """Bring a deleted object back as it was."""

    op: Literal["restore"] = "restore"
    object_id: Identifier


Operation = Annotated[
    Translate | Rotate | Scale | SetPose | SetTrajectory | Duplicate | Delete | Restore,
    Field(discriminator="op"),
]

OPERATION: TypeAdapter[Operation] = TypeAdapter(Operation)
OPERATIONS: TypeAdapter[list[Operation]] = TypeAdapter(list[Operation])
