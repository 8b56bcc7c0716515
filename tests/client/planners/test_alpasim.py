"""The AlpaSim planner adapter against a small local EgodriverService."""

from __future__ import annotations

import dataclasses
import math
import struct
from concurrent.futures import ThreadPoolExecutor

import cv2
import grpc
import numpy as np
import pytest

from real2sim._alpasim import DRIVER, DRIVER_METHODS, Ftheta, messages
from real2sim._session_state import quaternion_of
from real2sim.planners import load_planner, needs_of
from real2sim.planners.alpasim import AlpasimDriver
from real2sim.planners.peer import PeerError
from real2sim_proto.scenes import CameraInfo
from real2sim_server.geometry import quaternion_to_matrix
from tests.waiting import LIMIT_S

from . import rig

pytestmark = pytest.mark.network


class Driver:
    """Drives straight along x of its local frame, and records all requests.

    Refuses the same requests as NVIDIA's service: sessions without its cameras, images of other
    cameras, and with rectification, images of cameras that are not f-theta.
    """

    def __init__(self):
        self.asked: list[tuple[str, object]] = []
        self.answer = self.way(1.0, 2.0, 3.0)
        self.wants: list[str] = []
        self.rectifies = self.short_of_past = False

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
        def handle(asked, context):
            if refused := self.refusal(name, asked):
                context.abort(*refused)
            self.asked.append((name, asked))
            return self.answer if name == "drive" else getattr(messages(), answer)()

        return grpc.unary_unary_rpc_method_handler(
            handle,
            request_deserializer=getattr(messages(), request).FromString,
            response_serializer=getattr(messages(), answer).SerializeToString,
        )

    def refusal(self, name: str, asked):
        if name == "start_session":
            self.cameras = asked.rollout_spec.vehicle.available_cameras
            missing = sorted({*self.wants} - {c.logical_id for c in self.cameras})
            text = f"Unexpected <class 'ValueError'>: Requested cameras {missing} are missing"
            return missing and (grpc.StatusCode.UNKNOWN, text)
        if name == "submit_image_observation":
            given = asked.camera_image.logical_id
            if self.wants and given not in self.wants:
                return (grpc.StatusCode.UNKNOWN, f"Camera {given} not in desired cameras")
            if self.rectifies and not all(
                c.intrinsics.HasField("ftheta_param") for c in self.cameras
            ):
                text = f"Camera {given} does not provide f-theta intrinsics"
                return (grpc.StatusCode.UNKNOWN, text)
        if name == "drive" and self.short_of_past:
            return (grpc.StatusCode.FAILED_PRECONDITION, "ego pose history is too short")
        return None


@pytest.fixture
def driver():
    peer = Driver()
    server = grpc.server(ThreadPoolExecutor(2))
    handlers = {name: peer.handler(name, *pair) for name, pair in DRIVER_METHODS.items()}
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(DRIVER, handlers),))
    peer.target = f"127.0.0.1:{server.add_insecure_port('127.0.0.1:0')}"
    server.start()
    yield peer
    server.stop(None).wait()


@pytest.fixture
def planner(driver):
    planner = AlpasimDriver(driver.target, seed=7, timeout=LIMIT_S)
    planner.reset(rig.seen())
    yield planner
    planner.close()


def asked(driver, name):
    return [request for kind, request in driver.asked if kind == name]


def sessions(driver):
    """Sessions for driving, without those that only query cameras."""
    begun = asked(driver, "start_session")
    return [request for request in begun if request.rollout_spec.vehicle.available_cameras]


def reached(driver, suffix="", **options):
    return AlpasimDriver(driver.target + suffix, timeout=LIMIT_S, **options)


def test_the_planner_is_found_by_name_and_needs_all_cameras(driver):
    planner = load_planner(f"alpasim={driver.target}")
    assert needs_of(planner).all_cameras
    planner.close()


def test_future_poses_are_returned_in_world_coordinates(planner):
    plan = planner.plan(rig.seen())
    assert plan.frame == "world"
    assert plan.times_us == [1_200_000, 1_400_000]
    # The local frame of the driver starts at the initial pose of the episode.
    assert [p[:2] for p in plan.poses] == [(102.0, 49.0), (103.0, 49.0)]
    assert [p[2] for p in plan.poses] == pytest.approx([0.2, 0.2], abs=1e-6)


def test_the_session_contains_cameras_and_seed(driver, planner):
    (request,) = sessions(driver)
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


