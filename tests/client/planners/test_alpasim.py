"""A planner behind AlpaSim's EgodriverService, played by a small server on loopback."""

from __future__ import annotations

import math
import struct
from concurrent.futures import ThreadPoolExecutor

import cv2
import grpc
import numpy as np
import pytest

from real2sim.planners import load_planner, needs_of
from real2sim.planners._alpasim_messages import METHODS, SERVICE, messages
from real2sim.planners.alpasim import AlpasimDriver, _quaternion
from real2sim.planners.peer import PeerError
from real2sim_server.geometry.rotation import quaternion_to_matrix

from . import rig

pytestmark = pytest.mark.network


class Driver:
    """Drives straight on along x of its local frame; keeps what it was asked."""

    def __init__(self):
        self.asked: list[tuple[str, object]] = []
        self.answer = self.way(1.0, 2.0, 3.0)

    def way(self, *xs: float, terminate: bool = False):
        m = messages()
        c, s = math.cos(0.1), math.sin(0.1)
        poses = [
            m.PoseAtTime(
                timestamp_us=1_000_000 + 200_000 * k,
                pose=m.Pose(vec=m.Vec3(x=x, y=-1.0), quat=m.Quat(w=c, z=s)),
            )
            for k, x in enumerate(xs)
        ]
        return m.DriveResponse(trajectory=m.Trajectory(poses=poses), terminate_session=terminate)

    def handler(self, name: str, request: str, answer: str):
        def handle(asked, _context):
            self.asked.append((name, asked))
            return self.answer if name == "drive" else getattr(messages(), answer)()

        return grpc.unary_unary_rpc_method_handler(
            handle,
            request_deserializer=getattr(messages(), request).FromString,
            response_serializer=getattr(messages(), answer).SerializeToString,
        )


@pytest.fixture
def driver():
    peer = Driver()
    server = grpc.server(ThreadPoolExecutor(2))
    handlers = {name: peer.handler(name, *pair) for name, pair in METHODS.items()}
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE, handlers),))
    peer.target = f"127.0.0.1:{server.add_insecure_port('127.0.0.1:0')}"
    server.start()
    yield peer
    server.stop(None).wait()


@pytest.fixture
def planner(driver):
    planner = AlpasimDriver(driver.target, seed=7, timeout=20)
    planner.reset(rig.seen())
    yield planner
    planner.close()


def asked(driver, name):
    return [request for kind, request in driver.asked if kind == name]


def test_it_is_found_by_name_and_wants_all_cameras(driver):
    planner = load_planner(f"alpasim={driver.target}")
    assert needs_of(planner).all_cameras
    planner.close()


def test_poses_after_now_come_back_in_the_world(planner):
    plan = planner.plan(rig.seen())
    assert plan.frame == "world"
    assert plan.times_us == [1_200_000, 1_400_000]
    # The local frame of the driver began where the episode did.
    assert [p[:2] for p in plan.poses] == [(102.0, 49.0), (103.0, 49.0)]
    assert [p[2] for p in plan.poses] == pytest.approx([0.2, 0.2], abs=1e-6)


def test_the_session_tells_of_cameras_and_seed(driver, planner):
    (request,) = asked(driver, "start_session")
    assert request.random_seed == 7
    assert len(request.session_uuid) == 32
    cameras = {c.logical_id: c for c in request.rollout_spec.vehicle.available_cameras}
    assert set(cameras) == set(rig.CAMERAS)
    for name, camera in cameras.items():
        pinhole = camera.intrinsics.opencv_pinhole_param
        assert (pinhole.focal_length_x, pinhole.focal_length_y) == (300.0, 310.0)
        assert (camera.intrinsics.resolution_h, camera.intrinsics.resolution_w) == (32, 48)
        q, expected = camera.rig_to_camera.quat, rig.camera_on_vehicle(rig.CAMERAS[name])
        rotation = quaternion_to_matrix(np.array([q.w, q.x, q.y, q.z]))
        np.testing.assert_allclose(rotation, expected[:3, :3], atol=1e-6)
        v = camera.rig_to_camera.vec
        np.testing.assert_allclose([v.x, v.y, v.z], expected[:3, 3], atol=1e-5)


