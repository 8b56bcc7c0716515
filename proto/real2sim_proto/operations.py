"""Edits of a scenario, as a discriminated union on ``op``.

Every operation refers to its target by id, contains no asset data, and has an inverse. Ids of
objects, erased regions and colliders share one name space.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, TypeAdapter, field_validator, model_validator

from .base import Identifier, Metres, Microseconds, Model, Pose, Quaternion, Track, Vector3
from .episode import AgentDriver, IdmDriver
from .storyboard import Storyboard

Frame = Literal["world", "object"]

DRAWN_PREFIX = "spawned:"
"""Prefix of the ids of road users created by `agents.spawn`."""


def _not_drawn(object_id: Any) -> Any:
    if isinstance(object_id, str) and object_id.startswith(DRAWN_PREFIX):
        raise ValueError(
            f"{object_id!r} was created by agents.spawn and cannot be edited; edits take objects "
            "of the scene and objects added by edits, for example 'spawned_1'"
        )
    return object_id


ObjectId = Annotated[Identifier, BeforeValidator(_not_drawn)]
"""Id of an editable object."""

MaterialName = Literal["rigid", "metal", "foam", "rubber", "jelly", "sand", "snow"]
"""Materials of an object; the physics defines their parameters."""

Size3 = tuple[
    Annotated[float, Field(gt=0, le=1000.0)],
    Annotated[float, Field(gt=0, le=1000.0)],
    Annotated[float, Field(gt=0, le=1000.0)],
]
Length = Annotated[float, Field(ge=1e-4, le=1000.0)]
Friction = Annotated[float, Field(ge=0, le=10.0)]
Speed = Annotated[float, Field(ge=-200.0, le=200.0)]
Vector3Speed = tuple[Speed, Speed, Speed]

Snap = Annotated[
    bool,
    Field(description="put the bottom of the box on the ground at every pose"),
]


class TimeRange(Model):
    """Time range of an edit: it grows smoothly from 0 at `start_us` to its full amount `blend_us`
    later, and decreases to 0 at `end_us` in the same way."""

    start_us: Microseconds | None = Field(default=None, description="default: from the beginning")
    end_us: Microseconds | None = Field(default=None, description="default: to the end")
    blend_us: int = Field(default=500_000, ge=0, le=60_000_000)

    @model_validator(mode="after")
    def _starts_before_it_ends(self) -> TimeRange:
        if self.start_us is not None and self.end_us is not None and self.start_us >= self.end_us:
            raise ValueError(
                f"start_us {self.start_us} is not before end_us {self.end_us}; an edit needs time"
            )
        return self


class Translate(Model):
    """Shift an object: the whole trajectory, or a time range of it with smooth ends."""

    op: Literal["translate"] = "translate"
    object_id: ObjectId
    x: Metres = 0.0
    y: Metres = 0.0
    z: Metres = 0.0
    frame: Frame = Field(
        default="world", description="frame of x, y, z; 'object' turns with the object"
    )
    time_range: TimeRange | None = Field(default=None, description="default: at all times")
    snap: Snap = False


class Rotate(Model):
    """Rotate an object, at all times or in a time range with smooth ends. By default it rotates in
    place at each of its poses, so a moving object drives sideways; `about_us` rotates its path."""

    op: Literal["rotate"] = "rotate"
    object_id: ObjectId
    angle: Annotated[float, Field(ge=-1e4, le=1e4)] = Field(description="[rad]")
    axis: Vector3 = Field(default=(0.0, 0.0, 1.0), description="axis of any length above 0")
    frame: Frame = Field(default="world", description="frame of the axis")
    time_range: TimeRange | None = Field(default=None, description="default: at all times")
    about_us: Microseconds | None = Field(
        default=None,
        description=(
            "also rotates its path, about its position at this time; a time range should "
            "begin or end there"
        ),
    )
    snap: Snap = False

    @field_validator("axis")
    @classmethod
    def _axis_is_not_zero(cls, axis: Vector3) -> Vector3:
        return _direction(axis, "axis")


class Scale(Model):
    """Multiply an object's size and Gaussians along its own axes."""

    op: Literal["scale"] = "scale"
    object_id: ObjectId
    x: Annotated[float, Field(ge=0.01, le=100.0)] = 1.0
    y: Annotated[float, Field(ge=0.01, le=100.0)] = 1.0
    z: Annotated[float, Field(ge=0.01, le=100.0)] = 1.0
    anchor: Literal["bottom", "centre"] = Field(
        default="bottom",
        description="fixed point: the centre of the box's bottom, or of the box",
    )


