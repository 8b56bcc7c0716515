from __future__ import annotations

import asyncio
import json
from pathlib import Path

import cv2
import pytest

from real2sim_proto import ErrorCode
from real2sim_proto.jobs import JobInfo, JobState
from real2sim_server.service.http.responses import ServiceError
from real2sim_server.service.jobs import JobResult, Jobs, NewJob
from real2sim_server.service.library.scenes import Quota
from real2sim_server.service.storage.job_log import JobLog
from real2sim_server.service.storage.store import Store
from tests.waiting import LIMIT_S, wait_until_async

from ..waiting import finished, succeeded

VIDEO = {"scene": "tiny", "camera": "front", "width": 64}


@pytest.fixture
def with_jobs(tmp_path):
    """Run ``work(jobs)`` on a fresh ``Jobs`` instance. The store persists between calls."""

    def run(work):
        async def inside():
            store = Store(f"sqlite:///{tmp_path / 'store.db'}")
            await store.open()
            try:
                jobs = Jobs(JobLog(store, "w0"), _quota(tmp_path / "jobs"))
                async with jobs.running():
                    return await work(jobs)
            finally:
                await store.close()

        return asyncio.run(inside())

    return run


def _quota(folder: Path) -> Quota:
    return Quota(folder, "jobs", 1000, 1 << 30, "JOBS_QUOTA", "delete jobs")


async def until_over(jobs: Jobs, job: JobInfo) -> JobInfo:
    return await jobs.wait(job.job_id, LIMIT_S)


async def until_states(jobs: Jobs, started: list[JobInfo], states: list[str]) -> None:
    """Wait until the jobs have these states."""

    def now() -> list[str]:
        return [jobs._jobs[job.job_id].info.state.value for job in started]

    await wait_until_async(lambda: now() == states, lambda: f"{states}: {now()}")


async def nothing(_context) -> JobResult:
    return JobResult({"answer": 42})


async def for_ever(context) -> JobResult:
    while True:
        context.progress(0.5, "waiting")
        await asyncio.sleep(0.005)


async def wrongly(_context) -> JobResult:
    raise ServiceError(ErrorCode.UNKNOWN_CAMERA, "no camera 'back'", hint="try 'front'")


def test_a_job_runs_and_keeps_its_result(with_jobs):
    async def work(jobs):
        return await until_over(jobs, await jobs.start(NewJob("export", "tiny"), nothing))

    done = with_jobs(work)
    again = with_jobs(lambda jobs: jobs.get(done.job_id))
    assert (done.state, done.result, done.progress) == (JobState.SUCCEEDED, {"answer": 42}, 1.0)
    assert again == done


def test_a_failed_job_reports_its_problem(with_jobs):
    async def work(jobs):
        return await until_over(jobs, await jobs.start(NewJob("export", "tiny"), wrongly))

    failed = with_jobs(work)
    assert failed.state is JobState.FAILED
    assert (failed.error.code, failed.error.hint) == (ErrorCode.UNKNOWN_CAMERA, "try 'front'")


def test_cancelling_ends_running_and_waiting_jobs(with_jobs):
    async def work(jobs):
        running = await jobs.start(NewJob("simulate", "a"), for_ever)
        waiting = await jobs.start(NewJob("simulate", "b"), for_ever)
        await until_states(jobs, [running, waiting], ["running", "queued"])
        for job in (waiting, running):
            await jobs.cancel(job.job_id)
        return [await until_over(jobs, job) for job in (waiting, running)]

    assert [job.state for job in with_jobs(work)] == [JobState.CANCELLED] * 2


def test_heavy_jobs_run_one_at_a_time_and_light_jobs_do_not_wait(with_jobs):
    async def work(jobs):
        await jobs.start(NewJob("simulate", "a"), for_ever)
        heavy = await jobs.start(NewJob("simulate", "b"), nothing)
        light = await jobs.start(NewJob("load_scene", "c", light=True), nothing)
        await until_over(jobs, light)
        return await jobs.get(heavy.job_id), await jobs.get(light.job_id)

    heavy, light = with_jobs(work)
    assert (heavy.state, light.state) == (JobState.QUEUED, JobState.SUCCEEDED)


