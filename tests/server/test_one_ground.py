"""All that stands, drives, falls or is told asks one ground."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient

from real2sim_proto.base import Pose
from real2sim_proto.episode import ResetSpec
from real2sim_proto.operations import SetPose
from real2sim_proto.plans import PoseCommand
from real2sim_server.cli.scene import ground as ground_command
from real2sim_server.demo.street import unpack_street
from real2sim_server.edit import ScenarioState, apply_operations
from real2sim_server.reconstruct import InitialiseOptions
from real2sim_server.reconstruct.initialise.stage0 import initialise_scene
from real2sim_server.scene import Scene
from real2sim_server.scene.io import load_scene, save_scene
from real2sim_server.service.app import create_app
from real2sim_server.service.rollouts import colliders_of
from real2sim_server.settings import Settings
from real2sim_server.simulation.experiments import scene_road
from real2sim_server.simulation.rigid import clearance
from real2sim_server.synthetic import CameraSpec, SyntheticConfig, generate_log
from real2sim_server.synthetic.street import FACADE, KERB, KERB_HEIGHT
from real2sim_server.world import World

MILLIMETRE = 1e-3
NAME = "street"
CONFIG = SyntheticConfig(
    seed=3,
    frames=6,
    width=96,
    height=64,
    cameras=(CameraSpec("front"),),
    samples=1,
    lidar_columns=720,
)
SMALL = InitialiseOptions(max_background=30_000, max_object=500, sky_resolution=16)


@pytest.fixture(scope="module", params=["shipped", "synthetic"])
def folder(request, tmp_path_factory) -> Path:
    """A folder of scenes that holds one."""
    scenes: Path = tmp_path_factory.mktemp("scenes")
    if request.param == "shipped":
        unpack_street(scenes, NAME)
    else:
        save_scene(initialise_scene(generate_log(CONFIG), options=SMALL), scenes / NAME)
    return scenes


@pytest.fixture(scope="module")
def scene(folder) -> Scene:
    return load_scene(folder / NAME)


@pytest.fixture(scope="module")
def places(scene) -> dict[str, tuple[float, float]]:
    """Where objects are at the first and the last frame, at most eight."""
    found = {}
    for t_us in scene.frame_times_us[[0, -1]].tolist():
        for object_id, item in scene.objects.items():
            if item.trajectory.covers(t_us):
                x, y, _ = item.trajectory.pose(t_us)[0].tolist()
                found[object_id] = (x, y)
    return dict(list(found.items())[:8])


def snapped_by_an_edit(scene, places) -> dict[str, float]:
    state = ScenarioState.of(scene)
    return {k: _bottom(state, k, *at) for k, at in places.items()}


def _bottom(state: ScenarioState, object_id: str, x: float, y: float) -> float:
    there = SetPose(object_id=object_id, pose=Pose(position=(x, y, 50.0)), snap=True)
    after = apply_operations(state, [there]).state.objects[object_id]
    return float(after.trajectory.positions[0, 2]) - after.scaled_size[2] / 2


def driven_over_in_a_world(scene, places) -> dict[str, float]:
    spec = ResetSpec(action="pose", on_collision="continue")
    begun = World(scene, ScenarioState.of(scene), spec)
    heights = {}
    for object_id, (x, y) in places.items():
        world = begun.fork()
        world.step(PoseCommand(x=x, y=y, yaw=0.3))
        assert world.T_world_vehicle[:2, 3].tolist() == pytest.approx([x, y])
        heights[object_id] = float(world.T_world_vehicle[2, 3])
    return heights


def below_what_is_simulated(scene, places) -> dict[str, float]:
    state = ScenarioState.of(scene)
    return _of_collider(scene_road(scene, state, int(scene.frame_times_us[0])), places)


def below_what_a_service_simulates(scene, places) -> dict[str, float]:
    [ground] = colliders_of(ScenarioState.of(scene))
    return _of_collider(ground, places)


def _of_collider(collider, places) -> dict[str, float]:
    at = np.array([[x, y, 0.0] for x, y in places.values()])
    distance, normal = clearance(collider, at)
    return dict(zip(places, (-distance / normal[:, 2]).tolist(), strict=True))


ASKED: dict[str, Callable[[Scene, dict], dict[str, float]]] = {
    "edit": snapped_by_an_edit,
    "world": driven_over_in_a_world,
    "simulate": below_what_is_simulated,
    "service's simulation": below_what_a_service_simulates,
}


@pytest.mark.parametrize("asked", ASKED)
def test_packages_that_ask_find_the_scenes_ground(scene, places, asked):
    found = ASKED[asked](scene, places)

    expected = scene.ground.height_at(np.array(list(places.values())))
    assert list(found) == list(places)
    np.testing.assert_allclose(list(found.values()), expected, atol=MILLIMETRE)


@pytest.fixture
def client(folder, tmp_path) -> Iterator[TestClient]:
    settings = Settings(
        data_dir=tmp_path / "data",
        scenes_dir=folder,
        import_root=tmp_path,
        port=0,
        backend="cpu",
        log_level="error",
    )
    with TestClient(create_app(settings), base_url="http://127.0.0.1") as running:
        yield running


def test_the_service_puts_objects_onto_the_scenes_ground(scene, places, client):
    made = client.post("/v1/scenarios", json={"scene": NAME}).json()
    url = f"/v1/scenarios/{made['scenario_id']}"
    operations = [
        {"op": "set_pose", "object_id": k, "pose": {"position": [*at, 50.0]}, "snap": True}
        for k, at in places.items()
    ]
    assert client.post(f"{url}/operations", json={"operations": operations}).status_code == 200

    shown = {o["object_id"]: o for o in client.get(url).json()["objects"]}
    bottoms = [shown[k]["trajectory"]["positions"][0][2] - shown[k]["size"][2] / 2 for k in places]
    expected = scene.ground.height_at(np.array(list(places.values())))
    np.testing.assert_allclose(bottoms, expected, atol=MILLIMETRE)


def test_the_command_tells_the_scenes_ground(scene, folder, tmp_path):
    ground_command(scene=folder / NAME, frame=0, json=tmp_path / "ground.json")

    t_us = int(scene.frame_times_us[0])
    told = json.loads((tmp_path / "ground.json").read_text())["ground under objects [m]"]
    assert told
    for object_id, height in told.items():
        x, y, _ = scene.object(object_id).trajectory.pose(t_us)[0].tolist()
        assert height == pytest.approx(scene.ground.height(x, y), abs=MILLIMETRE)


def test_recorded_poses_stand_on_the_ground(scene):
    for t_us in scene.frame_times_us.tolist():
        recorded = scene.ego.transform(t_us)
        x, y = recorded[:2, 3].tolist()
        yaw = float(np.arctan2(recorded[1, 0], recorded[0, 0]))
        stood = scene.ground.pose_on(x, y, yaw)
        np.testing.assert_allclose(stood[:3, 3], recorded[:3, 3], atol=0.01)
        np.testing.assert_allclose(stood[:3, 2], recorded[:3, 2], atol=0.01)


@pytest.mark.slow
def test_a_log_of_a_known_street_gives_its_true_heights():
    log = generate_log(CONFIG)
    street = log.source.drive.street
    ground = initialise_scene(log, options=SMALL).ground
    s, d = np.meshgrid(np.arange(-5.0, 25.0, 0.5), np.arange(-8.75, 9.0, 0.25))
    off_kerb = np.abs(np.abs(d) - KERB) > 0.4
    s, d = s[off_kerb], d[off_kerb]
    assert np.abs(d).max() < FACADE
    apart = ground.height_at(street.point(s, d)) - np.where(np.abs(d) < KERB, 0.0, KERB_HEIGHT)

    on_road = np.abs(d) < KERB
    assert np.sqrt((apart[on_road] ** 2).mean()) < 0.01
    assert np.abs(apart[on_road]).max() < 0.05
    assert np.sqrt((apart**2).mean()) < 0.04