class SetPose(Model):
    """Place an object at a fixed pose for the whole time range of the scene."""

    op: Literal["set_pose"] = "set_pose"
    object_id: ObjectId
    pose: Pose
    snap: Snap = False


class SetTrajectory(Model):
    """Replace an object's trajectory; the object exists only within its time stamps."""

    op: Literal["set_trajectory"] = "set_trajectory"
    object_id: ObjectId
    trajectory: Track
    snap: Snap = False


class Retime(Model):
    """Delay or advance an object's motion, or change its speed."""

    op: Literal["retime"] = "retime"
    object_id: ObjectId
    delay_us: Microseconds = Field(default=0, description="delay; negative: earlier")
    speed: Annotated[float, Field(ge=0.01, le=100.0)] = Field(
        default=1.0, description="2 halves the time, from its first pose on"
    )


class Duplicate(Model):
    """Add a copy of an object, shifted by x, y, z."""

    op: Literal["duplicate"] = "duplicate"
    object_id: ObjectId
    new_id: Identifier | None = Field(default=None, description="default: <object_id>_copy<n>")
    x: Metres = 0.0
    y: Metres = 0.0
    z: Metres = 0.0
    frame: Frame = "world"
    snap: Snap = False


class Delete(Model):
    """Remove an object, erased region or collider. Its id is reserved for `restore`."""

    op: Literal["delete"] = "delete"
    object_id: ObjectId


class Restore(Model):
    """Restore a deleted object, erased region or collider."""

    op: Literal["restore"] = "restore"
    object_id: ObjectId


class Insert(Model):
    """Add an object from the asset library, at a pose or on a trajectory."""

    op: Literal["insert"] = "insert"
    asset_id: Identifier
    object_id: Identifier | None = Field(
        default=None, description="id of the new object; default: <asset_id>_<n>"
    )
    pose: Pose | None = Field(
        default=None, description="pose of the box centre; or give `trajectory`"
    )
    trajectory: Track | None = None
    size: Size3 | None = Field(default=None, description="box to fit [m]; default: its own size")
    snap: Snap = True

    @model_validator(mode="after")
    def _is_somewhere(self) -> Insert:
        if (self.pose is None) == (self.trajectory is None):
            raise ValueError("an insert needs either a pose or a trajectory, not both")
        return self


class RoutePlace(Model):
    """A position relative to the ego's route, in a running session."""

    ahead: Annotated[float, Field(ge=-500, le=500)] = Field(
        description="distance ahead of the ego's rear axle along the route [m]"
    )
    offset: Annotated[float, Field(ge=-50, le=50)] = Field(
        default=0.0, description="lateral offset from the route, positive to the left [m]"
    )
    oncoming: bool = Field(default=False, description="faces against the route")


class Spawn(Model):
    """Add a driven road user, with the appearance of an asset or of an object of the scene.

    Its own track is straight at `speed`; `driver` moves it in sessions. `delete` removes it.
    """

    op: Literal["spawn"] = "spawn"
    object_id: Identifier | None = Field(default=None, description="default: spawned_<n>")
    asset_id: Identifier | None = Field(default=None, description="from the asset library")
    recorded_id: Identifier | None = Field(
        default=None,
        description="instead of an asset: copy the appearance of this object of the scene",
    )
    pose: Pose | None = Field(
        default=None, description="pose of the box centre, world; or give `place`"
    )
    place: RoutePlace | None = Field(
        default=None,
        description="position relative to the ego's route, instead of `pose`; in sessions only",
    )
    speed: Annotated[float, Field(ge=0, le=100)] = Field(
        default=0.0, description="initial speed along its heading [m/s]"
    )
    start_us: Microseconds | None = Field(
        default=None,
        description="time of appearance; default: now in a session, otherwise the start",
    )
    driver: AgentDriver = Field(
        default=IdmDriver(path="route"),
        description="driver in sessions; `agents.drivers` of a reset overrides it",
    )
    snap: Snap = True

    @model_validator(mode="after")
    def _names_one_look_and_place(self) -> Spawn:
        if (self.asset_id is None) == (self.recorded_id is None):
            raise ValueError("a spawn needs either asset_id or recorded_id, not both")
        if (self.pose is None) == (self.place is None):
            raise ValueError("a spawn needs either a pose or a place, not both")
        return self


