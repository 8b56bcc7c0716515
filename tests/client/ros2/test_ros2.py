"""The ROS 2 bridge without ROS: messages by their definitions, and the loop with a fake node."""

from __future__ import annotations

import array
import builtins
import math
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from real2sim.images import Frame
from real2sim.ros2.bridge import NoRosError, Ros2Bridge, RosNode, message_class
from real2sim.ros2.messages import (
    CommandError,
    MessageBuilder,
    MessageTypes,
    of_ackermann,
    of_path,
    of_twist,
)
from real2sim_proto.drive import EgoState
from real2sim_proto.scenes import CameraInfo

typesys = pytest.importorskip("rosbags.typesys")

STORE = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
TYPES = MessageTypes(
    of=lambda name: STORE.types[name],
    octets=lambda data: np.frombuffer(data, np.uint8),
    numbers=lambda values: np.array(list(values), np.float64),
)
BUILD = MessageBuilder(TYPES)
K = np.array([[50.0, 0, 24], [0, 50, 16], [0, 0, 1]])
SIXTH = (math.cos(math.pi / 6), 0.0, 0.0, math.sin(math.pi / 6))


def on_the_wire(message: Any, name: str) -> Any:
    """Serialize by the ROS message definitions, and read back."""
    return STORE.deserialize_cdr(STORE.serialize_cdr(message, name), name)


def ego(**changes: Any) -> EgoState:
    fields = {
        "position": (10.0, -5.0, 0.5), "quaternion": SIXTH, "yaw": math.pi / 3, "speed": 4.0,
        "acceleration": 0.0, "steering": 0.0, "yaw_rate": 0.2, "size": (4.5, 1.9, 1.5),
    }  # fmt: skip
    return EgoState(**fields | changes)


def seen(t_us: int = 2_345_678, *, frames: dict[str, Any] | None = None, **changes: Any) -> Any:
    return SimpleNamespace(t_us=t_us, step=0, ego=ego(**changes), frames=frames or {}, over=False)


def frame(modality: str, image: np.ndarray) -> Frame:
    return Frame(
        data=image.tobytes(), codec="raw", modality=modality, dtype=str(image.dtype),
        shape=image.shape, sensor="front", t_us=2_345_678, T_world_sensor=np.eye(4), K=K,
    )  # fmt: skip


# --- messages -------------------------------------------------------------------------------------


def test_the_clock_is_simulation_time_even_below_zero():
    stamp = on_the_wire(BUILD.clock(2_345_678), "rosgraph_msgs/msg/Clock").clock
    before = on_the_wire(BUILD.clock(-1), "rosgraph_msgs/msg/Clock").clock

    assert (stamp.sec, stamp.nanosec) == (2, 345_678_000)
    assert (before.sec, before.nanosec) == (-1, 999_999_000)


def test_odometry_has_the_map_pose_and_the_vehicle_velocity():
    found = on_the_wire(BUILD.odometry(seen()), "nav_msgs/msg/Odometry")

    assert (found.header.frame_id, found.child_frame_id) == ("map", "base_link")
    place, turn = found.pose.pose.position, found.pose.pose.orientation
    assert (place.x, place.y, place.z) == (10.0, -5.0, 0.5)
    assert (turn.w, turn.x, turn.y, turn.z) == SIXTH
    assert (found.twist.twist.linear.x, found.twist.twist.angular.z) == (4.0, 0.2)


