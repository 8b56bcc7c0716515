"""CARLA leaderboard agents, without CARLA."""

from __future__ import annotations

import math
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from real2sim.planners import load_planner, needs_of
from real2sim.planners._carla import STUBS, PinholeView, VehicleControl, lookup_of
from real2sim.planners.carla_agent import (
    CarlaAgent,
    camera_rotation,
    command_of,
    geographic,
    global_plan,
    imu,
    wanted_view,
)
from real2sim.planners.peer import PeerError
from real2sim_proto.scenes import CameraInfo

from . import rig, road

AGENT = '''
import carla
from leaderboard.autoagents.autonomous_agent import AutonomousAgent, Track


def get_entry_point():
    return "Straight"


class Straight(AutonomousAgent):
    """Leaderboard 2: made with a host, set up later."""

    def setup(self, path_to_conf_file):
        self.track, self.config, self.seen = Track.SENSORS, path_to_conf_file, []

    def sensors(self):
        return [
            {"type": "sensor.camera.rgb", "x": 0.7, "y": 0.0, "z": 1.6, "roll": 0.0, "pitch": 0.0,
             "yaw": 0.0, "width": 16, "height": 12, "fov": 8, "id": "Middle"},
            {"type": "sensor.other.gnss", "x": 0.0, "y": 0.0, "z": 0.0, "id": "GPS"},
            {"type": "sensor.other.imu", "x": 0.0, "y": 0.0, "z": 0.0, "roll": 0.0, "pitch": 0.0,
             "yaw": 0.0, "id": "IMU"},
            {"type": "sensor.speedometer", "reading_frequency": 20, "id": "Speed"},
        ]

    def run_step(self, input_data, timestamp):
        self.seen.append((input_data, timestamp))
        return carla.VehicleControl(throttle=0.5, steer=-0.25, brake=0.0)
'''

OLDER = (
    AGENT.replace("class Straight", "class Older").replace('"Straight"', '"Older"')
    + """
    def __init__(self, path_to_conf_file):
        super().__init__()
        self.setup(path_to_conf_file)
"""
)


@pytest.fixture(autouse=True)
def modules_as_before():
    before = dict(sys.modules)
    yield
    for name in set(sys.modules) - set(before):
        if name.partition(".")[0] in {"carla", "agents", "leaderboard", "agent", "older"}:
            del sys.modules[name]


@pytest.fixture
def agent_file(tmp_path: Path) -> Path:
    file = tmp_path / "agent.py"
    file.write_text(AGENT)
    return file


@pytest.fixture
def planner(agent_file: Path) -> CarlaAgent:
    found = load_planner(f"carla={agent_file}?config=weights.yaml&lat=0&lon=0")
    assert isinstance(found, CarlaAgent)
    return found


def cameras(**directions: float) -> list[CameraInfo]:
    return [
        CameraInfo(
            name=name,
            width=48,
            height=32,
            K=rig.K.tolist(),
            T_vehicle_camera=rig.camera_on_vehicle(degrees).tolist(),
        )
        for name, degrees in directions.items()
    ]


def test_an_agent_drives_on_its_sensor_inputs(planner):
    obs = rig.seen(yaw=0.0, speed=6.0)
    planner.reset(obs)
    command = planner.plan(obs)
    (inputs, timestamp) = planner._agent.seen[0]

    assert (timestamp, planner._agent.config) == (0.0, "weights.yaml")
    frame, picture = inputs["Middle"]
    assert (frame, picture.shape, picture.dtype) == (obs.step, (12, 16, 4), np.uint8)
    assert (picture[..., 3] == 255).all()
    assert (picture[..., :3] == 0).all()  # From the front camera, with level 0.
    assert inputs["Speed"][1] == {"speed": 6.0}
    assert inputs["IMU"][1].shape == (7,)
    lat, lon, _ = inputs["GPS"][1]
    # 100 m east and 50 m north of the origin at the equator. The vehicle centre is 1.35 m ahead.
    ahead = obs.ego.size[0] / 2 - 0.95
    assert lon == pytest.approx(math.degrees((100 + ahead) / 6378137.0), rel=1e-9)
    assert lat == pytest.approx(math.degrees(50 / 6378137.0), rel=1e-6)
    assert command.steering > 0
    assert command.acceleration > 1.0


