"""The bridge's node, by ``rclpy``."""

from __future__ import annotations

import array
import importlib
from collections.abc import Callable
from functools import lru_cache
from typing import Any

from ..errors import Real2SimError
from .bridge import STANDS_STILL
from .messages import MessageTypes

PACKAGES = ("rclpy", "sensor_msgs", "nav_msgs", "geometry_msgs", "tf2_msgs", "rosgraph_msgs")


class NoRosError(Real2SimError):
    """ROS 2 is not there."""


class RosNode:
    """A node named ``real2sim``.

    Attributes:
        types: ROS' own message classes.
    """

    def __init__(self) -> None:
        """Begin ROS.

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
        """Send a message; newcomers get the last one of topics that stand still."""
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
        """Receive for at most so long, or until a message has come; whether ROS still runs."""
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
