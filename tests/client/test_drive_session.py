"""The drive session against a worker on loopback, well behaved and not."""

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
    """From now on: what opens a session may take as long as it takes on a busy machine."""
    session._target = replace(session._target, timeout=s)


def test_lock_step_answers_each_plan_with_the_next_observation(worker: FakeWorker) -> None:
    with connect(worker) as client, client.session(scene="street") as session:
        steps = [session.reset(seed=3).step] + [session.step(STRAIGHT).step for _ in range(3)]
    assert steps == [0, 1, 2, 3]
    assert [m["step"] for m in worker.messages if m["type"] == "action"] == [0, 1, 2]


def test_hello_carries_the_session_token_and_not_the_address_it_was_given(
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


def test_edits_are_sent_on_the_revision_seen_last(worker: FakeWorker) -> None:
    with connect(worker) as client, client.session(scene="street") as session:
        session.reset()
        first = session.edit([{"op": "duplicate", "object_id": "car_3", "y": 3.0}])
        session.edit([{"op": "delete", "object_id": "car_3"}])
    assert first.created == ["car_3_copy1"]
    assert [m["base_rev"] for m in worker.messages if m["type"] == "edit"] == [0, 1]


def test_render_shows_the_instant_and_leaves_the_clock_alone(worker: FakeWorker) -> None:
    with connect(worker) as client, client.session(scene="street") as session:
        session.reset()
        view = session.render(["front"])
        assert session.step(STRAIGHT).step == 1
    np.testing.assert_array_equal(view.image("front"), IMAGE)


def test_closing_ends_the_session_and_keeps_its_result(worker: FakeWorker) -> None:
    with connect(worker) as client, client.session(scene="street") as session:
        session.reset()
    assert session.result is not None
    assert session.result.metrics == {"progress": 1.0}
    assert worker.messages[-1]["type"] == "bye"


def test_leaving_a_joined_session_lets_it_live(worker: FakeWorker) -> None:
    with connect(worker) as client, client.join("w0.abc", token="t") as session:
        session.reset()
    assert "bye" not in [m["type"] for m in worker.messages]
    assert worker.deleted == []


def test_a_plan_before_reset_is_refused_here(worker: FakeWorker) -> None:
    with (
        connect(worker) as client,
        client.session(scene="street") as session,
        pytest.raises(real2sim.NotResetError, match="no episode runs"),
    ):
        session.step(STRAIGHT)


def test_a_session_outside_its_with_block_says_how_to_use_it(worker: FakeWorker) -> None:
    with connect(worker) as client:
        with client.session(scene="street") as session:
            pass
        with pytest.raises(real2sim.NotOpenError, match="not open"):
            session.reset()


@pytest.mark.parametrize("mischief", ["426 at the handshake", "error after hello"])
def test_a_worker_of_another_protocol_is_refused_with_both_versions(
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


def test_a_worker_that_chooses_no_protocol_is_refused(worker: FakeWorker) -> None:
    worker.mischief = "no subprotocol"
    with connect(worker) as client, pytest.raises(real2sim.ProtocolMismatchError):
        client.session(scene="street").open()


def test_a_silent_worker_is_not_waited_for_longer_than_the_timeout(worker: FakeWorker) -> None:
    with connect(worker) as client, client.session(scene="street") as session:
        session.reset()
        worker.mischief = "hang"
        wait_at_most(session, SHORT_S)
        with pytest.raises(TimeoutError, match=r"no observation 1 from .* within 0\.05 s"):
            session.step(STRAIGHT)


def test_after_a_timeout_the_same_plan_moves_the_worker_only_once(worker: FakeWorker) -> None:
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


def test_images_that_need_kernels_of_their_own_may_take_longer(worker: FakeWorker) -> None:
    with connect(worker) as client, client.session(scene="street") as session:
        session.reset()
        worker.mischief = "late images"
        wait_at_most(session, SHORT_S)
        assert session.render(sensors=["front"]).t_us == 0


def test_a_worker_that_leaves_is_reported_with_its_reason(worker: FakeWorker) -> None:
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
        ("missing fields", "t_us: Field required"),
    ],
)
def test_nonsense_from_the_worker_is_named(
    worker: FakeWorker, mischief: str, sentence: str
) -> None:
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


def test_progress_is_waited_through(worker: FakeWorker) -> None:
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
def test_refusals_on_the_socket_are_told_apart_and_leave_it_open(
    worker: FakeWorker, code: str, error: type[real2sim.StatusError]
) -> None:
    with connect(worker) as client, client.session(scene="street", reconnect=0) as session:
        session.reset()
        worker.mischief = code
        with pytest.raises(error, match="refused by the test") as caught:
            session.step(STRAIGHT)
        assert session.step(STRAIGHT).step == 1
    assert (caught.value.code, caught.value.step) == (code, 7)


def test_what_the_worker_refuses_for_now_is_sent_again_after_the_time_it_asks_for(
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


def test_the_async_session_does_not_wait_for_ever(worker: FakeWorker) -> None:
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


def test_no_worker_is_a_sentence_that_names_the_address() -> None:
    with (
        real2sim.connect("http://127.0.0.1:9", retries=0) as client,
        pytest.raises(ConnectionError, match=r"no worker answers at http://127\.0\.0\.1:9"),
    ):
        client.session(scene="street").open()
