"""The client SDK against a real worker."""

from __future__ import annotations

import numpy as np
import pytest

import real2sim
from real2sim.planners import load_planner, run_episode

pytestmark = pytest.mark.network


@pytest.fixture
def client(site):
    with real2sim.connect(site.url) as client:
        yield client


def test_a_drive_from_reset_to_result(client):
    with client.session(scene="tiny") as session:
        obs = session.reset(seed=0, sensors=["front"], action="control")
        while not obs.over:
            obs = session.step({"kind": "control", "acceleration": 0.0, "steering": 0.0})
        assert obs.image("front").shape == (64, 96, 3)
    assert session.result.steps == 20
    assert session.result.reason == "horizon"
    assert client.sessions.list() == []


AGENT = """
import carla

def get_entry_point():
    return "Cruise"

class Cruise:
    def setup(self, path_to_conf_file):
        pass

    def sensors(self):
        return [{"type": "sensor.camera.rgb", "x": 0.7, "y": 0.0, "z": 1.6, "roll": 0, "pitch": 0,
                 "yaw": 10, "width": 32, "height": 24, "fov": 40, "id": "Middle"},
                {"type": "sensor.speedometer", "reading_frequency": 20, "id": "Speed"}]

    def set_global_plan(self, gps, world):
        self.points = len(gps)

    def run_step(self, input_data, timestamp):
        assert input_data["Middle"][1].any() and self.points > 5
        return carla.VehicleControl(throttle=float(input_data["Speed"][1]["speed"] < 5))

    def destroy(self):
        pass
"""


def test_a_carla_leaderboard_agent_drives(client, tmp_path):
    (tmp_path / "cruise.py").write_text(AGENT)
    planner = load_planner(f"carla={tmp_path / 'cruise.py'}")
    with client.session(scene="tiny") as session:
        sensors = planner.needs.sensors(session.welcome.cameras)
        summary = run_episode(session, planner, sensors=sensors, action="control")
        route = session.welcome.route
    planner.close()

    assert summary.reason == "horizon"
    assert summary.metrics["feasible"] == 1.0
    assert route.shape[1] == 4
    assert np.diff(route[:, 0]) == pytest.approx(1.0, abs=0.1)


def test_edits_and_renders_during_a_drive(client):
    with client.session(scene="tiny") as session:
        session.reset(action="control", privileged=True)
        before = session.render(["front"])
        assert session.edit([{"op": "delete", "object_id": "car_red"}]).revision == 1
        after = session.render(["front"])
        assert (before.image("front") != after.image("front")).any()


@pytest.mark.parametrize("codec", ["raw", "png"])
def test_images_are_the_same_in_every_lossless_codec(client, codec):
    with client.session(scene="tiny") as session:
        obs = session.reset(sensors=["front"])
        view = session.render([{"camera": "front", "codec": codec}])
        np.testing.assert_array_equal(view.image("front"), obs.image("front"))


def test_a_session_is_stepped_and_rendered_without_a_socket(client):
    info = client.sessions.create(scene="tiny", action="control")
    plan = {"kind": "control", "acceleration": 0.0, "steering": 0.0}
    assert client.sessions.step(info.session_id, n=4, plan=plan).step == 4
    assert client.sessions.state(info.session_id).t_us == 400_000
    view = client.sessions.render(info.session_id, ["front", "left"])
    assert view.image("left").shape == (64, 96, 3)
    client.sessions.delete(info.session_id)
    with pytest.raises(real2sim.SessionClosedError):
        client.sessions.get(info.session_id)


def test_refusals_raise_typed_errors(client):
    info = client.sessions.create(scene="tiny")
    with client.join(info.session_id, token=info.token) as session:
        assert session.reset().step == 0
        second = client.join(info.session_id, token=info.token)
        with pytest.raises(real2sim.ControllerTakenError):
            second.open()
        with pytest.raises(real2sim.UnauthorizedError):
            client.join(info.session_id, token="guess").open()
        assert session.step({"kind": "trajectory", "times_us": [200_000], "poses": [[1, 0, 0]]})
    client.sessions.delete(info.session_id)


def test_rendering_before_a_reset_raises_not_reset(client):
    with client.session(scene="tiny") as session, pytest.raises(real2sim.NotResetError):
        session.render(["front"])
