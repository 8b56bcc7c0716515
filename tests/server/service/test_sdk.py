"""The handles of the SDK against a real worker."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator

import numpy as np
import pytest

import real2sim
from real2sim import NotFoundError
from real2sim_server.scene import Scene
from real2sim_server.scene.io import save_scene, write_splats
from real2sim_server.service.serve import RunningWorker, running_worker
from real2sim_server.settings import Settings
from tests.waiting import LIMIT_S

pytestmark = pytest.mark.network


@pytest.fixture(scope="module")
def worker(tmp_path_factory, tiny_scene: Scene) -> Iterator[RunningWorker]:
    folder = tmp_path_factory.mktemp("sdk")
    save_scene(tiny_scene, folder / "scenes" / "tiny.r2s")
    settings = Settings(
        data_dir=folder, scenes_dir=folder / "scenes", port=0, backend="cpu", log_level="error"
    )
    with running_worker(settings) as running:
        yield running


@pytest.fixture
def client(worker: RunningWorker) -> Iterator[real2sim.Client]:
    with real2sim.connect(worker.url, name="anna") as connected:
        yield connected


@pytest.fixture
def scenario(client):
    return client.scenarios.create(scene="tiny", name="cut-in")


def test_every_object_edit_is_one_revision_with_the_client_name(scenario):
    car = scenario.objects["car_blue"]
    car.translate(y=3.2, start_us=500_000, blend_us=1_000_000)
    car.rotate(angle=0.2)
    car.scale(z=1.1)
    car.set_pose(position=(20.0, 0.0, 4.0), snap=True)
    car.set_trajectory(
        times_us=[0, 1_000_000],
        positions=[(8, 0, 1), (18, 0, 1)],
        quaternions=[(1, 0, 0, 0)] * 2,
    )
    car.retime(delay_us=100_000, speed=2.0)
    car.set_physics(mass=1500.0, material="metal", friction=0.6, restitution=0.2)
    car.set_velocity(linear=(12.0, 0.0, 0.0))
    car.replace(recorded="car_red")
    car.delete()
    car.restore()

    entries = scenario.history().entries
    assert [e.operations[0].op for e in entries] == [
        "translate",
        "rotate",
        "scale",
        "set_pose",
        "set_trajectory",
        "retime",
        "set_physics",
        "set_velocity",
        "replace",
        "delete",
        "restore",
    ]
    assert {e.who for e in entries} == {"anna"}
    edited = scenario.objects["car_blue"].info
    assert (edited.recorded_id, edited.physics.mass) == ("car_red", 1500.0)
    assert edited.velocity.linear == (12.0, 0.0, 0.0)


def test_scenario_edits_are_applied(scenario):
    scenario.erase_region(position=(15, 0, 0), size=(4, 4, 1), region_id="hole")
    scenario.add_box(position=(20, 0, 1), size=(1, 4, 2))
    scenario.add_plane(point=(0, 0, 0))
    scenario.add_ground(offset=0.1)
    scenario.set_time(start_us=500_000)
    scenario.remove("hole")
    assert scenario.info.erased == []
    scenario.restore("hole")

    assert [r.region_id for r in scenario.info.erased] == ["hole"]
    assert [c.shape.kind for c in scenario.info.colliders] == ["box", "plane", "ground"]
    assert scenario.info.start_us == 500_000


def test_undo_and_redo_restore_and_remove_an_object(scenario):
    scenario.objects["post"].delete()
    assert "post" not in scenario.objects
    scenario.undo()
    assert "post" in scenario.objects
    scenario.redo()
    assert "post" not in scenario.objects


def test_an_asset_is_cut_from_a_scene_and_inserted(client, scenario):
    cut = client.assets.cut(scene="tiny", object_id="car_red", asset_id="red_car")
    car = scenario.insert("red_car", position=(22, 3, 9))

    assert [a.asset_id for a in client.assets.list()].count("red_car") == 1
    assert client.assets.get("red_car") == cut
    assert car.info.asset_id == "red_car"
    assert client.assets.thumbnail("red_car", width=64).array.shape == (48, 64, 3)


def test_a_splat_file_is_uploaded(client, tmp_path, tiny_scene):
    path = tmp_path / "lorry.ply"
    write_splats(tiny_scene.objects["car_blue"].cloud, path)
    info = client.assets.upload(path, category="truck", up_axis="z", length=9.0)

    assert (info.asset_id, info.category) == ("lorry", "truck")
    assert info.size[0] == pytest.approx(9.0)


def test_a_scenario_is_forked_and_imported_from_a_document(client, scenario):
    scenario.objects["post"].delete()
    fork = scenario.fork(name="other")
    copy = client.scenarios.import_document(scenario.export().model_dump(mode="json"))

    assert (fork.info.name, fork.revision) == ("other", 1)
    assert list(copy.objects) == list(fork.objects) == ["car_red", "car_blue"]


def test_a_video_job_is_awaited_and_downloaded(client, scenario, tmp_path):
    seen = []
    job = client.jobs.export_video(scenario=scenario.scenario_id, camera="front", width=64)
    job.wait(timeout=LIMIT_S, on_progress=seen.append)
    path = job.download("video.webm", tmp_path / "deep" / "video.webm")

    assert job.result["frames"] == 21
    assert path.read_bytes()[:4] == bytes([0x1A, 0x45, 0xDF, 0xA3])  # EBML header of WebM
    assert seen[-1].progress == 1.0
    assert job.job_id in [j.job_id for j in client.jobs.list(subject=scenario.scenario_id)]


def test_waiting_for_a_cancelled_job_raises(client, held_videos):
    job = client.jobs.export_video(scene="tiny", camera="front", width=64)
    job.cancel()

    with pytest.raises(real2sim.Real2SimError, match="cancelled"):
        job.wait(timeout=LIMIT_S)


def test_unknown_jobs_and_assets_are_not_found(client):
    with pytest.raises(NotFoundError):
        client.jobs.get("job_0")
    with pytest.raises(NotFoundError):
        client.assets.get("nothing")


def test_the_async_client_has_the_same_handles(worker, tmp_path):
    async def work():
        async with real2sim.connect_async(worker.url) as client:
            scenario = await client.scenarios.create(scene="tiny")
            await scenario.objects["post"].translate(x=1.0)
            copy = await scenario.objects["post"].duplicate(y=2.0, snap=True)
            await scenario.set_time(end_us=200_000)
            other = await client.scenarios.import_document(await scenario.export())
            fork = await scenario.fork(revision=1)
            job = await client.jobs.export_video(
                scenario=other.scenario_id, camera="left", width=64
            )
            await (await client.jobs.get(job.job_id)).wait(timeout=LIMIT_S)
            await job.download("video.webm", tmp_path / "video.webm")
            await client.assets.cut(scene="tiny", object_id="post")
            inserted = await scenario.insert("post", position=(5, 5, 5))
            picture = await client.assets.thumbnail("post", width=64)
            return copy, fork, inserted, picture.array

    copy, fork, inserted, picture = asyncio.run(work())
    assert (copy.object_id, fork.revision) == ("post_copy1", 1)
    assert inserted.object_id == "post_1"
    assert np.ptp(picture) > 50
