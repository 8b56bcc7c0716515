"""The bridge's loop (publish an observation, wait for a command, step) and its ``rclpy`` node."""

from __future__ import annotations

import array
import importlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal, Protocol

from ..errors import Real2SimError
from .messages import (
    CommandError,
    MessageBuilder,
    MessageTypes,
    of_ackermann,
    of_path,
    of_twist,
    standing,
)

if TYPE_CHECKING:
    from real2sim_proto.plans import Plan

    from .._requests import Sensor
    from .._sync.sessions import DriveSession
    from ..observation import Observation


COMMANDS: dict[str, tuple[str, str, Callable[[Any, Observation], Plan]]] = {
    "ackermann": ("/ackermann_cmd", "ackermann_msgs/msg/AckermannDriveStamped", of_ackermann),
    "twist": ("/cmd_vel", "geometry_msgs/msg/Twist", of_twist),
    "path": ("/plan", "nav_msgs/msg/Path", of_path),
}
"""Topic, type and meaning of each kind of command."""

STANDS_STILL = frozenset({"/tf_static"})
"""Latched topics: new subscribers receive the last message."""


class Node(Protocol):
    """The functions of ROS that the bridge uses."""

    types: MessageTypes

    def publish(self, topic: str, type_name: str, message: Any) -> None:
        """Send a message."""

    def subscribe(self, topic: str, type_name: str, receive: Callable[[Any], None]) -> None:
        """Call ``receive`` with every message, while the node spins."""

    def spin(self, seconds: float) -> bool:
        """Receive until a message arrives, at most ``seconds``; returns whether ROS still runs."""


@dataclass
class Ros2Bridge:
    """A session driven by messages.

    In lockstep, the default, every observation waits for a later command. With ``real_time`` the
    clock advances at that multiple of wall-clock time under the newest command, and the vehicle
    brakes to a stop before the first one.

    Attributes:
        session: an open session.
        node: the ROS node.
        commands: kind of commands, of :data:`COMMANDS`.
        real_time: multiple of wall-clock time; None: lockstep.
        report: called with a message for each invalid command.
    """

    session: DriveSession
    node: Node
    commands: str = "ackermann"
    real_time: float | None = None
    report: Callable[[str], None] = print
    _newest: Any = field(default=None, init=False)
    _is_fresh: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        if self.commands not in COMMANDS:
            raise ValueError(f"commands {self.commands!r} are none of {', '.join(COMMANDS)}")

    @property
    def action(self) -> Literal["control", "trajectory"]:
        """Kind of the plans that commands become."""
        return "trajectory" if self.commands == "path" else "control"

    def run(
        self, *, sensors: Sequence[Sensor] = (), steps: int | None = None, **options: Any
    ) -> Observation:
        """Reset the session and drive until the episode, the steps or ROS end; returns the last
        observation.

        Args:
            sensors: sensors to publish.
            steps: maximum number of steps; None: to the end of the episode.
            options: options of reset.
        """
        topic, type_name, _ = COMMANDS[self.commands]
        self.node.subscribe(topic, type_name, self._receive)
        builder = MessageBuilder(self.node.types)
        obs = self.session.reset(sensors=sensors, action=self.action, **options)
        cameras = builder.camera_transforms(obs.t_us, self.session.welcome.cameras)
        self.node.publish("/tf_static", "tf2_msgs/msg/TFMessage", cameras)
        self._publish(builder, obs)
        due, made = time.monotonic(), 0
        while not obs.over and (steps is None or made < steps):
            plan = self._wait_for_plan(obs, due)
            if plan is None:
                break
            before_us, made = obs.t_us, made + 1
            obs = self.session.step(plan)
            if self.real_time:
                due = max(due + (obs.t_us - before_us) * 1e-6 / self.real_time, time.monotonic())
            self._publish(builder, obs)
        return obs

    def _receive(self, message: Any) -> None:
        self._newest, self._is_fresh = message, True

    def _wait_for_plan(self, obs: Observation, due: float) -> Plan | None:
        """The plan for an observation; None if ROS has ended."""
        self._is_fresh = self._is_fresh and self.real_time is not None
        while True:
            left = due - time.monotonic() if self.real_time else 0.2
            # Spin even without remaining time: a simulation that is late must still receive
            # commands.
            if not self.node.spin(min(max(left, 0.0), 0.2)):
                return None
            if self.real_time and left <= 0:
                return self._plan(obs) or standing(self.action, obs)
            if not self.real_time and self._is_fresh:
                self._is_fresh = False
                plan = self._plan(obs)
                if plan is not None:
                    return plan

    def _plan(self, obs: Observation) -> Plan | None:
        """The plan of the newest command; None without a valid one."""
        if self._newest is None:
            return None
        try:
            return COMMANDS[self.commands][2](self._newest, obs)
        except CommandError as error:
            self.report(f"{COMMANDS[self.commands][0]}: {error}")
            self._newest = None
            return None

    def _publish(self, builder: MessageBuilder, obs: Observation) -> None:
        # Publish the clock first: no other message may be from the future.
        publish = self.node.publish
        publish("/clock", "rosgraph_msgs/msg/Clock", builder.clock(obs.t_us))
        publish("/tf", "tf2_msgs/msg/TFMessage", builder.ego_transform(obs))
        publish("/odom", "nav_msgs/msg/Odometry", builder.odometry(obs))
        for camera, frames in obs.frames.items():
            for modality, frame in frames.items():
                where = "image_raw" if modality == "rgb" else modality
                image = builder.image(frame)
                publish(f"/camera/{camera}/{where}", "sensor_msgs/msg/Image", image)
            info = builder.camera_info(next(iter(frames.values())))
            publish(f"/camera/{camera}/camera_info", "sensor_msgs/msg/CameraInfo", info)


