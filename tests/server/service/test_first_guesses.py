"""First guesses of users who know NumPy, Gymnasium, PyTorch, CARLA or the nuScenes devkit.

A guess works, or its error says what to write instead.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import real2sim
import real2sim.planners
from real2sim_server.scene.io import save_scene
from real2sim_server.service.serve import running_worker
from real2sim_server.settings import Settings

from ..conftest import make_tiny_scene

pytestmark = [
    pytest.mark.network,
    # Users who try something out do not close it.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

WORKS = """
Connect
    real2sim.connect(url).server().version                  | str
    real2sim.Client(url).readiness().ready                  | True
    real2sim.connect(url, timeout=10).scenes                | real2sim.Client(url).scenes.__class__
    real2sim.connect(url=url, token=None, name="anna")      | real2sim.Client
Scenes
    len(sim.scenes)                                         | 1
    list(sim.scenes)[0].scene                               | 'street'
    [s.scene for s in sim.scenes]                           | ['street']
    sim.scenes["street"].scene                              | 'street'
    sim.scenes[0].scene                                     | 'street'
    "street" in sim.scenes, "avenue" in sim.scenes          | (True, False)
    sim.scenes.get("street").end_us                         | 2_000_000
    scene.cameras["front"].width                            | 96
    scene.cameras[0].name                                   | 'front'
    scene.objects["car_red"].category                       | 'car'
    np.array(scene.cameras[0].K).shape                      | (3, 3)
    sim.scenes.render("street", "front").array.shape        | (64, 96, 3)
    sim.scenes.render("street", camera="front")             | real2sim.Image
    sim.scenes.render(scene, "front", t=1.0)                | real2sim.Image
    sim.scenes.render(scene, "front", t_us=1e6)             | real2sim.Image
    sim.scenes.render(scene, "front", modality="depth").array.dtype | np.dtype('float32')
Images
    np.asarray(image).shape                                 | (64, 96, 3)
    np.array(image, dtype=float).dtype                      | np.dtype(float)
    np.mean(image) > 0                                      | True
    image[10, 20].shape                                     | (3,)
    image[..., ::-1].shape                                  | (64, 96, 3)
    len(image)                                              | 64
    image.shape                                             | (64, 96, 3)
    image.save(folder / "front.png").name                   | 'front.png'
Observations
    obs["front"].shape                                      | (64, 96, 3)
    obs["vlp-16"].shape[1]                                  | 3
    "front" in obs, "rear" in obs                           | (True, False)
    obs.image("front").dtype                                | np.dtype('uint8')
    obs.image().shape                                       | (64, 96, 3)
    obs.frames["front"]["rgb"].T_world_sensor.shape         | (4, 4)
    obs.agents["car_blue"].category                         | 'car'
    obs.agents[0].object_id                                 | str
    obs.ego.position[0]                                     | float
    obs.lidar().points.shape[1]                             | 3
    obs.metrics["route_progress"]                           | 0.0
    obs.over                                                | False
Clouds
    np.asarray(cloud).shape[1]                              | 3
    len(cloud) == cloud.count                               | True
    cloud["intensity"].shape == (len(cloud),)               | True
    cloud[:10].shape                                        | (10, 3)
    cloud.points[:, 2].max()                                | np.float32
    cloud.save(folder / "sweep.ply").name                   | 'sweep.ply'
Sessions
    sim.session("street").open().cameras                    | ['front', 'left']
    session.welcome.cameras["front"].width                  | 96
    session.reset(sensors="front").image().shape            | (64, 96, 3)
    session.reset(seed=0, sensors=["front"]).step           | 0
    session.step(real2sim.Control(acceleration=1, steering=0)).step | 1
    session.step(plan={"kind": "control", "acceleration": 1, "steering": 0}) | real2sim.Observation
    session.step({"acceleration": 1.0, "steering": 0.0}).step | 1
    session.render("left")["left"].shape                    | (64, 96, 3)
    session.reset(horizon=5.0).step                         | 0