def test_each_step_sends_images_egomotion_and_route_before_drive(driver, planner):
    planner.plan(rig.seen(position=(103.0, 50.0, 2.0), acceleration=-1.5, yaw_rate=0.1))
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
    acceleration = state.linear_acceleration
    assert (acceleration.x, acceleration.y) == pytest.approx((-1.5, 0.6))
    (route,) = asked(driver, "submit_route")
    waypoints = [p.x for p in route.route.waypoints]
    assert waypoints == pytest.approx(np.linspace(0.0, 80.0, 20), abs=1e-3)
    (drive,) = asked(driver, "drive")
    assert (drive.time_now_us, drive.time_query_us) == (1_000_000, 1_100_000)
    driven = driver.asked[driver.asked.index(("start_session", sessions(driver)[0])) :]
    assert len({r.session_uuid for _, r in driven if hasattr(r, "session_uuid")}) == 1


def test_a_new_episode_closes_the_previous_session(driver, planner):
    planner.reset(rig.seen())
    first, second = (r.session_uuid for r in sessions(driver))
    assert asked(driver, "close_session")[-1].session_uuid == first
    assert first != second


@pytest.mark.parametrize(
    ("way", "said"),
    [
        (((1.0,), {}), "plans nothing after 1000000 us"),
        (((1.0, math.nan), {}), "not finite"),
        (((1.0, 2.0), {"terminate": True}), "ends the session"),
    ],
)
def test_invalid_trajectories_are_refused(driver, planner, way, said):
    xs, options = way
    driver.answer = driver.way(*xs, **options)
    with pytest.raises(PeerError, match=said):
        planner.plan(rig.seen())


def test_an_unreachable_driver_is_named_by_address():
    with pytest.raises(PeerError, match=r"get_version of the driver at 127\.0\.0\.1:9 failed"):
        AlpasimDriver("127.0.0.1:9", timeout=0.3)


FRONT, LEFT = "camera_front_wide_120fov", "camera_cross_left_120fov"


@pytest.fixture
def infos():
    return [
        CameraInfo(
            name=name,
            width=48,
            height=32,
            K=rig.K.tolist(),
            T_vehicle_camera=rig.camera_on_vehicle(degrees).tolist(),
        )
        for name, degrees in rig.CAMERAS.items()
    ]


def shown(driver):
    return [i.camera_image.logical_id for i in asked(driver, "submit_image_observation")]


def test_a_driver_gets_the_cameras_it_requires_under_its_names(driver, infos):
    driver.wants = [LEFT, FRONT]
    planner = reached(driver)
    assert [s["camera"] for s in planner.needs.sensors(infos)] == ["left", "front"]
    planner.reset(rig.seen())
    planner.plan(rig.seen())
    assert sorted(shown(driver)) == sorted([LEFT, FRONT])
    (session,) = sessions(driver)
    cameras = {c.logical_id: c for c in session.rollout_spec.vehicle.available_cameras}
    assert set(cameras) == {LEFT, FRONT}
    v, expected = cameras[LEFT].rig_to_camera.quat, rig.camera_on_vehicle(50.0)
    rotation = quaternion_to_matrix(np.array([v.w, v.x, v.y, v.z]))
    np.testing.assert_allclose(rotation, expected[:3, :3], atol=1e-6)
    planner.close()


def test_one_camera_serves_as_wide_and_tele(driver, infos):
    driver.wants = [FRONT, "camera_front_tele_30fov"]
    planner = reached(driver)
    assert [s["camera"] for s in planner.needs.sensors(infos)] == ["front"]
    planner.reset(rig.seen())
    planner.plan(rig.seen())
    assert sorted(shown(driver)) == sorted(driver.wants)
    planner.close()


def test_cameras_are_mapped_in_the_target(driver, infos):
    driver.wants = ["middle", FRONT]
    planner = load_planner(f"alpasim={driver.target}?cameras=middle:CAM_BACK,{FRONT}")
    assert [s["camera"] for s in needs_of(planner).sensors(infos)] == ["CAM_BACK", "front"]
    planner.close()


@pytest.mark.parametrize(
    ("wanted", "suffix", "said"),
    [
        ("middle", "", "matches none of front, left, CAM_BACK"),
        ("camera_cross_right_120fov", "", "none of front, left faces that direction"),
        ("middle", "?cameras=middle:roof", "camera 'roof', given for 'middle', does not exist"),
    ],
)
def test_a_required_camera_without_a_match_is_named(driver, infos, wanted, suffix, said):
    driver.wants = [wanted]
    planner = reached(driver, suffix)
    cameras = infos if "CAM_BACK" in said else infos[:2]
    with pytest.raises(PeerError, match=said):
        planner.needs.sensors(cameras)
    planner.close()