class Replace(Model):
    """Replace an object's appearance with an asset's or a recorded object's, fitted to its box."""

    op: Literal["replace"] = "replace"
    object_id: ObjectId
    asset_id: Identifier | None = Field(default=None, description="from the asset library")
    recorded_id: Identifier | None = Field(
        default=None,
        description="instead of an asset: copy the appearance of this object of the scene",
    )
    fit: Literal["box", "length"] = Field(
        default="box",
        description=(
            "'box' fills the box along each axis; 'length' keeps the proportions of the new "
            "appearance"
        ),
    )
    size: Size3 | None = Field(
        default=None, description="box to fill [m]; default: the present size"
    )

    @model_validator(mode="after")
    def _names_one_look(self) -> Replace:
        if (self.asset_id is None) == (self.recorded_id is None):
            raise ValueError("a replace needs either asset_id or recorded_id, not both")
        return self


class EraseRegion(Model):
    """Hide the Gaussians of the background with centres in a box."""

    op: Literal["erase_region"] = "erase_region"
    region_id: Identifier | None = Field(default=None, description="default: region_<n>")
    pose: Pose = Field(description="pose of the box centre")
    size: Size3 = Field(description="[m]")


YIELDING: tuple[MaterialName, ...] = ("metal", "foam")
"""Materials that have a yield stress."""


class PhysicsValues(Model):
    """Physical properties of an object; omitted ones have defaults.

    `young`, `poisson`, `density` or `yield_stress` make it a body of one `material`, with these
    values instead of the material's, rather than the default structure of its category.
    """

    mass: Annotated[float, Field(gt=0, le=1e7)] | None = Field(
        default=None, description="[kg]; default: by category and size, or by density"
    )
    material: MaterialName | None = Field(
        default=None,
        description=(
            "default: by category; jelly if material values are given, metal if they "
            "include a yield stress"
        ),
    )
    young: Annotated[float, Field(gt=0, le=1e12)] | None = Field(
        default=None, description="Young's modulus E [Pa]"
    )
    poisson: Annotated[float, Field(gt=-1, lt=0.5)] | None = Field(
        default=None, description="Poisson's ratio nu; 0.5 would be incompressible, take 0.45"
    )
    density: Annotated[float, Field(ge=1, le=3e4)] | None = Field(
        default=None, description="density rho of its filling [kg/m^3]; instead of mass"
    )
    yield_stress: Annotated[float, Field(gt=0, le=1e12)] | None = Field(
        default=None, description="[Pa]; for metal and foam"
    )
    friction: Friction | None = Field(default=None, description="Coulomb coefficient")
    restitution: Annotated[float, Field(ge=0, le=1)] | None = Field(
        default=None, description="fraction of the approach speed that remains after a bounce"
    )
    grid: Annotated[int, Field(ge=16, le=1000)] | None = Field(
        default=None,
        description=(
            "cells along twice its longest edge, as in the paper (50, 200); all simulated "
            "objects share the finest grid requested; default: cells of 0.2 m"
        ),
    )

    @model_validator(mode="after")
    def _fits_together(self) -> PhysicsValues:
        if self.mass is not None and self.density is not None:
            raise ValueError("give mass or density, not both: one follows from the other")
        if self.yield_stress is not None and self.material not in (None, *YIELDING):
            raise ValueError(
                f"material {self.material!r} has no yield_stress; {' and '.join(YIELDING)} have one"
            )
        return self


class SetPhysics(PhysicsValues):
    """Set physical properties of an object. Omitted ones return to their defaults."""

    op: Literal["set_physics"] = "set_physics"
    object_id: ObjectId


class SetVelocity(Model):
    """Initial velocity of an object in the physics; default: that of its trajectory."""

    op: Literal["set_velocity"] = "set_velocity"
    object_id: ObjectId
    linear: Vector3Speed | None = Field(
        default=None, description="velocity of the box centre [m/s]"
    )
    angular: Vector3Speed | None = Field(default=None, description="[rad/s]")
    frame: Frame = Field(default="world", description="frame of both; 'object' has x forward")


class SetGait(Model):
    """Gait of a person; omitted values return to those of the asset."""

    op: Literal["set_gait"] = "set_gait"
    object_id: ObjectId
    stride: float | None = Field(
        default=None, ge=0.5, le=1.6, description="factor on the stride length"
    )
    arms: float | None = Field(default=None, ge=0, le=3, description="factor on the arm swing")
    lean: float | None = Field(
        default=None, ge=-0.3, le=0.6, description="additional forward lean [rad]"
    )
    width: float | None = Field(default=None, ge=0.2, le=3, description="factor on the step width")
    phase: int | None = Field(
        default=None,
        ge=0,
        le=1,
        description="phase of the gait cycle; 1 starts with the other foot",
    )


