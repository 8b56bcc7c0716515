"""Recordings downloaded from a worker and replayed by the command."""

from __future__ import annotations

import json

import cv2
import pytest
from typer.testing import CliRunner

import real2sim
from real2sim.cli import build_app
from real2sim_server.world.mcap_file import recording_in
from real2sim_server.world.recording import load_recording, to_bytes

pytestmark = pytest.mark.network

PLAN = {"kind": "control", "acceleration": 0.5, "steering": 0.0}
runner = CliRunner()


@pytest.fixture
def recorded(site, tmp_path):
    """Recording of an episode with a missed deadline, an edit and images. Also returns the last
    observation and the result."""
    with real2sim.connect(site.url) as client, client.session(scene="tiny") as session:
        session.reset(
            action="control",
            sensors=[{"camera": "front", "codec": "jpeg"}],
            on_collision="continue",
        )
        for _ in range(4):
            obs = session.step(PLAN)
        session.edit([{"op": "translate", "object_id": "post", "y": -1.0}])
        obs = session.step(PLAN)
        path = session.save_recording(tmp_path / "drive.r2e", frames=True)
    return path, obs, session.result


def test_a_recording_contains_the_episode_images_and_scores(recorded):
    path, obs, result = recorded
    recording = load_recording(path)
    assert len(recording.instants) == 6
    assert recording.instants[-1].t_us == obs.t_us
    assert len(recording.frames) == 6
    assert [s.fields() for s in recording.rescore()] == [s.model_dump() for s in result.scores]


def test_the_result_names_the_version_of_every_score(recorded):
    _, _, result = recorded
    assert {s.name for s in result.scores} >= {"pdms", "nuplan_cls", "hugsim_hd", "neuroncap"}
    assert all(s.version for s in result.scores)


def test_replay_computes_scores_without_the_scene(recorded, tmp_path):
    out = tmp_path / "out.json"
    done = runner.invoke(build_app(), ["replay", str(recorded[0]), "--json", str(out)])
    assert done.exit_code == 0, done.output
    assert json.loads(out.read_text())["steps"] == 5


def test_replay_is_bit_identical_and_writes_a_video(recorded, site, tmp_path):
    out, video = tmp_path / "out.json", tmp_path / "drive.mp4"
    scene = site.worker.settings.scenes_path / "tiny.r2s"
    arguments = ["replay", str(recorded[0]), "--scene", str(scene), "--json", str(out)]
    done = runner.invoke(build_app(), [*arguments, "--video", str(video), "--width", "96"])
    assert done.exit_code == 0, done.output
    assert json.loads(out.read_text())["bit_identical"] is True
    video_source = cv2.VideoCapture(str(video))
    assert int(video_source.get(cv2.CAP_PROP_FRAME_COUNT)) == 6
    video_source.release()


def test_an_episode_on_a_scenario_is_replayed_with_its_assets(site, tmp_path):
    path, out = tmp_path / "drive.r2e", tmp_path / "out.json"
    with real2sim.connect(site.url) as client:
        client.assets.cut(scene="tiny", object_id="post", asset_id="replayed-post")
        scenario = client.scenarios.create(scene="tiny")
        scenario.insert("replayed-post", position=(6.0, 2.0, 0.0))
        scenario.objects["post"].translate(y=1.0)
        with client.session(scenario=scenario.scenario_id) as session:
            session.reset(action="control")
            for _ in range(3):
                session.step(PLAN)
            session.save_recording(path)
    settings = site.worker.settings
    scene = settings.scenes_path / "tiny.r2s"
    arguments = ["replay", str(path), "--scene", str(scene), "--json", str(out)]
    refused = runner.invoke(build_app(), arguments)
    assert refused.exit_code == 1
    done = runner.invoke(build_app(), [*arguments, "--assets", str(settings.assets_path)])
    assert done.exit_code == 0, done.output
    assert json.loads(out.read_text())["bit_identical"] is True


def test_replay_exports_mcap_that_embeds_the_recording(recorded, tmp_path):
    path = tmp_path / "drive.mcap"
    done = runner.invoke(build_app(), ["replay", str(recorded[0]), "--mcap", str(path)])
    assert done.exit_code == 0, done.output
    assert to_bytes(recording_in(path)) == recorded[0].read_bytes()
