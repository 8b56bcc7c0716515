"""LiDAR sweeps and radar scans of moving worlds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_proto.episode import ResetSpec
from real2sim_proto.operations import Translate
from real2sim_proto.plans import Control
from real2sim_proto.sensors import LidarModel, SpinningBeams
from real2sim_server.edit import ScenarioState
from real2sim_server.geometry import quaternion_to_matrix, yaw_quaternion
from real2sim_server.render.cast import select_caster
from real2sim_server.scene import GaussianCloud, LidarSurfaces, Reflector
from real2sim_server.world import World, WorldError
from real2sim_server.world.sensing import clouds_of, recorded_cloud

SPEED = 15.0
WALL_AT = 40.0
BEAMS = SpinningBeams(kind="spinning", elevation_deg=[-1.0, 1.0, 3.0], columns=180)
LIDAR = {"lidar": "top", "model": LidarModel(name="fan", beams=BEAMS, detection={"range_m": 2000})}
QUIET = {"clutter_rate": 0, "range_noise_m": 0, "azimuth_noise_deg": 0, "velocity_noise_mps": 0}


def wall(x: float, *, half: float = 12.0) -> GaussianCloud:
    """A wall across the road that faces -x."""
    y, z = (g.ravel() for g in np.meshgrid(np.arange(-half, half, 0.2), np.arange(-3, 6, 0.2)))
    n = len(y)
    parts = (
        np.stack([np.full(n, x), y, z], axis=1),
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.tile([1e-4, 0.2, 0.2], (n, 1)),
        np.full(n, 0.95),
        np.zeros((n, 1, 3)),
    )
    return GaussianCloud(*(torch.from_numpy(part.astype(np.float32)) for part in parts))


@pytest.fixture(scope="module")
def drive(make_scene, moving):
    """Make a world after some steps at SPEED towards a wall, behind a car."""

    def make(steps=2, *, background=None, car=None, **spec):
        scene = make_scene(moving(speed=SPEED), car=car or moving(20, 0, z=0.8, speed=8.0))
        background = background or wall(WALL_AT)
        # The car's rear is a wall in the object frame.
        body = wall(-2.0, half=1.0)
        objects = {"car": replace(scene.objects["car"], cloud=body)}
        scene = replace(scene, background=background, objects=objects)
        spec = {"dt_us": 50_000, "action": "control", "lidars": [LIDAR]} | spec
        world = World(scene, ScenarioState.of(scene), ResetSpec(**spec))
        for _ in range(steps):
            world.step(Control(acceleration=0.0, steering=0.0))
        return world

    return make


def cloud(world, number=0):
    return clouds_of(world, [world.ranging.all[number]], select_caster())[0]


def on_wall(found):
    return found.columns["instance"] == 0


def world_points(found):
    points, pose = found.columns["points"].astype(float), found.T_world_sensor
    return points @ pose[:3, :3].T + pose[:3, 3]


def test_ego_poses_are_interpolated_between_instants(drive):
    world = drive(0, randomization={"start": {"heading": 0.3}}, seed=3)
    poses = [world.T_world_body]
    for _ in range(2):
        world.step(Control(acceleration=1.0, steering=0.3))
        poses.append(world.T_world_body)
    times = world.t_us - np.array([100_000.0, 75_000, 50_000, 25_000, 0])
    found = world.motion_history.ego_poses(
        times, t_us=world.t_us, now=world.T_world_body, twist=world.twist
    )
    np.testing.assert_allclose(found[::2], poses, atol=1e-9)
    middle = (poses[0][:3, 3] + poses[1][:3, 3]) / 2
    np.testing.assert_allclose(found[1][:3, 3], middle, atol=1e-9)


def test_the_motion_history_covers_the_longest_sweep(drive):
    world = drive(9)
    assert len(world.motion_history.segments) == 2
    assert world.motion_history.segments[-1].until_us == world.t_us


def test_only_compensated_points_lie_on_the_wall(drive):
    world = drive()
    assert [mounted.name for mounted in world.due_ranging()] == ["top"]
    found = cloud(world)
    points = world_points(found)[on_wall(found)]
    assert len(points) > 20
    assert np.abs(points[:, 0] - WALL_AT).max() < 2e-3
    raw = cloud(drive(lidars=[LIDAR | {"compensated": False}]))
    off = world_points(raw)[on_wall(raw), 0] - WALL_AT
    # The sensor faces ahead halfway through its 100 ms revolution.
    assert 0.4 < np.median(off) < 1.1


def test_objects_are_hit_at_the_firing_time_of_each_ray(drive):
    world = drive()
    found = cloud(world)
    own = ~on_wall(found)
    x = world_points(found)[own, 0]
    seconds = (world.t_us - 5_000_000 + found.columns["time_us"][own]) * 1e-6
    assert own.sum() > 5
    np.testing.assert_allclose(x, 18.0 + 8.0 * seconds, atol=5e-3)


def test_the_first_sweep_extrapolates_the_initial_motion(drive):
    world = drive(0)
    found = cloud(world)
    assert np.abs(world_points(found)[on_wall(found), 0] - WALL_AT).max() < 2e-3
    own = ~on_wall(found)
    expected = 18.0 + 8.0 * found.columns["time_us"][own] * 1e-6
    np.testing.assert_allclose(world_points(found)[own, 0], expected, atol=5e-3)


def test_edited_objects_are_not_interpolated(drive):
    world = drive(2, car=None)
    world.apply([Translate(object_id="car", x=6.0)])
    found = cloud(world)
    x = world_points(found)[~on_wall(found), 0]
    assert x.min() > 23.0
    world.step(Control(acceleration=0.0, steering=0.0))
    world.step(Control(acceleration=0.0, steering=0.0))
    found = cloud(world)
    assert world_points(found)[~on_wall(found), 0].min() > 24.0


def test_vehicle_frame_points_are_offset_by_the_sensor_mount(drive):
    sensor = cloud(drive())
    vehicle = cloud(drive(lidars=[LIDAR | {"frame": "vehicle"}]))
    shift = vehicle.columns["points"] - sensor.columns["points"]
    np.testing.assert_allclose(shift, np.tile([0.9, 0, 1.73], (len(shift), 1)), atol=1e-4)


def test_a_higher_rate_shortens_the_sweep(drive):
    world = drive(0, lidars=[LIDAR | {"rate_hz": 20.0}])
    (top,) = world.ranging.lidars
    assert top.period_us == 50_000
    assert 49_000 < top.duration_us < 50_000


def test_radar_measures_the_relative_speed(drive):
    fine = {"azimuth_resolution_deg": 0.5, "elevation_resolution_deg": 1.0}
    radar = {"radar": "front", "model": QUIET | fine}
    scan = cloud(drive(lidars=[], radars=[radar]))
    own = scan.columns["instance"] > 0
    assert own.any()
    ahead = np.cos(scan.columns["azimuth"]) * np.cos(scan.columns["elevation"])
    nearing = scan.columns["velocity"] / ahead
    np.testing.assert_allclose(nearing[own], 8.0 - SPEED, atol=0.02)
    np.testing.assert_allclose(nearing[~own], -SPEED, atol=0.05)


def test_recorded_and_closed_loop_sweeps_have_the_same_intensity(drive):
    """Both apply the lower intensity at oblique incidence."""
    world = drive(0)
    cloud = wall(10.0, half=10.0)  # incidence up to 45 degrees
    mirror = Reflector(cloud, torch.tensor([[0.8, 0.0]]).repeat(len(cloud), 1))
    scene = replace(world.scene, lidar=LidarSurfaces(mirror, incidence=0.0), objects={})
    state = ScenarioState.of(scene)
    moving = World(scene, state, world.spec)
    (mounted,) = moving.ranging.all
    caster = select_caster()
    shown = recorded_cloud(scene, state, mounted, moving.t_us, caster).columns["intensity"]
    assert shown.min() < 0.8 * shown.max()
    assert np.allclose(shown, clouds_of(moving, [mounted], caster)[0].columns["intensity"])


def test_periods_shorter_than_a_sweep_are_refused(drive):
    with pytest.raises(WorldError, match="a sweep takes"):
        drive(0, lidars=[LIDAR | {"period_us": 50_000}])
    table = {"kind": "table", "azimuth_deg": [0, 1], "elevation_deg": [0, 0]}
    slow = {"lidar": "slow", "model": {"name": "slow", "beams": table | {"time_us": [0, 2e6]}}}
    with pytest.raises(WorldError, match="1000000 us at most"):
        drive(0, lidars=[slow])


def test_interpolated_objects_keep_their_yaw(drive, moving):
    world = drive(2, car=moving(20, 0, z=0.8, yaw=0.4))
    times = np.array([world.t_us - 30_000.0, world.t_us])
    found = world.motion_history.object_poses("car", times, t_us=world.t_us, now=world.agents)
    turn = quaternion_to_matrix(yaw_quaternion(0.4))
    np.testing.assert_allclose(found[:, :3, :3], np.stack([turn, turn]), atol=1e-12)
