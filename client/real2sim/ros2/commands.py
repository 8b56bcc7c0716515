"""Plans out of ROS 2 messages; members are read by name, so that any message class will do."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from real2sim_proto.plans import Control, TrajectoryPlan

from ..errors import Real2SimError
from .messages import BASE, MAP

if TYPE_CHECKING:
    from ..observation import Observation

SPEED_TIME = 0.3
"""Within which a wanted speed is to be reached [s]."""

MOST_ACCELERATION, MOST_BRAKING = 4.0, 8.0
"""Where a message asks for no acceleration of its own [m/s^2]."""

SLOWEST_TURN = 0.1
"""Below this speed a turn rate says nothing about the wheels [m/s]."""


class CommandError(Real2SimError):
    """A message that is no plan."""


def of_ackermann(message: Any, obs: Observation) -> Control:
    """Of ackermann_msgs/AckermannDrive, also stamped: speed [m/s], below 0 backwards, steering
    angle [rad], and acceleration [m/s^2] as a limit, 0 for as fast as possible."""
    drive = getattr(message, "drive", message)
    limit = abs(float(drive.acceleration))
    return _towards(float(drive.speed), float(drive.steering_angle), obs, limit=limit)


def of_twist(message: Any, obs: Observation, *, wheelbase: float = 2.8) -> Control:
    """Of geometry_msgs/Twist, also stamped: speed along x [m/s], below 0 backwards, and turn rate
    about z [rad/s], which becomes the angle of the wheels of a vehicle of a ``wheelbase`` [m]."""
    twist = getattr(message, "twist", message)
    speed, turn = float(twist.linear.x), float(twist.angular.z)
    steering = math.atan(wheelbase * turn / speed) if abs(speed) > SLOWEST_TURN else 0.0
    return _towards(speed, steering, obs, limit=0.0)


def of_path(message: Any, obs: Observation) -> TrajectoryPlan:
    """Of nav_msgs/Path in ``map`` or ``base_link``: poses at the times of their headers; what is
    over already is left out.

    Raises:
        CommandError: another frame, or no pose that is still to come, or times that do not
            increase.
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
        raise CommandError(f"a path that is no plan: {error}") from error


def standing(action: str, obs: Observation) -> Control | TrajectoryPlan:
    """What is done before there is any command: stop."""
    if action == "control":
        return Control(acceleration=-MOST_ACCELERATION, steering=0.0)
    return TrajectoryPlan(times_us=[obs.t_us + 1_000_000], poses=[(0.0, 0.0, 0.0)])


def _towards(speed: float, steering: float, obs: Observation, *, limit: float) -> Control:
    """The command that brings a vehicle to a speed [m/s] with its wheels at an angle [rad]."""
    if not (math.isfinite(speed) and math.isfinite(steering) and math.isfinite(limit)):
        raise CommandError(f"a speed of {speed} and an angle of {steering}")
    now = obs.ego.speed
    backwards = speed < 0 or (speed == 0 and now < 0)
    ahead = -1.0 if backwards else 1.0
    most, least = limit or MOST_ACCELERATION, -(limit or MOST_BRAKING)
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