def test_two_exports_run_at_a_time_independently_of_physics(with_jobs):
    async def work(jobs):
        physics = [await jobs.start(NewJob("simulate", "a"), for_ever) for _ in range(2)]
        exports = [await jobs.start(NewJob("export", "a"), for_ever) for _ in range(3)]
        expected = ["running", "queued", "running", "running", "queued"]
        await until_states(jobs, physics + exports, expected)

    with_jobs(work)


def test_a_stopped_worker_marks_its_jobs_interrupted(with_jobs):
    async def work(jobs):
        jobs_started = [await jobs.start(NewJob("export", "a"), for_ever) for _ in range(2)]
        await until_states(jobs, jobs_started, ["running"] * 2)
        return jobs_started

    started = with_jobs(work)
    for job in started:
        left = with_jobs(lambda jobs, job=job: jobs.get(job.job_id))
        assert left.state is JobState.INTERRUPTED
        assert left.error.retryable


def test_jobs_of_a_killed_worker_are_marked_interrupted_at_the_next_start(with_jobs, tmp_path):
    async def leave_one_running(jobs):
        stuck = JobInfo(
            job_id="job_1", kind="export", subject="a", state="running", created_at="then"
        )
        await jobs._log.add(stuck, reply=None)

    with_jobs(leave_one_running)
    left = with_jobs(lambda jobs: jobs.get("job_1"))
    assert left.state is JobState.INTERRUPTED
    # Higher than any event number seen before.
    assert left.event > 1000


def test_too_many_waiting_jobs_are_refused(with_jobs):
    async def work(jobs):
        async def start_many():
            for _ in range(50):
                await jobs.start(NewJob("export", "a"), for_ever)

        with pytest.raises(ServiceError) as refused:
            await start_many()
        return refused.value

    error = with_jobs(work)
    assert error.code == ErrorCode.QUEUE_FULL
    assert error.headers["Retry-After"]


def test_events_report_every_change_in_order(with_jobs):
    async def three_steps(context):
        for share in (0.2, 0.4, 0.6):
            context.progress(share, "stepping")
            await asyncio.sleep(0)
        return JobResult()

    async def work(jobs):
        job = await jobs.start(NewJob("export", "a"), three_steps)
        return [info async for info in jobs.events(job.job_id, after=0)]

    events = with_jobs(work)
    assert [e.event for e in events] == [1, 2, 3, 4, 5, 6]
    assert [e.progress for e in events] == [0, 0, 0.2, 0.4, 0.6, 1]
    assert [e.state.value for e in events][::5] == ["queued", "succeeded"]


def test_events_continue_after_the_last_one_seen(with_jobs):
    async def work(jobs):
        job = await jobs.start(NewJob("export", "a"), nothing)
        await until_over(jobs, job)
        return [info.event async for info in jobs.events(job.job_id, after=2)]

    assert with_jobs(work) == [3]


# --- over REST --------------------------------------------------------------------------------


def test_a_video_of_a_scene_covers_the_whole_recording(client, tmp_path):
    job = succeeded(client, client.post("/v1/exports", json=VIDEO | {"fps": 5}))
    assert job["result"]["frames"] == 11

    answer = client.get(f"/v1/jobs/{job['job_id']}/files/video.webm")
    assert answer.headers["Content-Type"] == "video/webm"
    path = tmp_path / "video.webm"
    path.write_bytes(answer.content)
    video = cv2.VideoCapture(str(path))
    frames = 0
    while video.read()[0]:
        frames += 1
    assert frames == 11
    assert job["files"] == [
        {"name": "video.webm", "media_type": "video/webm", "bytes": len(answer.content)}
    ]