def test_each_step_shows_images_motion_and_route_before_it_asks(driver, planner):
    planner.plan(rig.seen(position=(103.0, 50.0, 2.0)))
    kinds = [kind for kind, _ in driver.asked]
    told = ["submit_image_observation"] * 3 + ["submit_egomotion_observation", "submit_route"]
    assert kinds[-6:] == [*told, "drive"]
    images = {
        i.camera_image.logical_id: i.camera_image for i in asked(driver, "submit_image_observation")
    }
    for k, name in enumerate(rig.CAMERAS):
        data = np.frombuffer(images[name].image_bytes, np.uint8)
        pixels = cv2.imdecode(data, cv2.IMREAD_COLOR)
        assert pixels.shape == (32, 48, 3)
        assert abs(int(pixels.mean()) - 10 * k) <= 1
        assert images[name].frame_end_us == 1_000_000
    (motion,) = asked(driver, "submit_egomotion_observation")
    (pose,), (state,) = motion.trajectory.poses, motion.dynamic_states
    assert (pose.pose.vec.x, pose.pose.vec.y, pose.pose.vec.z) == (3.0, 0.0, 0.0)
    assert 2 * math.atan2(pose.pose.quat.z, pose.pose.quat.w) == pytest.approx(math.radians(30))
    assert state.linear_velocity.x == 6.0
    (route,) = asked(driver, "submit_route")
    assert len(route.route.waypoints) == 100
    (drive,) = asked(driver, "drive")
    assert (drive.time_now_us, drive.time_query_us) == (1_000_000, 1_100_000)
    assert len({r.session_uuid for _, r in driver.asked if hasattr(r, "session_uuid")}) == 1


def test_a_new_episode_closes_the_session_before(driver, planner):
    planner.reset(rig.seen())
    first, second = (r.session_uuid for r in asked(driver, "start_session"))
    assert [r.session_uuid for r in asked(driver, "close_session")] == [first]
    assert first != second


@pytest.mark.parametrize(
    ("way", "said"),
    [
        (((1.0,), {}), "plans nothing after 1000000 us"),
        (((1.0, math.nan), {}), "not finite"),
        (((1.0, 2.0), {"terminate": True}), "ends the session"),
    ],
)
def test_answers_that_are_no_way_are_refused(driver, planner, way, said):
    xs, options = way
    driver.answer = driver.way(*xs, **options)
    with pytest.raises(PeerError, match=said):
        planner.plan(rig.seen())


def test_nobody_there_is_said_by_address():
    with pytest.raises(PeerError, match=r"get_version of the driver at 127\.0\.0\.1:9 failed"):
        AlpasimDriver("127.0.0.1:9", timeout=0.3)


def nested(number: int, content: bytes) -> bytes:
    return bytes([number << 3 | 2, len(content)]) + content


def test_bytes_on_the_wire_are_those_of_the_field_numbers_of_alpasim():
    request = messages().DriveRequest(session_uuid="s", time_now_us=5, time_query_us=6)
    times = b"\x19" + struct.pack("<Q", 5) + b"\x21" + struct.pack("<Q", 6)
    assert request.SerializeToString() == b"\x0a\x01s" + times
    vec = b"\x0d" + struct.pack("<f", 1.5)  # x 1
    pose = nested(1, nested(1, vec)) + b"\x11" + struct.pack("<Q", 7)  # pose 1, timestamp_us 2
    answer = nested(2, nested(1, pose)) + b"\x20\x01"  # trajectory 2: poses 1; terminate_session 4
    read = messages().DriveResponse.FromString(answer)
    (pose,) = read.trajectory.poses
    assert (pose.pose.vec.x, pose.timestamp_us, read.terminate_session) == (1.5, 7, True)


@pytest.mark.parametrize(
    "q", [(1.0, 0, 0, 0), (0.5, -0.5, 0.5, -0.5), (0.0, 0, 1, 0), (0.6, 0, 0, 0.8)]
)
def test_rotations_become_quaternions(q):
    found = np.array(_quaternion(quaternion_to_matrix(np.array(q))))
    assert min(np.abs(found - q).max(), np.abs(found + q).max()) < 1e-12
