"""The drive session against a local worker that behaves well or misbehaves."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import numpy as np
import pytest

import real2sim
from real2sim.errors import CapacityError
from tests.waiting import LIMIT_S

from .fake_episode import IMAGE
from .fake_worker import SHORT_S, FakeWorker

pytestmark = pytest.mark.network

STRAIGHT = {"kind": "trajectory", "times_us": [1_000_000], "poses": [(5.0, 0.0, 0.0)]}


def connect(worker: FakeWorker) -> real2sim.Client:
    return real2sim.connect(worker.url, timeout=LIMIT_S)


def wait_at_most(session: real2sim.DriveSession | real2sim.AsyncDriveSession, s: float) -> None:
    """Set the reply timeout from now on. Opening a session may take longer on a busy machine."""
    session._target = replace(session._target, timeout=s)


def test_lock_step_answers_each_plan_with_the_next_observation(worker: FakeWorker) -> None:
    with connect(worker) as client, client.session(scene="street") as session:
        steps = [session.reset(seed=3).step] + [session.step(STRAIGHT).step for _ in range(3)]
    assert steps == [0, 1, 2, 3]
    assert [m["step"] for m in worker.messages if m["type"] == "action"] == [0, 1, 2]


def test_hello_contains_the_session_token(
    worker: FakeWorker,
) -> None:
    with connect(worker) as client, client.session(scene="street"):
        pass
    assert worker.messages[0]["token"] == "session-secret"
    assert worker.messages[0]["sdk"].startswith("real2sim-python/")


def test_raw_frames_on_loopback_arrive_bit_for_bit(worker: FakeWorker) -> None:
    with connect(worker) as client, client.session(scene="street") as session:
        obs = session.reset(sensors=["front"])
    assert obs.frames["front"]["rgb"].codec == "raw"
    np.testing.assert_array_equal(obs.image("front"), IMAGE)


def test_jpeg_frames_are_decoded_as_rgb(worker: FakeWorker) -> None:
    with connect(worker) as client, client.session(scene="street", codec="jpeg") as session:
        image = session.reset(sensors=["front"]).image("front")
    assert np.abs(image.astype(int) - IMAGE).max() <= 6


def test_edits_are_sent_with_the_last_known_revision(worker: FakeWorker) -> None:
    with connect(worker) as client, client.session(scene="street") as session:
        session.reset()
        first = session.edit([{"op": "duplicate", "object_id": "car_3", "y": 3.0}])
        session.edit([{"op": "delete", "object_id": "car_3"}])
    assert first.created == ["car_3_copy1"]
    assert [m["base_rev"] for m in worker.messages if m["type"] == "edit"] == [0, 1]


def test_render_does_not_advance_the_clock(worker: FakeWorker) -> None:
    with connect(worker) as client, client.session(scene="street") as session:
        session.reset()
        view = session.render(["front"])
        assert session.step(STRAIGHT).step == 1
    np.testing.assert_array_equal(view.image("front"), IMAGE)


def test_closing_ends_the_session_and_stores_its_result(worker: FakeWorker) -> None:
    with connect(worker) as client, client.session(scene="street") as session:
        session.reset()
    assert session.result is not None
    assert session.result.metrics == {"progress": 1.0}
    assert worker.messages[-1]["type"] == "bye"


def test_leaving_a_joined_session_does_not_end_it(worker: FakeWorker) -> None:
    with connect(worker) as client, client.join("w0.abc", token="t") as session:
        session.reset()
    assert "bye" not in [m["type"] for m in worker.messages]
    assert worker.deleted == []


def test_a_step_before_reset_is_refused_by_the_client(worker: FakeWorker) -> None:
    with (
        connect(worker) as client,
        client.session(scene="street") as session,
        pytest.raises(real2sim.NotResetError, match="no episode runs"),
    ):
        session.step(STRAIGHT)


def test_a_session_outside_its_with_block_raises_not_open(worker: FakeWorker) -> None:
    with connect(worker) as client:
        with client.session(scene="street") as session:
            pass
        with pytest.raises(real2sim.NotOpenError, match="not open"):
            session.reset()


@pytest.mark.parametrize("mischief", ["426 at the handshake", "error after hello"])
def test_a_protocol_mismatch_is_refused_with_both_versions(
    worker: FakeWorker, mischief: str
) -> None:
    worker.mischief = mischief
    with (
        connect(worker) as client,
        pytest.raises(
            real2sim.ProtocolMismatchError, match=r"the client offers .* this worker speaks"
        ),
    ):
        client.session(scene="street").open()
    assert worker.deleted == ["w0.abc"]


def test_a_worker_that_selects_no_subprotocol_is_refused(worker: FakeWorker) -> None:
    worker.mischief = "no subprotocol"
    with connect(worker) as client, pytest.raises(real2sim.ProtocolMismatchError):
        client.session(scene="street").open()


def test_a_silent_worker_raises_after_the_timeout(worker: FakeWorker) -> None:
    with connect(worker) as client, client.session(scene="street") as session:
        session.reset()
        worker.mischief = "hang"
        wait_at_most(session, SHORT_S)
        with pytest.raises(TimeoutError, match=r"no observation 1 from .* within 0\.05 s"):
            session.step(STRAIGHT)


def test_retrying_a_step_after_a_timeout_advances_the_worker_once(worker: FakeWorker) -> None:
    with connect(worker) as client, client.session(scene="street") as session:
        session.reset()
        worker.mischief = "late"
        wait_at_most(session, SHORT_S)
        with pytest.raises(real2sim.ReplyTimeoutError):
            session.step(STRAIGHT)
        wait_at_most(session, LIMIT_S)
        worker.goes_on = True
        assert session.step(STRAIGHT).step == 1
        assert session.step(STRAIGHT).step == 2


def test_renders_have_a_longer_timeout(worker: FakeWorker) -> None:
    with connect(worker) as client, client.session(scene="street") as session:
        session.reset()
        worker.mischief = "late images"
        wait_at_most(session, SHORT_S)
        assert session.render(sensors=["front"]).t_us == 0


def test_a_restarting_worker_is_reported_with_its_reason(worker: FakeWorker) -> None:
    with connect(worker) as client, client.session(scene="street", reconnect=0) as session:
        session.reset()
        worker.mischief = "restart"
        with pytest.raises(real2sim.ConnectionLostError, match="1012 restarting") as caught:
            session.step(STRAIGHT)
    assert "restarting" in str(caught.value.hint)
    assert worker.deleted == ["w0.abc"]


@pytest.mark.parametrize(
    ("mischief", "sentence"),
    [
        ("garbage", "cannot be read"),
        ("text", "sent text"),
        ("another type", "edited with id 3 arrived, but observation 1"),
        ("missing fields", "t_us: is missing"),
    ],
)
def test_malformed_replies_are_explained(worker: FakeWorker, mischief: str, sentence: str) -> None:
    with connect(worker) as client, client.session(scene="street") as session:
        session.reset()
        worker.mischief = mischief
        with pytest.raises(real2sim.MalformedReplyError, match=sentence):
            session.step(STRAIGHT)


def test_messages_of_another_version_are_a_protocol_mismatch(worker: FakeWorker) -> None:
    with connect(worker) as client, client.session(scene="street") as session:
        session.reset()
        worker.mischief = "version 2"
        with pytest.raises(real2sim.ProtocolMismatchError, match="version 2"):
            session.step(STRAIGHT)


def test_progress_messages_are_skipped(worker: FakeWorker) -> None:
    with connect(worker) as client, client.session(scene="street") as session:
        session.reset()
        worker.mischief = "progress"
        assert session.step(STRAIGHT).step == 1


@pytest.mark.parametrize(
    ("code", "error"),
    [
        ("STEP_CONFLICT", real2sim.StepConflictError),
        ("STALE_STEP", real2sim.StaleStepError),
        ("BAD_STEP", real2sim.BadStepError),
        ("EPISODE_OVER", real2sim.EpisodeOverError),
        ("INVALID_ACTION", real2sim.InvalidActionError),
        ("NOT_CONTROLLER", real2sim.UnauthorizedError),
        ("QUEUE_FULL", CapacityError),
        ("CODE_OF_THE_FUTURE", real2sim.StatusError),
    ],
)
def test_refusals_raise_typed_errors_and_keep_the_socket_open(
    worker: FakeWorker, code: str, error: type[real2sim.StatusError]
) -> None:
    with connect(worker) as client, client.session(scene="street", reconnect=0) as session:
        session.reset()
        worker.mischief = code
        with pytest.raises(error, match="refused by the test") as caught:
            session.step(STRAIGHT)
        assert session.step(STRAIGHT).step == 1
    assert (caught.value.code, caught.value.step) == (code, 7)


def test_a_retryable_refusal_is_resent_after_the_requested_time(
    worker: FakeWorker, monkeypatch: pytest.MonkeyPatch
) -> None:
    waited: list[float] = []
    monkeypatch.setattr("real2sim._sync.transport.sleep", waited.append)
    with connect(worker) as client, client.session(scene="street", reconnect=240.0) as session:
        session.reset()
        for code in ("STORAGE_UNAVAILABLE", "TOO_MANY_REQUESTS retry", "TOO_MANY_SESSIONS"):
            worker.mischief = code
            session.step(STRAIGHT)
        actions = [m for m in worker.messages if m["type"] == "action"]
        assert [a["step"] for a in actions] == [0, 0, 1, 1, 2, 2]
        assert waited[1] == 7.0

        worker.mischief = "TOO_MANY_REQUESTS retry"
        monkeypatch.setattr(session, "_plan", replace(session._plan, reconnect=5.0))
        with pytest.raises(CapacityError) as caught:
            session.step(STRAIGHT)
        assert caught.value.retry_after == 7.0


def test_the_async_session_drives_the_same_episode(worker: FakeWorker) -> None:
    async def drive() -> list[float]:
        async with (
            real2sim.connect_async(worker.url) as client,
            client.session(scene="street") as session,
        ):
            obs = [await session.reset(seed=1, sensors=["front"])]
            obs += [await session.step(STRAIGHT) for _ in range(3)]
            await session.edit([{"op": "delete", "object_id": "car_3"}])
            view = await session.render(["front"])
            np.testing.assert_array_equal(view.image("front"), IMAGE)
        assert session.result is not None
        return [o.ego.position[0] for o in obs]

    with connect(worker) as client, client.session(scene="street") as session:
        sync = [session.reset(seed=1)] + [session.step(STRAIGHT) for _ in range(3)]
    assert asyncio.run(drive()) == [o.ego.position[0] for o in sync]


def test_the_async_session_times_out(worker: FakeWorker) -> None:
    async def drive() -> None:
        async with (
            real2sim.connect_async(worker.url, timeout=LIMIT_S) as client,
            client.session(scene="street") as session,
        ):
            await session.reset()
            worker.mischief = "hang"
            wait_at_most(session, SHORT_S)
            with pytest.raises(real2sim.ReplyTimeoutError, match="observation 1"):
                await session.step(STRAIGHT)

    asyncio.run(drive())


def test_an_unreachable_worker_is_named_by_address() -> None:
    with (
        real2sim.connect("http://127.0.0.1:9", retries=0) as client,
        pytest.raises(ConnectionError, match=r"no worker answers at http://127\.0\.0\.1:9"),
    ):
        client.session(scene="street").open()