def test_transforms_connect_map_vehicle_and_cameras():
    (vehicle,) = on_the_wire(BUILD.ego_transform(seen()), "tf2_msgs/msg/TFMessage").transforms
    T = [[0, 0, 1, 1.5], [-1, 0, 0, 0.2], [0, -1, 0, 1.4], [0, 0, 0, 1]]
    camera = CameraInfo(name="front", width=48, height=32, K=K.tolist(), T_vehicle_camera=T)
    message = BUILD.camera_transforms(0, [camera])
    (front,) = on_the_wire(message, "tf2_msgs/msg/TFMessage").transforms

    assert (vehicle.header.frame_id, vehicle.child_frame_id) == ("map", "base_link")
    assert (front.header.frame_id, front.child_frame_id) == ("base_link", "front_optical")
    assert front.transform.translation.x == 1.5
    q = front.transform.rotation
    # The optical axis z is the vehicle's x axis.
    assert 2 * (q.x * q.z + q.w * q.y) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("modality", "dtype", "channels", "encoding"),
    [("rgb", np.uint8, 3, "rgb8"), ("depth", "<f4", 0, "32FC1"), ("instance", "<u2", 0, "16UC1")],
)
def test_images_keep_their_bytes_and_encoding(modality, dtype, channels, encoding):
    shape = (32, 48, channels) if channels else (32, 48)
    image = np.arange(np.prod(shape)).reshape(shape).astype(dtype)
    found = on_the_wire(BUILD.image(frame(modality, image)), "sensor_msgs/msg/Image")

    assert (found.height, found.width, found.encoding) == (32, 48, encoding)
    assert found.step * found.height == found.data.nbytes == image.nbytes
    assert found.data.tobytes() == image.tobytes()
    assert found.header.frame_id == "front_optical"


def test_camera_infos_have_pinhole_intrinsics():
    image = frame("rgb", np.zeros((32, 48, 3), np.uint8))
    found = on_the_wire(BUILD.camera_info(image), "sensor_msgs/msg/CameraInfo")

    assert found.k.reshape(3, 3).tolist() == K.tolist()
    assert found.p.reshape(3, 4)[:, :3].tolist() == K.tolist()
    assert (found.distortion_model, found.d.tolist()) == ("plumb_bob", [0.0] * 5)


# --- commands -------------------------------------------------------------------------------------


def ackermann(speed: float, angle: float = 0.1, acceleration: float = 0.0) -> SimpleNamespace:
    return SimpleNamespace(
        drive=SimpleNamespace(speed=speed, steering_angle=angle, acceleration=acceleration)
    )


@pytest.mark.parametrize(
    ("message", "speed", "gear", "acceleration"),
    [
        (ackermann(5.0), 4.0, "drive", 1.0 / 0.3),
        (ackermann(9.0, acceleration=1.5), 4.0, "drive", 1.5),
        (ackermann(0.0), 4.0, "drive", -8.0),
        (ackermann(-1.0), 0.0, "reverse", 1.0 / 0.3),
        (ackermann(-1.0), -1.0, "reverse", 0.0),
        (ackermann(0.0, acceleration=2.0), -3.0, "reverse", -2.0),
        (ackermann(-1.0).drive, 2.0, "reverse", 4.0),
    ],
)
def test_a_target_speed_sets_gear_and_acceleration(message, speed, gear, acceleration):
    command = of_ackermann(message, seen(speed=speed))

    assert command.gear == gear
    assert command.acceleration == pytest.approx(acceleration)
    assert command.steering == 0.1


def test_a_turn_rate_is_converted_to_a_steering_angle():
    message = STORE.types["geometry_msgs/msg/Twist"](
        linear=STORE.types["geometry_msgs/msg/Vector3"](x=5.0, y=0.0, z=0.0),
        angular=STORE.types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.5),
    )
    assert of_twist(message, seen()).steering == pytest.approx(math.atan(2.8 * 0.1))