# The node.

PACKAGES = ("rclpy", "sensor_msgs", "nav_msgs", "geometry_msgs", "tf2_msgs", "rosgraph_msgs")


class NoRosError(Real2SimError):
    """ROS 2 is not installed."""


class RosNode:
    """A node named ``real2sim``.

    Attributes:
        types: ROS' own message classes.
    """

    def __init__(self) -> None:
        """Initialize ROS.

        Raises:
            NoRosError: a package of ROS cannot be imported.
        """
        self._rclpy = _imported("rclpy")
        for package in PACKAGES[1:]:
            _imported(f"{package}.msg")
        self._qos = _imported("rclpy.qos")
        self._rclpy.init()
        self._node = self._rclpy.create_node("real2sim")
        self._publishers: dict[str, Any] = {}
        self.types = MessageTypes(of=message_class, octets=_octets, numbers=list)

    def publish(self, topic: str, type_name: str, message: Any) -> None:
        """Publish a message; latched topics keep the last one for new subscribers."""
        publisher = self._publishers.get(topic)
        if publisher is None:
            durable = self._qos.DurabilityPolicy
            policy = durable.TRANSIENT_LOCAL if topic in STANDS_STILL else durable.VOLATILE
            profile = self._qos.QoSProfile(depth=1, durability=policy)
            publisher = self._node.create_publisher(message_class(type_name), topic, profile)
            self._publishers[topic] = publisher
        publisher.publish(message)

    def subscribe(self, topic: str, type_name: str, receive: Callable[[Any], None]) -> None:
        """Call ``receive`` with every message, while the node spins."""
        self._node.create_subscription(message_class(type_name), topic, receive, 1)

    def spin(self, seconds: float) -> bool:
        """Receive until a message arrives, at most ``seconds``; returns whether ROS still runs."""
        if not self._rclpy.ok():
            return False
        self._rclpy.spin_once(self._node, timeout_sec=max(seconds, 0.0))
        return bool(self._rclpy.ok())

    def close(self) -> None:
        """End ROS."""
        self._node.destroy_node()
        self._rclpy.try_shutdown()


@lru_cache(maxsize=64)
def message_class(type_name: str) -> Any:
    """ROS' class of a type such as ``sensor_msgs/msg/Image``. Raises NoRosError."""
    package, _, name = type_name.split("/")
    return getattr(_imported(f"{package}.msg"), name)


def _imported(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise NoRosError(
            f"the ROS 2 bridge needs {package}, which cannot be imported: {error}",
            hint="install ROS 2 (docs.ros.org), source its setup.bash in this shell, and install "
            f"ros-$ROS_DISTRO-{package.replace('_', '-')}; real2sim must be installed for the "
            "Python of ROS",
        ) from error


def _octets(data: bytes) -> Any:
    return array.array("B", data)