Scenarios
    sim.scenarios.create("street").scene                    | 'street'
    sim.scenarios.create("street", "a name").info.name      | 'a name'
    scenario.preview("front").array.shape                   | (64, 96, 3)
    scenario.preview(camera="front", t=2.0)                 | real2sim.Image
    list(scenario.objects)                                  | ['car_red', 'car_blue', 'post']
    [o.object_id for o in scenario.objects.values()]        | ['car_red', 'car_blue', 'post']
    len(scenario.objects), "post" in scenario.objects       | (3, True)
    car.position.shape                                      | (3,)
    car.pose(1.0).position[0]                               | float
    car.pose(t_us=1_000_000).quaternion                     | (1.0, 0.0, 0.0, 0.0)
    car.corners(1.0).shape                                  | (8, 3)
    car.yaw                                                 | 0.0
    car.size                                                | (4.0, 1.8, 1.5)
    car.translate(1.5, 0.0).revision                        | int
    car.rotate(0.26).revision                               | int
    (car.translate(y=1.0), car.position[1] - before)[1]     | 1.0
    (car.scale(x=1.5), car.size[0])[1]                      | 6.0
    car.set_pose((20.0, 0.0, 0.75)).revision                | int
    car.set_pose(position=np.array([20.0, 0.0, 0.75]))      | object
    (car.delete(), scenario.undo(), "car_red" in scenario.objects)[2] | True
    (car.translate(1), car.rotate(1), scenario.undo(2), scenario.revision)[3] | 4
    (car.translate(1), scenario.undo(1), scenario.redo(1), scenario.info.can_redo)[3] | False
    scenario.sweep("vlp-16").points.shape[1]                | 3
Planners and environments
    real2sim.planners.load_planner("idm")                   | real2sim.planners.Idm
    real2sim.planners.FollowRoute(8.0).speed                | 8.0
    real2sim.planners.run_episode(session, "idm", 2).steps  | 2
    real2sim.planners.run_episode(session, Cruise(), steps=2, action="control").steps | 2
    env.reset(seed=0)[0]["front"].shape                     | (64, 96, 3)
    env.step([0.5, 0.0])[1]                                 | float
    env.step(env.action_space.sample())[4]                  | dict
    env.observation_space["front"].shape                    | (64, 96, 3)