def test_a_video_of_a_scenario_covers_its_time_span(client):
    scenario = client.post("/v1/scenarios", json={"scene": "tiny"}).json()["scenario_id"]
    cut = {"operations": [{"op": "set_time", "start_us": 1_000_000, "end_us": 1_500_000}]}
    client.post(f"/v1/scenarios/{scenario}/operations", json=cut)
    asked = {"scenario": scenario, "camera": "front", "width": 64}
    job = finished(client, client.post("/v1/exports", json=asked))
    assert (job["result"]["start_us"], job["result"]["frames"]) == (1_000_000, 6)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"camera": "back"}, ErrorCode.UNKNOWN_CAMERA),
        ({"scene": "nowhere"}, ErrorCode.UNKNOWN_SCENE),
        ({"end_us": 99_000_000}, ErrorCode.TIME_OUT_OF_RANGE),
        ({"scenario": "both"}, ErrorCode.INVALID_REQUEST),
    ],
)
def test_an_invalid_export_is_refused_immediately(client, change, code):
    answer = client.post("/v1/exports", json=VIDEO | change)
    assert answer.json()["code"] == code
    assert client.get("/v1/jobs").json()["jobs"] == []


def test_an_export_with_an_idempotency_key_runs_once(client):
    first, again = (
        client.post("/v1/exports", json=VIDEO, headers={"Idempotency-Key": "k"}) for _ in range(2)
    )
    assert first.json()["job_id"] == again.json()["job_id"]
    assert again.headers["Idempotent-Replayed"] == "true"
    finished(client, first)


def test_the_event_stream_ends_with_the_job(client):
    job = client.post("/v1/exports", json=VIDEO, headers={"X-Real2Sim-Client": "anna"}).json()
    url = f"/v1/jobs/{job['job_id']}/events"
    with client.stream("GET", url) as stream:
        assert stream.headers["Content-Type"].startswith("text/event-stream")
        text = "".join(stream.iter_text())
    blocks = [dict(line.split(": ", 1) for line in b.splitlines()) for b in text.split("\n\n") if b]
    assert blocks[-1]["event"] == "succeeded"
    assert json.loads(blocks[-1]["data"])["who"] == "anna"
    numbers = [int(block["id"]) for block in blocks]
    assert numbers == sorted(set(numbers))

    over = client.get(url, headers={"Last-Event-ID": str(numbers[-1])})
    assert over.status_code == 204


def test_a_finished_job_can_be_removed_with_its_files(client):
    job = finished(client, client.post("/v1/exports", json=VIDEO | {"end_us": 100_000}))
    url = f"/v1/jobs/{job['job_id']}"
    assert client.delete(url).status_code == 204
    assert client.get(url).json()["code"] == ErrorCode.UNKNOWN_JOB
    assert client.get(f"{url}/files/video.webm").json()["code"] == ErrorCode.UNKNOWN_JOB


def test_a_running_export_can_be_cancelled(client, held_videos):
    job = client.post("/v1/exports", json=VIDEO)
    assert held_videos.begun.wait(LIMIT_S)
    assert client.delete(job.headers["Location"]).status_code == 200
    assert finished(client, job)["state"] == "cancelled"


def test_files_of_an_unfinished_job_are_refused(client, held_videos):
    job = client.post("/v1/exports", json=VIDEO).headers["Location"]
    assert client.get(f"{job}/files/video.webm").json()["code"] == ErrorCode.JOB_NOT_DONE
    client.delete(job)
    assert finished(client, job)["state"] == "cancelled"
    assert client.get(f"{job}/files/video.webm").json()["code"] == ErrorCode.JOB_FAILED


def test_a_slow_scene_load_continues_as_a_job(client):
    answer = client.put("/v1/scenes/tiny/residency", headers={"Prefer": "respond-async"})
    job = finished(client, answer)
    assert (job["kind"], job["subject"], job["state"]) == ("load_scene", "tiny", "succeeded")
    resident = client.put("/v1/scenes/tiny/residency", headers={"Prefer": "respond-async"})
    assert (resident.status_code, resident.json()["state"]) == (200, "resident")
