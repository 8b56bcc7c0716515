"""Shared memory offered by a worker, read by the client."""

from __future__ import annotations

import gc
import pickle
from pathlib import Path

import numpy as np
import pytest

from real2sim import MalformedReplyError, _session_state
from real2sim._session_state import SharedFrames
from real2sim.images import frame_from_wire
from real2sim_proto.drive import SHM_HEADER_BYTES, SHM_MAGIC, Frame, SharedMemory, Welcome

NAME = "real2sim-" + "0" * 32
SLOT = 64
OFFER = SharedMemory(name=NAME, slots=2, slot_bytes=SLOT)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Holds a worker's shared memory: grey ramps in two slots."""
    monkeypatch.setattr(_session_state, "SHM_FOLDER", str(tmp_path))
    header = (SHM_MAGIC + b"s" * 32).ljust(SHM_HEADER_BYTES, b"\0")
    (tmp_path / NAME).write_bytes(header + bytes(range(2 * SLOT)))
    return tmp_path


def frame(offset: int | None = None, height: int = 2, **changes: object) -> Frame:
    fields = {
        "sensor": "front",
        "modality": "rgb",
        "t_us": 0,
        "T_world_sensor": np.eye(4),
        "K": np.eye(3),
        "codec": "raw",
        "dtype": "uint8",
        "shape": [height, 4, 3],
        "offset": offset,
        "data": b"",
    }
    return Frame.model_validate(fields | changes)


def test_images_are_read_in_place(folder):
    memory = SharedFrames(OFFER)
    assert memory.secret == b"s" * 32
    assert memory.lend() == 0
    wires = [frame(SHM_HEADER_BYTES), frame(data=b"\1" * 24), frame(SHM_HEADER_BYTES + 32)]
    pixels = memory.pixels_of(wires)
    first, second, third = map(frame_from_wire, wires, pixels)
    assert second.array.ravel().tolist() == [1] * 24
    assert third.array.ravel().tolist() == list(range(32, 56))
    assert (third.array.shape, third.array.flags.writeable) == ((2, 4, 3), False)
    assert first.data == bytes(range(24))


def test_a_slot_is_lent_again_once_its_views_are_gone(folder):
    memory = SharedFrames(OFFER)
    slot = memory.lend()
    assert memory.lend() == slot  # The answer is still pending.
    wire = frame(SHM_HEADER_BYTES + SLOT * slot)
    view = frame_from_wire(wire, *memory.pixels_of([wire])).array[0, :2]
    other = memory.lend()
    held = memory.pixels_of([frame(SHM_HEADER_BYTES + SLOT * other)])
    assert {slot, other} == {0, 1}
    assert memory.lend() is None
    del view
    gc.collect()
    assert memory.lend() == slot
    assert held[0] is not None


def test_a_frame_can_be_pickled(folder):
    memory = SharedFrames(OFFER)
    wire = frame(SHM_HEADER_BYTES + SLOT * memory.lend())
    found = frame_from_wire(wire, *memory.pixels_of([wire]))
    again = pickle.loads(pickle.dumps(found))
    np.testing.assert_array_equal(again.array, found.array)
    assert again.data == found.data


@pytest.mark.parametrize(
    "wrong",
    [
        frame(0),
        frame(SHM_HEADER_BYTES - 1),
        frame(SHM_HEADER_BYTES + 2 * SLOT),
        frame(SHM_HEADER_BYTES, height=6),
        frame(SHM_HEADER_BYTES, shape=[-1, 4, 3]),
    ],
)
def test_an_image_outside_its_slot_is_refused(folder, wrong):
    memory = SharedFrames(OFFER)
    assert memory.lend() == 0
    with pytest.raises(MalformedReplyError, match="not in the slot"):
        memory.pixels_of([wrong])


def test_an_image_without_a_lent_slot_is_refused(folder):
    with pytest.raises(MalformedReplyError, match="no slot"):
        SharedFrames(OFFER).pixels_of([frame(SHM_HEADER_BYTES)])


@pytest.mark.parametrize("content", [b"", b"x" * 10_000, SHM_MAGIC])
def test_a_file_without_a_valid_header_is_refused(folder, content):
    (folder / NAME).write_bytes(content)
    with pytest.raises(OSError, match=NAME):
        SharedFrames(OFFER)


def test_a_symbolic_link_is_refused(folder):
    (folder / NAME).rename(folder / "elsewhere")
    (folder / NAME).symlink_to(folder / "elsewhere")
    with pytest.raises(OSError, match="symbolic"):
        SharedFrames(OFFER)


@pytest.mark.parametrize("name", ["../etc/passwd", "/etc/passwd", "real2sim-x", "a" * 41])
def test_an_invalid_segment_name_is_refused(name):
    with pytest.raises(ValueError, match="pattern"):
        SharedMemory(name=name, slots=1, slot_bytes=1)


def test_a_welcome_has_no_shared_memory_by_default():
    assert Welcome.model_fields["shared_memory"].default is None
