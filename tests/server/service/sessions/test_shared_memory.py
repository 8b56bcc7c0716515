"""Images through shared memory between worker and controller."""

from __future__ import annotations

import mmap
import os
import socket
import stat
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import real2sim
from real2sim_proto.codec import MAX_SERVER_MESSAGE_BYTES
from real2sim_proto.drive import SHM_FOLDER, SHM_HEADER_BYTES, SHM_MAGIC, SHM_SECRET_BYTES
from real2sim_proto.episode import SensorSpec
from real2sim_server.service.frames import EncodedFrame, RenderedImage, encode_frame
from real2sim_server.service.library.scenes import MemoryBudget
from real2sim_server.service.sessions import shared_memory as module
from real2sim_server.service.sessions.sensors import MAX_IMAGE_BYTES
from real2sim_server.service.sessions.shared_memory import SLOTS, Segment, Segments, sweep_segments
from real2sim_server.service.sessions.wire import PhaseTimer, pack_members, pack_with_frames
from real2sim_server.settings import Settings
from tests.waiting import wait_until

pytestmark = [
    pytest.mark.network,
    pytest.mark.skipif(not Path(SHM_FOLDER).is_dir(), reason="no files in memory here"),
]

MODALITIES = ["rgb", "depth", "instance"]
SENSORS = [{"camera": "front", "modalities": MODALITIES, "codec": "raw"}]
CONTROL = {"kind": "control", "acceleration": 0.5, "steering": 0.02}


def path_of(welcome: dict[str, Any]) -> Path:
    return Path(SHM_FOLDER, welcome["shared_memory"]["name"])


def mapped(path: Path) -> mmap.mmap:
    with path.open("rb") as file:
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)


def secret_of(memory: mmap.mmap) -> bytes:
    assert memory[: len(SHM_MAGIC)] == SHM_MAGIC
    return memory[len(SHM_MAGIC) : len(SHM_MAGIC) + SHM_SECRET_BYTES]


def image_of(memory: mmap.mmap, frame: dict[str, Any]) -> np.ndarray:
    count = int(np.prod(frame["shape"]))
    found = np.frombuffer(memory, frame["dtype"], count, frame["offset"])
    return found.reshape(frame["shape"]).copy()


def sent(frame: dict[str, Any]) -> np.ndarray:
    return np.frombuffer(frame["data"], frame["dtype"]).reshape(frame["shape"])


@pytest.fixture
def attached(site, join):
    """An attached controller and its memory."""
    planner = join(site.create(), role=None)
    path = path_of(planner.hello())
    memory = mapped(path)
    assert planner.ask("attach", secret=secret_of(memory))["type"] == "attached"
    assert not path.exists()
    return planner, memory


def raw_frame(height: int, width: int, modality: str = "rgb") -> EncodedFrame:
    dtype = {"rgb": np.uint8, "depth": np.float32, "instance": np.uint16}[modality]
    pixels = np.zeros((height, width, 3) if modality == "rgb" else (height, width), dtype)
    sensor = SensorSpec(camera="front", modalities=[modality], codec="raw")
    return encode_frame(RenderedImage(sensor, modality, 0, np.eye(4), np.eye(3), pixels))


# --- protocol -----------------------------------------------------------------------------------


def test_images_in_a_slot_equal_those_sent_over_the_socket(attached, site, join):
    planner, memory = attached
    other = join(site.create())
    spec = {"action": "control", "sensors": SENSORS}
    placed = planner.ask("reset", spec=spec, slot=1)
    plain = other.ask("reset", spec=spec)
    for answer, beside, slot in (
        (placed, plain, 1),
        (planner.ask("action", step=0, plan=CONTROL, slot=2), other.act(0), 2),
        (
            planner.ask("render", sensors=SENSORS, slot=0),
            other.ask("render", sensors=SENSORS),
            0,
        ),
    ):
        assert [f["modality"] for f in answer["frames"]] == MODALITIES
        for frame, expected in zip(answer["frames"], beside["frames"], strict=True):
            first = SHM_HEADER_BYTES + slot * (len(memory) - SHM_HEADER_BYTES) // SLOTS
            assert first <= frame["offset"] < first + (len(memory) - SHM_HEADER_BYTES) // SLOTS
            assert (frame["data"], "offset" in expected) == (b"", False)
            assert image_of(memory, frame).tobytes() == sent(expected).tobytes()
            assert frame["T_world_sensor"].tobytes() == expected["T_world_sensor"].tobytes()


