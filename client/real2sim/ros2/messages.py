"""Observations as ROS 2 messages.

Frames follow REP 103 and REP 105, as ours do: ``map`` is the world (z up), ``base_link``
the rear axle's centre on the ground (x forward, y left, z up), and ``CAMERA_optical`` a camera (x
right, y down, z forward). Times are simulation times.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim_proto.plans import Control, TrajectoryPlan

from .._session_state import Matrix, quaternion_of
from ..errors import Real2SimError

if TYPE_CHECKING:
    from real2sim_proto.drive import EgoState
    from real2sim_proto.scenes import CameraInfo

    from ..images import Frame
    from ..observation import Observation


MAP, BASE = "map", "base_link"
ENCODINGS = {
    "rgb": "rgb8",
    "depth": "32FC1",
    "instance": "16UC1",
    "median_depth": "32FC1",
    "semantic": "8UC1",
    "uncertainty": "32FC1",
}
"""Encodings of images, by modality."""


@dataclass(frozen=True)
class MessageTypes:
    """Message classes of a serialiser.

    Attributes:
        of: the class of a type such as ``sensor_msgs/msg/Image``, constructed with keyword fields.
        octets: converts bytes to its uint8 arrays.
        numbers: converts numbers to its float64 arrays.
    """

    of: Callable[[str], Any]
    octets: Callable[[bytes], Any]
    numbers: Callable[[Iterable[float]], Any]


@dataclass(frozen=True)
class MessageBuilder:
    """Creates messages of one family of message classes.

    Attributes:
        types: the classes.
    """

    types: MessageTypes

    def clock(self, t_us: int) -> Any:
        """rosgraph_msgs/Clock."""
        return self._make("rosgraph_msgs/msg/Clock", clock=self._time(t_us))

    def odometry(self, obs: Observation) -> Any:
        """nav_msgs/Odometry: pose of ``base_link`` in ``map``, velocity in ``base_link``."""
        ego, none = obs.ego, self.types.numbers([0.0] * 36)
        twist = self._make(
            "geometry_msgs/msg/Twist",
            linear=self._vector((ego.speed, ego.lateral_speed, 0.0)),
            angular=self._vector((0.0, 0.0, ego.yaw_rate)),
        )
        make, covariance = self._make, {"covariance": none}
        return make(
            "nav_msgs/msg/Odometry",
            header=self._header(obs.t_us, MAP),
            child_frame_id=BASE,
            pose=make("geometry_msgs/msg/PoseWithCovariance", pose=self._pose(ego), **covariance),
            twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, **covariance),
        )

    def ego_transform(self, obs: Observation) -> Any:
        """tf2_msgs/TFMessage: ``base_link`` in ``map``."""
        ego = obs.ego
        return self._transforms([(obs.t_us, MAP, BASE, ego.position, ego.quaternion)])

    def camera_transforms(self, t_us: int, cameras: Sequence[CameraInfo]) -> Any:
        """tf2_msgs/TFMessage: the static pose of every camera in ``base_link``."""
        poses = [np.asarray(camera.T_vehicle_camera, np.float64) for camera in cameras]
        return self._transforms(
            [
                (t_us, BASE, optical(c.name), pose[:3, 3].tolist(), quaternion_of(pose[:3, :3]))
                for c, pose in zip(cameras, poses, strict=True)
            ]
        )

    def image(self, frame: Frame) -> Any:
        """sensor_msgs/Image: rgb8, depth in metres as 32FC1, instances as 16UC1."""
        pixels = np.ascontiguousarray(frame.array)
        height, width = pixels.shape[:2]
        return self._make(
            "sensor_msgs/msg/Image",
            header=self._header(frame.t_us, optical(frame.sensor)),
            height=height,
            width=width,
            encoding=ENCODINGS[frame.modality],
            is_bigendian=0,
            step=pixels.strides[0],
            data=self.types.octets(pixels.tobytes()),
        )

    def camera_info(self, frame: Frame) -> Any:
        """sensor_msgs/CameraInfo of an image: a pinhole without distortion."""
        height, width = frame.shape[:2]
        K: Matrix = np.asarray(frame.K, np.float64)
        numbers = self.types.numbers
        window = self._make(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False,
        )  # fmt: skip
        return self._make(
            "sensor_msgs/msg/CameraInfo",
            header=self._header(frame.t_us, optical(frame.sensor)),
            height=height,
            width=width,
            distortion_model="plumb_bob",
            d=numbers([0.0] * 5),
            k=numbers(K.ravel().tolist()),
            r=numbers(np.eye(3).ravel().tolist()),
            p=numbers(np.column_stack([K, np.zeros(3)]).ravel().tolist()),
            binning_x=0,
            binning_y=0,
            roi=window,
        )

    def _transforms(self, rows: Sequence[tuple[int, str, str, Any, Any]]) -> Any:
        stamped = [
            self._make(
                "geometry_msgs/msg/TransformStamped",
                header=self._header(t_us, parent),
                child_frame_id=child,
                transform=self._make(
                    "geometry_msgs/msg/Transform",
                    translation=self._vector(position),
                    rotation=self._quaternion(quaternion),
                ),
            )
            for t_us, parent, child, position, quaternion in rows
        ]
        return self._make("tf2_msgs/msg/TFMessage", transforms=stamped)

    def _pose(self, ego: EgoState) -> Any:
        x, y, z = ego.position
        return self._make(
            "geometry_msgs/msg/Pose",
            position=self._make("geometry_msgs/msg/Point", x=float(x), y=float(y), z=float(z)),
            orientation=self._quaternion(ego.quaternion),
        )

    def _quaternion(self, quaternion: Sequence[float]) -> Any:
        w, x, y, z = map(float, quaternion)
        return self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _vector(self, vector: Sequence[float]) -> Any:
        x, y, z = map(float, vector)
        return self._make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def _header(self, t_us: int, frame_id: str) -> Any:
        return self._make("std_msgs/msg/Header", stamp=self._time(t_us), frame_id=frame_id)

    def _time(self, t_us: int) -> Any:
        seconds, rest_us = divmod(t_us, 1_000_000)
        return self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest_us * 1000)

    def _make(self, name: str, **fields: Any) -> Any:
        return self.types.of(name)(**fields)


def optical(camera: str) -> str:
    """Name of a camera's frame."""
    return f"{camera}_optical"