def test_agents_for_the_first_leaderboard_are_set_up(tmp_path):
    file = tmp_path / "older.py"
    file.write_text(OLDER)
    planner = CarlaAgent(f"{file}?config=a.yaml")
    planner.reset(rig.seen())

    assert planner._agent.config == "a.yaml"


def test_each_episode_has_a_new_agent(planner):
    planner.reset(rig.seen())
    first = planner._agent
    planner.reset(rig.seen())

    assert planner._agent is not first


def test_a_matching_camera_is_requested_at_the_needed_width(planner):
    sensors = needs_of(planner).sensors(cameras(front=0.0, left=50.0, back=180.0))
    # The agent needs a focal length of 114 px. The camera has 300 px.
    assert sensors == [{"camera": "front", "modalities": ["rgb"], "width": 19}]


def test_an_agent_camera_without_coverage_is_refused(planner):
    with pytest.raises(PeerError, match=r"'Middle' looks where .*back.* see 0%"):
        needs_of(planner).sensors(cameras(back=180.0))


def test_an_unsupported_sensor_is_refused(tmp_path):
    file = tmp_path / "agent.py"
    file.write_text(AGENT.replace("sensor.other.imu", "sensor.lidar.ray_cast"))
    with pytest.raises(PeerError, match=r"'IMU' is an unsupported 'sensor.lidar.ray_cast'"):
        CarlaAgent(str(file))


@pytest.mark.parametrize(
    ("target", "sentence"),
    [("nowhere.py", "no file 'nowhere.py'"), ("no_module:Agent", "no_module")],
)
def test_an_agent_that_cannot_be_loaded_is_named(target, sentence):
    with pytest.raises(PeerError, match=sentence):
        CarlaAgent(target)


def test_installed_modules_are_not_replaced(agent_file, monkeypatch):
    own = types.ModuleType("carla")
    own.VehicleControl = VehicleControl
    monkeypatch.setitem(sys.modules, "carla", own)
    CarlaAgent(str(agent_file))

    assert sys.modules["carla"] is own
    assert set(STUBS) <= set(sys.modules)


def test_the_route_is_converted_to_carla_conventions(planner):
    route = np.zeros((61, 4))
    route[:, 0], route[:, 2] = np.arange(61.0), 3.0
    route[30:, 3] = np.pi / 2
    in_degrees, in_world = global_plan(route, 0.0, 0.0)
    options = [option.name for _, option in in_world]

    first, last = in_world[0][0], in_world[-1][0]
    assert (first.location.x, first.location.y, first.location.z) == (0.0, 0.0, 3.0)
    # Left of x is -y in Unreal.
    assert last.rotation.yaw == pytest.approx(-90.0)
    assert options[0] == options[-1] == "LANEFOLLOW"
    assert options[30] == "LEFT"
    assert in_degrees[1][0]["lon"] == pytest.approx(math.degrees(1 / 6378137.0))
    planner.reset(rig.seen())
    planner._agent.set_global_plan(in_degrees, in_world)
    assert 3 <= len(planner._agent._global_plan) < 10


def test_the_session_route_is_passed_to_the_agent(planner):
    planner.begin(types.SimpleNamespace(route=np.array([[0, 0, 0, 0], [5.0, 2.0, 1.0, 0.0]])))
    planner.reset(rig.seen())
    ends = [pose.location for pose, _ in planner._agent._global_plan_world_coord]

    assert [(p.x, p.y, p.z) for p in ends] == [(0.0, 0.0, 0.0), (5.0, -2.0, 1.0)]


@pytest.mark.parametrize(
    ("angles", "axis", "direction"),
    [
        ((0, 0, 0), 2, (1, 0, 0)),  # forward
        ((0, 90, 0), 2, (0, -1, 0)),  # yaw: to the right
        ((90, 0, 0), 2, (0, 0, 1)),  # pitch: up
        ((0, 0, 90), 0, (0, 0, -1)),  # roll: the right side down
        ((0, 0, 0), 0, (0, -1, 0)),
        ((0, 0, 0), 1, (0, 0, -1)),
    ],
)
def test_camera_angles_follow_the_unreal_convention(angles, axis, direction):
    R = camera_rotation(*map(math.radians, angles))

    assert R[:, axis] == pytest.approx(direction, abs=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)