"""

SAYS = """
Connect
    real2sim.connect(host="127.0.0.1", port=8600)           | url='http://127.0.0.1:8600'
    real2sim.connect("127.0.0.1:8600")                      | 'http://127.0.0.1:8600'
    real2sim.Conect                                         | connect
    real2sim.Session                                        | DriveSession
    real2sim.Env                                            | make_env
    real2sim.World                                          | session(scene=
    sim.version                                             | client.server().version
    sim.ping()                                              | client.readiness()
    sim.list_scenes()                                       | client.scenes.list()
    sim.get_scenes()                                        | client.scenes.list()
    sim.load_scene("street")                                | client.scenes.load(
    sim.load("street")                                      | client.scenes.load(
    sim.get_world()                                         | client.session(scene=
    sim.create_session("street")                            | client.session(scene=
    sim.render("street", "front")                           | client.scenes.render(
    sim.scenario("street")                                  | client.scenarios.create(
    sim.reset()                                             | client.session(scene=
Scenes
    sim.scenes["streat"]                                    | street
    scene.name                                              | .scene
    scene.duration                                          | end_us - 
    scene.render("front")                                   | client.scenes.render(scene
    scene.lanes                                             | client.scenes.lanes(scene
    scene.cameras["frnt"]                                   | front
    scene.ego_pose                                          | .ego
    sim.scenes.names()                                      | [s.scene for s in client.scenes]
    sim.scenes.render("street", "frnt")                     | front
    sim.scenes.render("street", "front", time=2.0)          | t=2.0
    sim.scenes.render("street", "front", height=48)         | width=
    sim.scenes.render("street", "front", t=9.0)             | 2000000
Images
    image.numpy()                                           | .array
    image.show()                                            | .save(
    image.to_pil()                                          | .array
    image.width                                             | .array.shape
    image.save("front.bmp")                                 | '.png'
    frame.pose                                              | .T_world_sensor
    frame.intrinsics                                        | .K
    frame.timestamp                                         | .t_us
Observations
    obs["rear"]                                             | sensors=[...]
    obs.images                                              | .frames
    obs.rgb                                                 | .image(
    obs.depth                                               | "depth"
    obs.objects                                             | privileged=True
    blind.agents["car_blue"]                                | privileged=True
    obs.time                                                | .t_us
    obs.reward                                              | make_env
    obs.done                                                | .over
    obs.info                                                | .metrics
    obs.collision                                           | .events
    obs.ego.x                                               | .position
    obs.ego.heading                                         | .yaw
    obs.ego.velocity                                        | .speed
    obs.agents[0].yaw                                       | .quaternion
    a, b, c, d, e = session.step(plan)                      | make_env
    cloud.xyz                                               | .points
    cloud.shape                                             | .points.shape
Sessions
    sim.session("street").reset()                           | open()
    session.reset(sensor=["front"])                         | sensors
    session.reset(cameras=["front"])                        | sensors=
    session.reset(dt=0.1)                                   | dt_us=
    session.reset(sensors=["frnt"])                         | front
    session.reset(options={"seed": 1})                      | seed
    session.step()                                          | plan
    session.step({"x": 1.0})                                | kind
    session.step("idm")                                     | Control(
    session.step([1.0, 0.0])                                | Control(
    session.step(np.array([1.0, 0.0]))                      | Control(
    session.step(acceleration=1.0, steering=0.0)            | Control(
    real2sim.TrajectoryPlan(times=[1], poses=[(1, 0, 0)])   | times_us
    session.seed(0)                                         | reset(seed=
    session.action_space                                    | make_env
    session.get_observation()                               | session.step(
    session.tick()                                          | session.step(
Scenarios
    scenario.objects["car_rde"]                             | car_red
    scenario.objects.car_red                                | ['car_red']
    scenario.objects[0]                                     | list(
    del scenario.objects["car_red"]                         | .delete()
    scenario.name                                           | .info.name
    scenario.id                                             | .scenario_id
    scenario.save()                                         | .export()
    scenario.render("front")                                | .preview(
    scenario.delete()                                       | client.scenarios.delete(
    scenario.session()                                      | client.session(scenario=
    scenario.export_video("front")                          | client.jobs.export_video(
    scenario.get_object("car_red")                          | .objects[
    car.move(x=1.0)                                         | .translate(
    car.translate(dx=1.0)                                   | x=
    car.translate((1.0, 0.0, 0.0))                          | x: must be a valid number
    car.scale(1.2)                                          | x, y, z, anchor
    car.rotate(yaw=0.26)                                    | angle=
    car.rotate(degrees=15)                                  | math.radians(
    car.remove()                                            | .delete()
    car.box                                                 | .corners(
    car.center                                              | .position
    car.wlh                                                 | .size
    car.rotation                                            | .pose(
    car.id                                                  | .object_id
    car.pose(1_000_000)                                     | t_us
    car.trajectory                                          | .info.trajectory
    scenario.preview("frnt")                                | front
Planners and environments
    real2sim.planners.load_planner("idmm")                  | idm
    real2sim.planners.run_episode(session, Cruise, steps=2) | Cruise()
"""


class Cruise:
    """Keeps straight at 5 m/s."""

    def reset(self, obs: real2sim.Observation) -> None: ...

    def plan(self, obs: real2sim.Observation) -> real2sim.Control:
        return real2sim.Control(acceleration=5.0 - obs.ego.speed, steering=0.0)


def lines(table: str) -> list[tuple[str, str]]:
    pairs = (line.rpartition("|") for line in table.splitlines() if "|" in line)
    return [(code.strip(), expected.strip()) for code, _, expected in pairs]


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    root = tmp_path_factory.mktemp("guesses")
    save_scene(make_tiny_scene("street"), root / "scenes" / "street.r2s")
    settings = Settings(data_dir=root, port=0, backend="cpu", log_level="error", max_sessions=64)
    with running_worker(settings) as worker:
        yield worker.url


@pytest.fixture(scope="module")
def held(url: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """Names for guesses that change nothing."""
    with real2sim.connect(url) as sim, sim.session(scene="street") as session:
        blind = session.reset()
        obs = session.reset(sensors=["front"], lidars=["vlp-16"], privileged=True)
        env = real2sim.make_env(url=url, scene="street", sensors=["front"])
        env.reset(seed=0)
        yield {
            "real2sim": real2sim, "np": np, "Cruise": Cruise, "url": url, "sim": sim, "env": env,
            "folder": tmp_path_factory.mktemp("saved"), "scene": sim.scenes.get("street"),
            "obs": obs, "blind": blind, "frame": obs.frames["front"]["rgb"],
            "image": sim.scenes.render("street", camera="front", codec="jpeg"),
            "cloud": obs.lidar("vlp-16"), "session": session,
        }  # fmt: skip
        env.close()


@pytest.fixture
def names(held: dict[str, Any]) -> dict[str, Any]:
    """Names for guesses, with a separate episode and scenario."""
    held["session"].reset(action="control")
    scenario = held["sim"].scenarios.create(scene="street")
    car = scenario.objects["car_red"]
    before = car.info.trajectory.positions[0][1]
    plan = real2sim.Control(acceleration=0.0, steering=0.0)
    return {**held, "scenario": scenario, "car": car, "before": before, "plan": plan}


@pytest.mark.parametrize(("code", "expected"), lines(WORKS))
def test_a_guess_gives_the_expected_value(code: str, expected: str, names: dict[str, Any]) -> None:
    given, wanted = eval(code, names), eval(expected, names)
    if isinstance(wanted, type):
        assert isinstance(given, wanted)
    else:
        assert given == wanted


@pytest.mark.parametrize(("code", "expected"), lines(SAYS))
def test_a_wrong_guess_raises_an_error_that_names_the_right_call(
    code: str, expected: str, names: dict[str, Any]
) -> None:
    with pytest.raises(Exception) as caught:  # noqa: PT011, the exception type does not matter
        exec(code, names)
    said = " ".join([str(caught.value), *getattr(caught.value, "__notes__", ())])
    assert expected in said.replace("\\'", "'")