# Plans from ROS 2 messages. Members are read by name, so any message class works.

SPEED_TIME = 0.3
"""Time within which the requested speed is reached [s]."""

MAX_ACCELERATION, MAX_BRAKING = 4.0, 8.0
"""Limits for messages without an acceleration [m/s^2]."""

MIN_TURN_SPEED = 0.1
"""Below this speed the turn rate does not determine the steering angle [m/s]."""


class CommandError(Real2SimError):
    """A message that cannot be converted to a plan."""


def of_ackermann(message: Any, obs: Observation) -> Control:
    """Convert ackermann_msgs/AckermannDrive, also stamped: speed [m/s], negative for reverse,
    steering angle [rad], and maximum acceleration [m/s^2], where 0 sets no limit."""
    drive = getattr(message, "drive", message)
    limit = abs(float(drive.acceleration))
    return _towards(float(drive.speed), float(drive.steering_angle), obs, limit=limit)


def of_twist(message: Any, obs: Observation, *, wheelbase: float = 2.8) -> Control:
    """Convert geometry_msgs/Twist, also stamped: speed along x [m/s], negative for reverse, and yaw
    rate about z [rad/s], which becomes the steering angle for ``wheelbase`` [m]."""
    twist = getattr(message, "twist", message)
    speed, turn = float(twist.linear.x), float(twist.angular.z)
    steering = math.atan(wheelbase * turn / speed) if abs(speed) > MIN_TURN_SPEED else 0.0
    return _towards(speed, steering, obs, limit=0.0)


def of_path(message: Any, obs: Observation) -> TrajectoryPlan:
    """Convert nav_msgs/Path in ``map`` or ``base_link``: poses at the times of their headers; past
    poses are dropped.

    Raises:
        CommandError: another frame, no future pose, or times that do not increase.
    """
    frame = message.header.frame_id or MAP
    if frame not in {MAP, BASE}:
        raise CommandError(f"a path in frame {frame!r}", hint=f"send it in {MAP!r} or {BASE!r}")
    found = [(_us(p.header.stamp), _planar(p.pose)) for p in message.poses]
    coming = [(t_us, pose) for t_us, pose in found if t_us > obs.t_us]
    if not coming:
        raise CommandError(
            f"a path of {len(found)} poses, none of them after {obs.t_us} us",
            hint="header.stamp of each pose says when to be there, in time of /clock",
        )
    try:
        return TrajectoryPlan(
            times_us=[t_us for t_us, _ in coming],
            poses=[pose for _, pose in coming],
            frame="vehicle" if frame == BASE else "world",
        )
    except ValueError as error:
        raise CommandError(f"a path that is not a plan: {error}") from error


def standing(action: str, obs: Observation) -> Control | TrajectoryPlan:
    """The plan before the first command: stop."""
    if action == "control":
        return Control(acceleration=-MAX_ACCELERATION, steering=0.0)
    return TrajectoryPlan(times_us=[obs.t_us + 1_000_000], poses=[(0.0, 0.0, 0.0)])


def _towards(speed: float, steering: float, obs: Observation, *, limit: float) -> Control:
    """The command that brings a vehicle to a speed [m/s] with its wheels at an angle [rad]."""
    if not (math.isfinite(speed) and math.isfinite(steering) and math.isfinite(limit)):
        raise CommandError(f"a speed of {speed} and an angle of {steering}")
    now = obs.ego.speed
    backwards = speed < 0 or (speed == 0 and now < 0)
    ahead = -1.0 if backwards else 1.0
    most, least = limit or MAX_ACCELERATION, -(limit or MAX_BRAKING)
    wanted = (abs(speed) - ahead * now) / SPEED_TIME
    return Control(
        acceleration=min(max(wanted, least), most),
        steering=min(max(steering, -1.6), 1.6),
        gear="reverse" if backwards else "drive",
    )


def _us(stamp: Any) -> int:
    return int(stamp.sec) * 1_000_000 + int(stamp.nanosec) // 1000


def _planar(pose: Any) -> tuple[float, float, float]:
    q = pose.orientation
    yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
    return float(pose.position.x), float(pose.position.y), yaw
