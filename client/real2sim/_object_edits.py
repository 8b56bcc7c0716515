"""The edits of a scenario and of its objects.

``R`` is the return type of an edit: ``OperationResult``, or its awaitable in the async client.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.base import Pose, Track
from real2sim_proto.operations import (
    AddCollider,
    BoxShape,
    CapsuleShape,
    ColliderShape,
    CylinderShape,
    Delete,
    Duplicate,
    EraseRegion,
    GroundShape,
    Insert,
    MeshShape,
    Operation,
    PlaneShape,
    Replace,
    Restore,
    Retime,
    Rotate,
    Scale,
    SetGait,
    SetPhysics,
    SetPose,
    SetStoryboard,
    SetTime,
    SetTrajectory,
    SetVelocity,
    TimeRange,
    Translate,
)
from real2sim_proto.scenes import ObjectInfo
from real2sim_proto.storyboard import Storyboard

from ._calls import checked, instant_us
from ._handles import Handle, ScenarioState
from ._session_state import pose_between, pose_matrix, quaternion_of

R = TypeVar("R")
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
UPRIGHT: Quaternion = (1.0, 0.0, 0.0, 0.0)
UP: Vector = (0.0, 0.0, 1.0)


class ObjectEdits(Handle, Generic[R]):
    """An object of a scenario; each method is one edit. Metres, radians, microseconds, wxyz."""

    _instead: ClassVar = {
        "box": "object.corners(t), or object.pose(t) and object.size",
        "bounding_box": "object.corners(t), or object.pose(t) and object.size",
        "center": "object.position",
        "category_name": "object.category",
        "destroy": "object.delete()",
        "get_transform": "object.pose(t)",
        "id": "object.object_id",
        "instance_token": "object.object_id",
        "lwh": "object.size (length, width, height)",
        "move": "object.translate(x=1.0)",
        "name": "object.object_id",
        "orientation": "object.pose(t).quaternion",
        "quaternion": "object.pose(t).quaternion",
        "remove": "object.delete()",
        "rotation": "object.pose(t).quaternion",
        "set_position": "object.set_pose((x, y, z))",
        "set_transform": "object.set_pose((x, y, z))",
        "trajectory": "object.info.trajectory",
        "velocity": "object.info.velocity, object.set_velocity(linear=(x, y, z))",
        "wlh": "object.size (length, width, height)",
    }

    def __init__(self, scenario: ScenarioState, info: ObjectInfo) -> None:
        self._scenario = scenario
        self._info = info

    @property
    def info(self) -> ObjectInfo:
        """The object after the newest edit; for a deleted object, its last state."""
        for known in self._scenario.info.objects:
            if known.object_id == self._info.object_id:
                self._info = known
        return self._info

    @property
    def object_id(self) -> str:
        """Id of the object in its scenario."""
        return self._info.object_id

    @property
    def category(self) -> str:
        """Category, such as ``car``."""
        return self.info.category

    @property
    def size(self) -> tuple[float, float, float]:
        """Length, width and height of its box [m]."""
        return self.info.size

    @property
    def position(self) -> NDArray[np.float64]:
        """[3] float64 centre of its box in the world when it appears [m]."""
        return np.array(self._track.positions[0])

    @property
    def yaw(self) -> float:
        """Heading in the world when it appears [rad]."""
        w, x, y, z = self._track.quaternions[0]
        return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))

    @property
    def _track(self) -> Track:
        track = self.info.trajectory
        if track is None:
            raise ValueError(f"the trajectory of {self.object_id!r} is not loaded; call refresh()")
        return track

    def pose(self, t: float | None = None, *, t_us: int | None = None) -> Pose:
        """Pose of its box: positions are interpolated linearly, rotations along the shortest arc.

        Args:
            t, t_us: instant in seconds or in microseconds; default: when it appears.

        Returns:
            ``position`` of the centre of its box in the world [m] and ``quaternion`` (wxyz).

        Raises:
            ValueError: the object does not exist at that instant.

        Examples:
            >>> scenario.objects["car_blue"].pose(1.0).position
            (18.0, 0.0, 0.75)
        """
        info, track = self.info, self._track
        times = track.times_us
        instant = instant_us(t, t_us)
        instant = times[0] if instant is None else instant
        if not min(info.start_us, times[0]) <= instant <= max(info.end_us, times[-1]):
            raise ValueError(
                f"{self.object_id!r} is there from {info.start_us / 1e6:g} to "
                f"{info.end_us / 1e6:g} s, not at {instant / 1e6:g} s; give seconds as t=1.5 or "
                "microseconds as t_us=1_500_000"
            )
        after = min(bisect.bisect_right(times, instant), len(times) - 1)
        before = max(after - 1, 0)
        fraction = (instant - times[before]) / max(times[after] - times[before], 1)
        first, last = (
            pose_matrix(track.positions[k], track.quaternions[k]) for k in (before, after)
        )
        mixed = pose_between(first, last, min(max(fraction, 0.0), 1.0))
        return Pose(position=tuple(mixed[:3, 3].tolist()), quaternion=quaternion_of(mixed[:3, :3]))

    def corners(self, t: float | None = None, *, t_us: int | None = None) -> NDArray[np.float64]:
        """[8, 3] float64 corners of its box in the world [m]: four front, then four rear, each
        clockwise from the upper left as seen from behind. Times as in :meth:`pose`.

        Examples:
            >>> scenario.objects["post"].corners().shape
            (8, 3)
        """
        pose = self.pose(t, t_us=t_us)
        signs = [(x, y, z) for x in (1, -1) for y, z in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
        T_world_object = pose_matrix(pose.position, pose.quaternion)
        placed: NDArray[np.float64] = (np.array(signs) * self.size / 2) @ T_world_object[:3, :3].T
        return placed + T_world_object[:3, 3]

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.object_id!r}, category={self.category!r})"

    def translate(
        self,
        x: float = 0.0,
        y: float = 0.0,
        z: float = 0.0,
        *,
        frame: str = "world",
        start_us: int | None = None,
        end_us: int | None = None,
        blend_us: int | None = None,
        snap: bool = False,
    ) -> R:
        """Shift the object [m].

        Args:
            x, y, z: distance along the axes of ``frame``.
            frame: ``world``, or ``object``, which rotates with the object.
            start_us, end_us: time range of the edit, with smooth ends; default: all times.
            blend_us: duration of each smooth end; default: half a second.
            snap: place the object on the ground.

        Examples:
            >>> car.translate(x=1.5, frame="object").revision
            1
            >>> car.translate(y=-3.0, start_us=500_000, end_us=1_500_000).revision
            2
        """
        when = _time_range(start_us, end_us, blend_us)
        return self._make(Translate, x=x, y=y, z=z, frame=frame, time_range=when, snap=snap)

    def rotate(
        self,
        angle: float,
        *,
        axis: Vector = UP,
        frame: str = "world",
        start_us: int | None = None,
        end_us: int | None = None,
        blend_us: int | None = None,
        about_us: int | None = None,
    ) -> R:
        """Rotate the object [rad]; times as in :meth:`translate`.

        Args:
            angle: angle [rad].
            axis: rotation axis, of any length.
            frame: frame of the axis, ``world`` or ``object``.
            start_us, end_us, blend_us: as in :meth:`translate`.
            about_us: rotates the path too, about the object's position at this time [us]. By
                default the object rotates in place at each pose; a moving object then drives
                sideways, and ``warnings`` of the result report it.

        Examples:
            >>> result = car.rotate(angle=0.26)
            >>> result = car.rotate(angle=-0.26, about_us=0)
        """
        when = _time_range(start_us, end_us, blend_us)
        return self._make(
            Rotate, angle=angle, axis=axis, frame=frame, time_range=when, about_us=about_us
        )

    def scale(self, *, x: float = 1.0, y: float = 1.0, z: float = 1.0, anchor: str = "bottom") -> R:
        """Multiply the size along the object's axes; ``anchor`` is fixed: ``bottom`` or ``centre``.

        Examples:
            >>> result = car.scale(x=1.5)
            >>> scenario.objects["car_red"].info.size
            (6.0, 1.8, 1.5)
        """
        return self._make(Scale, x=x, y=y, z=z, anchor=anchor)

    def set_pose(
        self, position: Vector, quaternion: Quaternion = UPRIGHT, *, snap: bool = False
    ) -> R:
        """Set the object's pose in the world [m], for the whole time range.

        Examples:
            >>> result = car.set_pose(position=(18.0, 1.0, 0.75))
        """
        pose = checked(Pose, position=position, quaternion=quaternion)
        return self._make(SetPose, pose=pose, snap=snap)

    def set_trajectory(
        self,
        *,
        times_us: Sequence[int],
        positions: Sequence[Vector],
        quaternions: Sequence[Quaternion],
        snap: bool = False,
    ) -> R:
        """Make the object follow a trajectory; it only exists within these times.

        Args:
            times_us: [T] increasing [us].
            positions: [T, 3] centres of its box in the world [m].
            quaternions: [T, 4] wxyz.
            snap: place it on the ground at every pose.

        Examples:
            >>> result = car.set_trajectory(
            ...     times_us=[0, 2_000_000],
            ...     positions=[(14, -3, 0.75), (24, -3, 0.75)],
            ...     quaternions=[(1, 0, 0, 0), (1, 0, 0, 0)],
            ... )
        """
        track = checked(
            Track,
            times_us=list(times_us),
            positions=list(positions),
            quaternions=list(quaternions),
        )
        return self._make(SetTrajectory, trajectory=track, snap=snap)

    def retime(self, *, delay_us: int = 0, speed: float = 1.0) -> R:
        """Delay its motion (or advance it), or change its speed.

        Examples:
            >>> result = scenario.objects["car_blue"].retime(delay_us=300_000, speed=1.2)
        """
        return self._make(Retime, delay_us=delay_us, speed=speed)

    def replace(
        self,
        *,
        asset: str | None = None,
        recorded: str | None = None,
        fit: str = "box",
    ) -> R:
        """Change its appearance.

        Args:
            asset: id in the asset library; or
            recorded: id of an object of the scene.
            fit: ``box`` fills the object's box, ``length`` keeps the look's proportions.

        Raises:
            ValueError: not exactly one of ``asset`` and ``recorded``.

        Examples:
            >>> result = car.replace(recorded="car_blue", fit="length")
        """
        return self._make(Replace, asset_id=asset, recorded_id=recorded, fit=fit)

    def set_physics(
        self,
        *,
        mass: float | None = None,
        material: str | None = None,
        young: float | None = None,
        poisson: float | None = None,
        density: float | None = None,
        yield_stress: float | None = None,
        friction: float | None = None,
        restitution: float | None = None,
        grid: int | None = None,
    ) -> R:
        """Set physical properties; omitted ones return to their defaults.

        Args:
            mass: [kg].
            material: ``rigid``, ``metal``, ``foam``, ``rubber``, ``jelly``, ``sand`` or ``snow``.
            young, poisson: E [Pa] and nu of one material throughout; ``jelly`` if none is named.
            density: density of the filling [kg/m^3]; instead of ``mass``.
            yield_stress: [Pa]; of ``metal`` (the default) or ``foam``.
            friction: Coulomb coefficient.
            restitution: 0 to 1, fraction of the approach speed after a bounce.
            grid: cells along twice its longest edge (the paper's definition).

        Examples:
            >>> result = car.set_physics(material="metal", mass=1200.0, friction=0.6)
            >>> result = car.set_physics(young=2e6, poisson=0.4, density=200.0, grid=50)
        """
        return self._make(
            SetPhysics,
            mass=mass,
            material=material,
            young=young,
            poisson=poisson,
            density=density,
            yield_stress=yield_stress,
            friction=friction,
            restitution=restitution,
            grid=grid,
        )

    def set_velocity(
        self,
        *,
        linear: Vector | None = None,
        angular: Vector | None = None,
        frame: str = "world",
    ) -> R:
        """Set its initial velocity in the physics [m/s, rad/s]; default: that of its trajectory.

        Examples:
            >>> result = car.set_velocity(linear=(8.0, 0.0, 0.0), frame="object")
        """
        return self._make(SetVelocity, linear=linear, angular=angular, frame=frame)

    def set_gait(
        self,
        *,
        stride: float | None = None,
        arms: float | None = None,
        lean: float | None = None,
        width: float | None = None,
        phase: int | None = None,
    ) -> R:
        """Set the gait of a person of the body model; omitted values return to the person's own.

        Args:
            stride: factor on stride length, 0.5 to 1.6.
            arms: factor on arm swing.
            lean: additional forward lean [rad].
            width: factor on the lateral distance between the feet.
            phase: 1 starts with the other foot.

        Raises:
            InvalidOperationError: the object is not a walking person.

        Examples:
            >>> info = client.assets.person("tom", build="man")
            >>> tom = scenario.insert("tom", position=(12.0, 2.0, 0.0))
            >>> result = tom.set_gait(stride=0.8, lean=0.15)
        """
        return self._make(SetGait, stride=stride, arms=arms, lean=lean, width=width, phase=phase)

    def delete(self) -> R:
        """Remove the object; :meth:`restore` or undo brings it back.

        Examples:
            >>> result = car.delete()
            >>> "car_red" in scenario.objects
            False
        """
        return self._make(Delete)

    def restore(self) -> R:
        """Restore the object after :meth:`delete`.

        Examples:
            >>> result = car.delete()
            >>> result = car.restore()
            >>> "car_red" in scenario.objects
            True
        """
        return self._make(Restore)

    def _edit(self, operation: Operation) -> R:
        raise NotImplementedError

    def _make(self, model: type[Any], **fields: Any) -> R:
        operation: Operation = checked(model, object_id=self.object_id, **fields)
        return self._edit(operation)

    def _duplicate(self, new_id: str | None, shift: Vector, frame: str, snap: bool) -> Operation:
        x, y, z = shift
        return checked(
            Duplicate,
            object_id=self.object_id,
            new_id=new_id,
            x=x,
            y=y,
            z=z,
            frame=frame,
            snap=snap,
        )


class ScenarioEdits(Generic[R]):
    """Edits that do not belong to an existing object."""

    def erase_region(
        self,
        *,
        position: Vector,
        size: Vector,
        quaternion: Quaternion = UPRIGHT,
        region_id: str | None = None,
    ) -> R:
        """Hide the background inside a box [m]; :meth:`remove` its id to restore it.

        Examples:
            >>> scenario.erase_region(position=(10, 0, 1), size=(2, 2, 3), region_id="sign").created
            ['sign']
        """
        pose = checked(Pose, position=position, quaternion=quaternion)
        return self._edit(checked(EraseRegion, region_id=region_id, pose=pose, size=size))

    def add_box(
        self,
        *,
        position: Vector,
        size: Vector,
        quaternion: Quaternion = UPRIGHT,
        friction: float | None = None,
        collider_id: str | None = None,
    ) -> R:
        """Add an invisible rigid box, for the physics.

        Examples:
            >>> result = scenario.add_box(position=(20, 0, 0.5), size=(0.5, 6, 1))
        """
        shape = checked(BoxShape, position=position, quaternion=quaternion, size=size)
        return self._collider(shape, friction, collider_id)

    def add_cylinder(
        self,
        *,
        position: Vector,
        radius: float,
        height: float,
        quaternion: Quaternion = UPRIGHT,
        friction: float | None = None,
        collider_id: str | None = None,
    ) -> R:
        """Add an invisible rigid post or drum about its own z axis, for the physics.

        Examples:
            >>> result = scenario.add_cylinder(position=(20, 0, 1.5), radius=0.1, height=3.0)
        """
        shape = checked(
            CylinderShape, position=position, quaternion=quaternion, radius=radius, height=height
        )
        return self._collider(shape, friction, collider_id)

    def add_capsule(
        self,
        *,
        position: Vector,
        radius: float,
        length: float = 0.0,
        quaternion: Quaternion = UPRIGHT,
        friction: float | None = None,
        collider_id: str | None = None,
    ) -> R:
        """Add a capsule: all points within ``radius`` of a line along its z axis; or a ball.

        Examples:
            >>> result = scenario.add_capsule(position=(20, 0, 0.5), radius=0.5)
        """
        shape = checked(
            CapsuleShape, position=position, quaternion=quaternion, radius=radius, length=length
        )
        return self._collider(shape, friction, collider_id)

    def add_mesh(
        self,
        *,
        vertices: Sequence[Vector],
        triangles: Sequence[tuple[int, int, int]],
        thickness: float | None = None,
        position: Vector = (0.0, 0.0, 0.0),
        quaternion: Quaternion = UPRIGHT,
        friction: float | None = None,
        collider_id: str | None = None,
    ) -> R:
        """Add a closed triangle mesh, or a sheet with a ``thickness`` [m], for the physics.

        Vertices of a triangle are counter-clockwise as seen from outside.

        Examples:
            >>> ramp = [(20, -2, 0), (20, 2, 0), (26, -2, 1), (26, 2, 1)]
            >>> result = scenario.add_mesh(
            ...     vertices=ramp, triangles=[(0, 2, 3), (0, 3, 1)], thickness=0.1
            ... )
        """
        shape = checked(
            MeshShape,
            position=position,
            quaternion=quaternion,
            vertices=list(vertices),
            triangles=list(triangles),
            thickness=thickness,
        )
        return self._collider(shape, friction, collider_id)

    def add_plane(
        self,
        *,
        point: Vector,
        normal: Vector = UP,
        friction: float | None = None,
        collider_id: str | None = None,
    ) -> R:
        """Add a plane for the physics; objects stay above it.

        Examples:
            >>> result = scenario.add_plane(point=(0, 0, 0), friction=0.9)
        """
        return self._collider(
            checked(PlaneShape, point=point, normal=normal), friction, collider_id
        )

    def add_ground(
        self, *, offset: float = 0.0, friction: float | None = None, collider_id: str | None = None
    ) -> R:
        """Add the recorded ground, raised by ``offset`` [m], for the physics.

        Examples:
            >>> result = scenario.add_ground(collider_id="road")
            >>> [collider.collider_id for collider in scenario.info.colliders]
            ['road']
        """
        return self._collider(checked(GroundShape, offset=offset), friction, collider_id)

    def set_time(self, *, start_us: int | None = None, end_us: int | None = None) -> R:
        """Set the time span of the scenario; default: as recorded.

        Examples:
            >>> result = scenario.set_time(start_us=500_000)
            >>> scenario.info.start_us, scenario.info.end_us
            (500000, 2000000)
        """
        return self._edit(checked(SetTime, start_us=start_us, end_us=end_us))

    def remove(self, thing_id: str) -> R:
        """Remove an object, erased region or collider by its id.

        Examples:
            >>> result = scenario.remove("post")
            >>> list(scenario.objects)
            ['car_red', 'car_blue']
        """
        return self._edit(checked(Delete, object_id=thing_id))

    def restore(self, thing_id: str) -> R:
        """Restore a removed object, region or collider.

        Examples:
            >>> result = scenario.remove("post")
            >>> result = scenario.restore("post")
            >>> "post" in scenario.objects
            True
        """
        return self._edit(checked(Restore, object_id=thing_id))

    def set_storyboard(self, storyboard: Storyboard | Mapping[str, Any] | None) -> R:
        """Set the storyboard of the scenario's sessions; None removes it.

        Args:
            storyboard: a model of ``real2sim_proto.storyboard``, or its fields.

        Examples:
            >>> ego = {"name": "Ego", "kind": "ego"}
            >>> result = scenario.set_storyboard({"entities": [ego, {"name": "lead"}]})
            >>> [entity.name for entity in scenario.storyboard.entities]
            ['Ego', 'lead']
        """
        return self._edit(checked(SetStoryboard, storyboard=storyboard))

    def _edit(self, operation: Operation) -> R:
        raise NotImplementedError

    def _collider(
        self,
        shape: ColliderShape,
        friction: float | None,
        collider_id: str | None,
    ) -> R:
        return self._edit(
            checked(AddCollider, shape=shape, friction=friction, collider_id=collider_id)
        )


def insertion(
    asset: str,
    *,
    position: Vector,
    quaternion: Quaternion,
    size: Vector | None,
    object_id: str | None,
    snap: bool,
) -> Operation:
    """The operation that inserts an asset at a pose, for the whole time range."""
    pose = checked(Pose, position=position, quaternion=quaternion)
    return checked(Insert, asset_id=asset, object_id=object_id, pose=pose, size=size, snap=snap)


def _time_range(start_us: int | None, end_us: int | None, blend_us: int | None) -> TimeRange | None:
    if start_us is None and end_us is None:
        return None
    blend = {} if blend_us is None else {"blend_us": blend_us}
    return checked(TimeRange, start_us=start_us, end_us=end_us, **blend)