def path(frame_id: str, *rows: tuple[int, float, float]) -> SimpleNamespace:
    def stamped(t_us: int, x: float, y: float) -> SimpleNamespace:
        stamp = SimpleNamespace(sec=t_us // 1_000_000, nanosec=t_us % 1_000_000 * 1000)
        pose = SimpleNamespace(
            position=SimpleNamespace(x=x, y=y, z=0.0),
            orientation=SimpleNamespace(w=SIXTH[0], x=0.0, y=0.0, z=SIXTH[3]),
        )
        return SimpleNamespace(header=SimpleNamespace(stamp=stamp), pose=pose)

    header = SimpleNamespace(frame_id=frame_id)
    return SimpleNamespace(header=header, poses=[stamped(*row) for row in rows])


@pytest.mark.parametrize(("frame_id", "ours"), [("map", "world"), ("base_link", "vehicle")])
def test_a_path_is_converted_to_a_trajectory(frame_id, ours):
    message = path(frame_id, (1_000_000, 0.0, 0.0), (3_000_000, 1.0, 2.0), (3_500_000, 2.0, 2.0))
    plan = of_path(message, seen())

    assert (plan.frame, plan.times_us) == (ours, [3_000_000, 3_500_000])
    assert plan.poses[0] == pytest.approx((1.0, 2.0, math.pi / 3))


@pytest.mark.parametrize(
    ("message", "sentence"),
    [
        (path("odom", (3_000_000, 0.0, 0.0)), "'odom'"),
        (path("map", (1_000_000, 0.0, 0.0)), "none of them after 2345678 us"),
        (path("map", (3_000_000, 0.0, 0.0), (3_000_000, 1.0, 0.0)), "increase"),
    ],
)
def test_an_invalid_path_is_refused(message, sentence):
    with pytest.raises(CommandError, match=sentence):
        of_path(message, seen())


def test_non_finite_numbers_are_refused():
    with pytest.raises(CommandError, match="nan"):
        of_ackermann(ackermann(math.nan), seen())


# --- the loop -------------------------------------------------------------------------------------


class PlayedNode:
    """On each clock message, sends the result of ``answer`` in the next spin."""

    types = TYPES

    def __init__(self, answer: Callable[[int], Any], *, spins: int = 50) -> None:
        self.sent: list[tuple[str, Any]] = []
        self._answer, self._spins, self._waiting = answer, spins, []

    def publish(self, topic: str, type_name: str, message: Any) -> None:
        on_the_wire(message, type_name)
        self.sent.append((topic, message))
        if topic == "/clock":
            self._waiting.append(self._answer(len([t for t, _ in self.sent if t == "/clock"])))

    def subscribe(self, topic: str, type_name: str, receive: Callable[[Any], None]) -> None:
        self.topic, self._receive = topic, receive

    def spin(self, seconds: float) -> bool:
        self._spins -= 1
        time.sleep(min(seconds, 0.001))
        while self._waiting:
            if (message := self._waiting.pop()) is not None:
                self._receive(message)
        return self._spins > 0


class PlayedSession:
    """Counts steps. The episode is over after ``last``."""

    def __init__(self, last: int = 4) -> None:
        self.welcome = SimpleNamespace(cameras=[])
        self.plans: list[Any] = []
        self._last = last

    def reset(self, **options: Any) -> Any:
        self.options = options
        return self._obs()

    def step(self, plan: Any) -> Any:
        self.plans.append(plan)
        return self._obs()

    def _obs(self) -> Any:
        k = len(self.plans)
        image = frame("rgb", np.zeros((32, 48, 3), np.uint8))
        obs = seen(k * 10_000, frames={"front": {"rgb": image}})
        obs.over = k >= self._last
        return obs


def test_in_lock_step_each_observation_waits_for_a_command():
    session, node = PlayedSession(), PlayedNode(lambda k: ackermann(float(k)))
    Ros2Bridge(session, node).run(sensors=["front"], seed=3)

    assert session.options == {"sensors": ["front"], "action": "control", "seed": 3}
    # At 4 m/s, with target speeds of 1 to 4 m/s.
    expected = [-8.0, -2 / 0.3, -1 / 0.3, 0.0]
    assert [plan.acceleration for plan in session.plans] == pytest.approx(expected)
    topics = [topic for topic, _ in node.sent]
    assert topics[:2] == ["/tf_static", "/clock"]
    each = ["/clock", "/tf", "/odom", "/camera/front/image_raw", "/camera/front/camera_info"]
    assert topics[1:] == each * 5


def test_in_real_time_the_latest_command_is_kept_and_the_default_is_to_stop():
    session = PlayedSession()
    node = PlayedNode(lambda k: ackermann(9.0) if k == 3 else None, spins=10_000)
    Ros2Bridge(session, node, real_time=1.0).run()

    assert session.plans[0].acceleration < 0
    assert [plan.acceleration for plan in session.plans[2:]] == [4.0, 4.0]


def test_commands_are_received_even_if_the_simulation_is_slower_than_real_time():
    session, node = PlayedSession(), PlayedNode(lambda _k: ackermann(9.0), spins=10_000)
    Ros2Bridge(session, node, real_time=1e9).run()

    assert [plan.acceleration for plan in session.plans] == [4.0] * 4


def test_an_invalid_command_is_reported_and_the_next_one_awaited():
    said: list[str] = []
    session, node = PlayedSession(last=1), PlayedNode(lambda _k: path("odom"), spins=3)
    Ros2Bridge(session, node, commands="path", report=said.append).run()

    assert node.topic == "/plan"
    assert session.plans == []
    assert said == ["/plan: a path in frame 'odom'"]


def test_without_ros_the_error_says_what_to_install(monkeypatch):
    imported = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name.startswith("rclpy"):
            raise ImportError(f"No module named {name!r}")
        return imported(name, *rest)

    monkeypatch.setattr("importlib.import_module", without)
    with pytest.raises(NoRosError, match="needs rclpy") as refused:
        RosNode()
    assert "setup.bash" in str(refused.value.hint)


# --- the node -------------------------------------------------------------------------------------


class PlayedRos:
    """The parts of ``rclpy`` and the message packages that the node uses."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, Any]] = []
        self.profiles: dict[str, Any] = {}
        self.receive: dict[str, Callable[[Any], None]] = {}
        self.running, self.ended = True, []
        classes = type("Classes", (), {"__getattr__": lambda _self, name: _field_holder(name)})()
        packages = ("sensor_msgs", "nav_msgs", "geometry_msgs", "tf2_msgs", "rosgraph_msgs")
        headers = ("std_msgs", "builtin_interfaces", "ackermann_msgs")
        self.modules = {f"{name}.msg": classes for name in (*packages, *headers)}
        durability = SimpleNamespace(TRANSIENT_LOCAL="kept", VOLATILE="gone")
        self.modules["rclpy.qos"] = SimpleNamespace(
            DurabilityPolicy=durability, QoSProfile=lambda **fields: fields
        )
        self.modules["rclpy"] = SimpleNamespace(
            init=lambda: None,
            create_node=lambda _name: self,
            ok=lambda: self.running,
            spin_once=lambda _node, timeout_sec: None,
            try_shutdown=lambda: self.ended.append("rclpy"),
        )

    def create_publisher(self, _kind: Any, topic: str, profile: Any) -> Any:
        self.profiles[topic] = profile
        return SimpleNamespace(publish=lambda message: self.sent.append((topic, message)))

    def create_subscription(
        self, _kind: Any, topic: str, receive: Callable[[Any], None], _depth: int
    ) -> None:
        self.receive[topic] = receive

    def destroy_node(self) -> None:
        self.ended.append("node")


def _field_holder(name: str) -> type:
    return type(name, (SimpleNamespace,), {})


@pytest.fixture
def ros(monkeypatch) -> PlayedRos:
    played = PlayedRos()
    monkeypatch.setattr("importlib.import_module", played.modules.__getitem__)
    message_class.cache_clear()
    yield played
    message_class.cache_clear()


def test_the_node_publishes_and_latches_static_transforms(ros):
    node = RosNode()
    builder = MessageBuilder(node.types)
    cameras = builder.camera_transforms(0, [])
    node.publish("/tf_static", "tf2_msgs/msg/TFMessage", cameras)
    image = builder.image(frame("rgb", np.ones((32, 48, 3), np.uint8)))
    for _ in range(2):
        node.publish("/camera/front/image_raw", "sensor_msgs/msg/Image", image)
    node.close()

    assert [topic for topic, _ in ros.sent] == ["/tf_static", *["/camera/front/image_raw"] * 2]
    assert ros.profiles["/tf_static"] == {"depth": 1, "durability": "kept"}
    assert ros.profiles["/camera/front/image_raw"]["durability"] == "gone"
    # rclpy accepts an array without checking every element.
    assert isinstance(image.data, array.array)
    assert image.data.tobytes() == b"\x01" * (32 * 48 * 3)
    assert ros.ended == ["node", "rclpy"]


def test_the_node_receives_until_ros_shuts_down(ros):
    node, found = RosNode(), []
    node.subscribe("/cmd_vel", "geometry_msgs/msg/Twist", found.append)
    ros.receive["/cmd_vel"]("go")

    assert found == ["go"]
    assert node.spin(0.1)
    ros.running = False
    assert not node.spin(0.1)