def test_images_are_sent_inline_without_a_slot_or_for_a_repeated_answer(
    attached,
):
    planner, _ = attached
    obs = planner.reset(sensors=SENSORS)
    assert "offset" not in obs["frames"][0]
    first = planner.ask("action", step=0, plan=CONTROL, slot=3)
    again = planner.ask("action", step=0, plan=CONTROL, slot=0)
    assert "offset" in first["frames"][0]
    assert "offset" not in again["frames"][0]


def test_compressed_images_are_sent_inline(attached):
    planner, memory = attached
    sensors = [*SENSORS, {"camera": "left", "codec": "jpeg"}]
    frames = planner.ask("reset", spec={"sensors": sensors}, slot=0)["frames"]
    assert ["offset" in frame for frame in frames] == [True, True, True, False]
    assert frames[-1]["data"][:2] == b"\xff\xd8"
    assert image_of(memory, frames[0]).any()


def test_the_shared_file_is_readable_by_its_owner_only(site, join):
    path = path_of(join(site.create(), role=None).hello())
    assert stat.S_IMODE(path.stat().st_mode) == 0o400
    assert path.stat().st_uid == os.geteuid()


def test_only_the_controller_can_attach(attached, site, join):
    planner, _ = attached
    observer = join(planner.info, role=None)
    assert "shared_memory" not in observer.hello(role="observer")
    refused = observer.ask("attach", secret=bytes(SHM_SECRET_BYTES))
    assert refused["code"] == "NOT_CONTROLLER"
    planner.ask("reset", spec={"sensors": SENSORS}, slot=0)
    assert "offset" not in observer.receive()["frames"][0]


def test_after_a_wrong_secret_images_go_over_the_socket(site, join):
    planner = join(site.create(), role=None)
    path = path_of(planner.hello())
    assert planner.ask("attach", secret=bytes(SHM_SECRET_BYTES))["code"] == "INVALID_REQUEST"
    assert not path.exists()
    obs = planner.ask("reset", spec={"sensors": SENSORS}, slot=0)
    assert len(obs["frames"][0]["data"]) == 64 * 96 * 3
    assert planner.ask("attach", secret=bytes(SHM_SECRET_BYTES))["code"] == "INVALID_REQUEST"


def test_the_file_is_removed_if_the_client_does_not_attach(site, join):
    planner = join(site.create(), role=None)
    path = path_of(planner.hello())
    assert path.exists()
    planner.reset()
    assert not path.exists()


def test_an_invalid_slot_is_refused_without_advancing_the_step(attached):
    planner, _ = attached
    planner.reset(sensors=SENSORS)
    refused = planner.ask("action", step=0, plan=CONTROL, slot=SLOTS)
    assert (refused["code"], refused["step"]) == ("INVALID_REQUEST", 0)
    assert planner.act(0)["step"] == 1


def test_memory_is_counted_and_freed_on_disconnect(attached, site):
    planner, _ = attached
    segments = site.worker.sessions.segments
    planner.ask("reset", spec={"sensors": SENSORS}, slot=0)
    assert segments.held_bytes >= 64 * 96 * 9
    planner.socket.socket.shutdown(socket.SHUT_RDWR)
    wait_until(lambda: segments.held_bytes == 0, "the memory to be given back")


# --- the SDK ------------------------------------------------------------------------------------


@pytest.fixture
def client(site):
    with real2sim.connect(site.url) as client:
        yield client


def driven(session, steps: int) -> list[real2sim.Observation]:
    observations = [session.reset(sensors=SENSORS, action="control")]
    observations += [session.step(CONTROL) for _ in range(steps)]
    return observations