def test_the_field_of_view_is_horizontal():
    view = wanted_view({"width": 800, "height": 600, "fov": 90})

    assert view.K[0, 0] == view.K[1, 1] == pytest.approx(400.0)


def test_reprojected_images_keep_directions(planner):
    # Between two cameras: the left half comes from the left one, the right half from the right one.
    wide = np.array([[24.0, 0, 24], [0, 24.0, 16], [0, 0, 1]])
    left, right = (PinholeView(wide, (48, 32), rig.turned(d) @ rig.FORWARD) for d in (45, -45))
    wanted = PinholeView(wide, (48, 32), rig.FORWARD)
    images = {
        "left": np.full((32, 48, 3), 90, np.uint8),
        "right": np.full((32, 48, 3), 9, np.uint8),
    }
    lookup = lookup_of(wanted, {"left": left, "right": right})
    seen = lookup.image(images)

    assert lookup.covered > 0.6
    assert (seen[16, :23] == 90).all()
    assert (seen[16, 25:] == 9).all()


def test_a_pixel_is_sampled_along_its_ray():
    K = np.array([[100.0, 0, 50], [0, 100.0, 40], [0, 0, 1]])
    there = PinholeView(K, (100, 80), rig.FORWARD)
    ramp = np.repeat(np.arange(100, dtype=np.uint8)[None, :, None], 80, 0).repeat(3, 2)
    same = lookup_of(there, {"front": there}).image({"front": ramp})
    half = PinholeView(np.diag([0.5, 0.5, 1]) @ K, (50, 40), rig.FORWARD)
    smaller = lookup_of(half, {"front": there}).image({"front": ramp})

    assert np.array_equal(same, ramp)
    assert np.abs(smaller[20, :, 0] - (2 * np.arange(50) + 0.5)).max() <= 0.5


def test_imu_compass_is_zero_at_north_and_gravity_points_up():
    east = imu(road.observation(road.STRAIGHT, yaw=0.0, speed=5.0).ego)
    north = imu(road.observation(road.STRAIGHT, yaw=math.pi / 2, speed=5.0).ego)

    assert east[6] == pytest.approx(math.pi / 2)
    assert north[6] == pytest.approx(0.0)
    assert east[2] == pytest.approx(9.81)


def test_gnss_uses_the_mercator_projection():
    lat, lon = geographic(1000.0, 500.0, 42.0, 2.0)

    # One degree of latitude is 111.3 km. For longitude, multiply by the cosine of the latitude.
    assert lat - 42 == pytest.approx(500 / 111_319.5, rel=1e-3)
    assert lon - 2 == pytest.approx(1000 / 111_319.5 / math.cos(math.radians(42)), rel=1e-6)


@pytest.mark.parametrize(
    ("control", "speed", "acceleration"),
    [
        ({"throttle": 1.0}, 0.0, 4.0 - 0.15),
        ({"throttle": 1.0}, 25.0, 2.0 - 0.15 - 6e-4 * 625),
        ({}, 10.0, -0.15 - 0.06),
        ({"brake": 0.5}, 0.0, -4.0),
        ({"throttle": 1.0, "hand_brake": True}, 0.0, -4.0),
        ({"throttle": 7.0}, 0.0, 3.85),
    ],
)
def test_throttle_and_brake_are_converted_to_accelerations(control, speed, acceleration):
    assert command_of(VehicleControl(**control), speed).acceleration == pytest.approx(acceleration)


def test_positive_steering_is_right_and_decreases_with_speed():
    slow = command_of(VehicleControl(steer=0.5), 0.0)
    fast = command_of(VehicleControl(steer=0.5), 120 / 3.6)

    assert slow.steering == pytest.approx(-math.radians(35))
    assert fast.steering == pytest.approx(0.7 * slow.steering)


def test_reverse_sets_the_gear():
    assert command_of(VehicleControl(throttle=0.5, reverse=True), 0.0).gear == "reverse"
    assert command_of(VehicleControl(throttle=0.5), 0.0).gear == "drive"


@pytest.mark.parametrize("answer", [None, VehicleControl(throttle=math.nan), {"throttle": 1.0}])
def test_an_invalid_control_is_refused(answer):
    with pytest.raises(PeerError, match="run_step answers"):
        command_of(answer, 0.0)