def test_an_unknown_target_option_is_refused(driver):
    with pytest.raises(ValueError, match=r"option 'camera' of .* is unknown; there is: cameras"):
        reached(driver, "?camera=front")


@pytest.mark.parametrize("refused", [False, True])
def test_the_vehicle_follows_its_route_until_the_driver_has_its_context(driver, planner, refused):
    driver.answer, driver.short_of_past = messages().DriveResponse(), refused
    plan = planner.plan(rig.seen(speed=6.0))
    assert plan.frame == "vehicle"
    assert plan.times_us[-1] == 4_000_000
    assert plan.poses[-1][0] == pytest.approx(18.0, abs=0.01)
    driver.answer, driver.short_of_past = driver.way(1.0, 2.0), False
    assert planner.plan(rig.seen()).frame == "world"
    # After the first plan, an empty one is an error.
    driver.answer = messages().DriveResponse()
    with pytest.raises(PeerError, match="plans nothing"):
        planner.plan(rig.seen())


def test_a_driver_that_never_plans_is_given_up(driver):
    planner = reached(driver, patience=2)
    planner.reset(rig.seen())
    driver.answer = messages().DriveResponse()
    planner.plan(rig.seen(warming_up=True))
    for _ in range(2):
        planner.plan(rig.seen())
    with pytest.raises(PeerError, match="has no plan after 3 observations: an empty trajectory"):
        planner.plan(rig.seen())
    planner.close()


def test_a_rectifying_driver_gets_f_theta_cameras(driver, planner):
    driver.rectifies = True
    planner.plan(rig.seen())
    assert len(sessions(driver)) == 2
    (camera,) = [c for c in driver.cameras if c.logical_id == "front"]
    lens = camera.intrinsics.ftheta_param
    angles = np.linspace(0.0, lens.max_angle, 50)
    pixels = np.polynomial.polynomial.polyval(angles, lens.angle_to_pixeldist_poly)
    np.testing.assert_allclose(pixels, 310.0 * np.tan(angles), atol=1e-6)
    assert lens.linear_cde.linear_c == pytest.approx(300.0 / 310.0)
    assert len(shown(driver)) == 3


@pytest.mark.parametrize("field", [30, 70, 120])
def test_an_f_theta_fit_reproduces_a_pinhole(field):
    focal = 960.0 / math.tan(math.radians(field / 2))
    K = np.array([[focal, 0, 960.0], [0, focal, 540.0], [0, 0, 1]])
    lens = Ftheta.of(K, 1920, 1080)
    angles = np.linspace(0.0, lens.max_angle, 333)
    exact = focal * np.tan(angles)
    there = np.polynomial.polynomial.polyval(angles, lens.angle_to_pixels)
    np.testing.assert_allclose(there, exact, atol=0.02)
    back = np.polynomial.polynomial.polyval(exact, lens.pixels_to_angle)
    np.testing.assert_allclose(back * focal, angles * focal, atol=0.02)


def test_a_short_route_is_padded_with_nan(driver, planner):
    short = dataclasses.replace(rig.seen(), route=np.array([[2.0, 0.0], [10.0, 0.0]]))
    planner.plan(short)
    (route,) = asked(driver, "submit_route")
    xs = [p.x for p in route.route.waypoints]
    assert xs[:3] == pytest.approx([0.0, 80 / 19, 160 / 19])
    assert len(xs) == 20
    assert all(math.isnan(x) for x in xs[3:])


def test_the_query_time_follows_the_observation_interval(driver, planner):
    planner.plan(rig.seen())
    planner.plan(dataclasses.replace(rig.seen(), t_us=1_050_000))
    first, second = asked(driver, "drive")
    assert second.time_query_us - second.time_now_us == 50_000
    assert first.time_query_us - first.time_now_us == 100_000


def nested(number: int, content: bytes) -> bytes:
    return bytes([number << 3 | 2, len(content)]) + content


def test_messages_use_the_field_numbers_of_alpasim():
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
def test_rotation_matrices_are_converted_to_quaternions(q):
    found = np.array(quaternion_of(quaternion_to_matrix(np.array(q))))
    assert min(np.abs(found - q).max(), np.abs(found + q).max()) < 1e-12