class PlaneShape(Model):
    """A half-space; objects stay on the side of its normal."""

    kind: Literal["plane"] = "plane"
    point: Vector3 = Field(description="point on the plane [m]")
    normal: Vector3 = (0.0, 0.0, 1.0)

    @field_validator("normal")
    @classmethod
    def _normal_is_not_zero(cls, normal: Vector3) -> Vector3:
        return _direction(normal, "normal")


class BoxShape(Model):
    """A rigid box."""

    kind: Literal["box"] = "box"
    position: Vector3 = Field(description="centre [m]")
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
    size: Size3 = Field(description="[m]")


class CylinderShape(Model):
    """A rigid post or drum with flat ends; its axis is the z axis of its pose."""

    kind: Literal["cylinder"] = "cylinder"
    position: Vector3 = Field(description="centre [m]")
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
    radius: Length = Field(description="[m]")
    height: Length = Field(description="length along its axis [m]")


class CapsuleShape(Model):
    """A capsule: all points within a radius of a line along the z axis of its pose; with length 0 a
    ball."""

    kind: Literal["capsule"] = "capsule"
    position: Vector3 = Field(description="centre of the line [m]")
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
    radius: Length = Field(description="[m]")
    length: Annotated[float, Field(ge=0, le=1000.0)] = Field(
        default=0.0, description="length of the line, without the round ends [m]"
    )


VertexIndex = Annotated[int, Field(ge=0, lt=4096)]


class MeshShape(Model):
    """A closed triangle mesh, or a sheet of triangles with a thickness."""

    kind: Literal["mesh"] = "mesh"
    position: Vector3 = Field(default=(0.0, 0.0, 0.0), description="position of its origin [m]")
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
    vertices: list[Vector3] = Field(
        min_length=3, max_length=4096, description="vertices in its frame [m]"
    )
    triangles: list[tuple[VertexIndex, VertexIndex, VertexIndex]] = Field(
        min_length=1,
        max_length=8192,
        description="indices of vertices, counter-clockwise seen from outside",
    )
    thickness: Length | None = Field(
        default=None, description="thickness of an open sheet [m]; leave out for a closed mesh"
    )


class GroundShape(Model):
    """The recorded ground, with a vertical offset."""

    kind: Literal["ground"] = "ground"
    offset: Metres = Field(default=0.0, description="[m]")


ColliderShape = Annotated[
    PlaneShape | BoxShape | CylinderShape | CapsuleShape | MeshShape | GroundShape,
    Field(discriminator="kind"),
]


class AddCollider(Model):
    """Add an invisible rigid collider, for the physics."""

    op: Literal["add_collider"] = "add_collider"
    collider_id: Identifier | None = Field(default=None, description="default: collider_<n>")
    shape: ColliderShape
    friction: Friction | None = Field(
        default=None, description="default: the value of the touching body"
    )


class SetTime(Model):
    """Time span of the scenario: of previews, physics and exports."""

    op: Literal["set_time"] = "set_time"
    start_us: Microseconds | None = Field(default=None, description="default: the recording's")
    end_us: Microseconds | None = Field(default=None, description="default: the recording's")

    @model_validator(mode="after")
    def _starts_before_it_ends(self) -> SetTime:
        if self.start_us is not None and self.end_us is not None and self.start_us >= self.end_us:
            raise ValueError(f"start_us {self.start_us} is not before end_us {self.end_us}")
        return self


class SetStoryboard(Model):
    """Set the storyboard of the scenario's sessions; a reset may replace it."""

    op: Literal["set_storyboard"] = "set_storyboard"
    storyboard: Storyboard | None = Field(default=None, description="default: none")


def _direction(vector: Vector3, name: str) -> Vector3:
    if sum(a * a for a in vector) < 1e-12:
        raise ValueError(f"{name} {vector!r} has no direction; give a vector that is not zero")
    return vector


Operation = Annotated[
    Translate
    | Rotate
    | Scale
    | SetPose
    | SetTrajectory
    | Retime
    | Duplicate
    | Delete
    | Restore
    | Insert
    | Spawn
    | Replace
    | EraseRegion
    | SetPhysics
    | SetVelocity
    | SetGait
    | AddCollider
    | SetTime
    | SetStoryboard,
    Field(discriminator="op"),
]

OPERATION: TypeAdapter[Operation] = TypeAdapter(Operation)
OPERATIONS: TypeAdapter[list[Operation]] = TypeAdapter(list[Operation])


def subject_of(operation: Operation) -> str | None:
    """Id in an operation: object, region or collider; None if the worker chooses it."""
    for field in ("object_id", "region_id", "collider_id"):
        if field in type(operation).model_fields:
            subject: str | None = getattr(operation, field)
            return subject
    return None