def test_the_sdk_uses_shared_memory_and_kept_images_do_not_change(client):
    with client.session(scene="tiny") as session:
        assert session.shared_memory
        kept = driven(session, SLOTS + 3)
        assert session.render(SENSORS).image("front").any()
    with client.session(scene="tiny", shared_memory=False) as session:
        assert not session.shared_memory
        expected = driven(session, SLOTS + 3)
    placed = [type(obs.frames["front"]["rgb"]) is not real2sim.Frame for obs in kept]
    assert placed == [True] * SLOTS + [False] * 4
    for obs, other in zip(kept, expected, strict=True):
        for modality in MODALITIES:
            frame, plain = obs.frames["front"][modality], other.frames["front"][modality]
            np.testing.assert_array_equal(frame.array, plain.array)
            assert (frame.data, frame.array.dtype) == (plain.data, plain.array.dtype)


def test_slots_are_reused_when_the_last_view_is_released(client):
    with client.session(scene="tiny") as session:
        part = driven(session, 1)[0].image("front")[8:]
        before = part.copy()
        for _ in range(3 * SLOTS):
            obs = session.step(CONTROL)
            assert type(obs.frames["front"]["rgb"]) is not real2sim.Frame
        np.testing.assert_array_equal(part, before)


def test_requiring_shared_memory_fails_with_the_reason_if_unavailable(client, site, monkeypatch):
    monkeypatch.setattr(site.worker.sessions, "segments", Segments(MemoryBudget(1), 0))
    with client.session(scene="tiny") as session:
        assert not session.shared_memory
        assert driven(session, 1)[1].image("front").any()
    with pytest.raises(real2sim.UnreachableError, match="the worker offers none"):
        client.session(scene="tiny", shared_memory=True).open()
    with real2sim.connect(site.url, shared_memory=True) as must:
        with pytest.raises(real2sim.UnreachableError):
            must.session(scene="tiny").open()
        with must.session(scene="tiny", shared_memory=False) as session:
            assert not session.shared_memory


# --- memory -------------------------------------------------------------------------------------


@pytest.fixture
def segments():
    made = Segments(MemoryBudget(1 << 20), 4 << 20)
    opened: list[Segment] = []

    def create(**changes: int) -> Segment:
        opened.append(made.create())
        return opened[-1]

    yield create
    for one in opened:
        one.close()


def test_images_over_the_budget_or_the_slot_size_are_not_placed(segments):
    segment = segments()
    assert segment.place(0, [raw_frame(300, 1000)]) is not None
    assert segment.place(1, [raw_frame(300, 1000)]) is None  # over the budget
    assert segment.place(0, [raw_frame(400, 1000)]) is None  # over the slot size
    assert segment.place(0, [raw_frame(300, 1000)]) is not None
    assert 900_000 <= segment.taken_bytes < 1_000_000


def test_images_are_not_placed_if_the_machine_is_out_of_memory(segments, monkeypatch):
    segment = segments()

    def full(*_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module.os, "posix_fallocate", full)
    assert segment.place(0, [raw_frame(10, 10)]) is None
    assert segment.taken_bytes == 0
    assert Segments(MemoryBudget(1), 4 << 20).create() is None


def test_only_segments_of_killed_workers_are_removed(segments):
    path = Path(SHM_FOLDER, segments().offer["name"])
    left = path.with_name(f"real2sim-{os.urandom(16).hex()}")
    foreign = path.with_name(f"real2sim-{os.urandom(4).hex()}.txt")
    for file in (left, foreign):
        file.touch(0o400)
    try:
        assert left in sweep_segments()
        assert (path.exists(), left.exists(), foreign.exists()) == (True, False, True)
    finally:
        foreign.unlink()


# --- sizes --------------------------------------------------------------------------------------


def test_five_full_hd_cameras_with_all_modalities_fit_a_message_and_a_slot(site):
    info = site.create()
    scene = site.session(info).start.scene
    sensor = SensorSpec(camera="front", width=1920, modalities=MODALITIES, codec="raw")
    camera = site.worker.sessions.pipeline.cameras(scene, [sensor] * 5)["front"]
    assert (camera.width, camera.height) == (1920, 1280)

    frames = [raw_frame(1280, 1920, modality) for modality in MODALITIES] * 5
    message = pack_with_frames("obs", pack_members({}), frames, PhaseTimer())
    size = sum(len(part) for part in message.parts())
    assert 5 * 1920 * 1280 * 9 < size < MAX_IMAGE_BYTES < MAX_SERVER_MESSAGE_BYTES
    assert Settings().shared_memory_bytes // SLOTS > size
