"""Untrusted pickled arrays: arrays are read, and no code is run."""

from __future__ import annotations

import io
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest

from real2sim_server.logs import LogError
from real2sim_server.logs.readers import street_gaussians
from real2sim_server.logs.readers.street_gaussians import read_pickled_arrays


def written(path: Path, pickled: bytes) -> Path:
    """Write an ``.npz`` whose entry ``clouds`` is the object ``pickled``."""
    head = io.BytesIO()
    described = {"descr": "|O", "fortran_order": False, "shape": ()}
    np.lib.format.write_array_header_1_0(head, described)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("clouds.npy", head.getvalue() + pickled)
    return path


class Calling:
    """An object that pickles to a call."""

    def __init__(self, function, *arguments, state=None):
        self.made_by = (function, arguments, state) if state else (function, arguments)

    def __reduce__(self):
        return self.made_by


def pointer_array() -> Calling:
    """An object array whose pointers come from the file."""
    return Calling(np.ndarray, (), np.dtype("O"), b"\x41" * 8)


@pytest.mark.parametrize("protocol", [3, 4, 5])
def test_a_dictionary_of_arrays_is_read(tmp_path, protocol):
    arrays = {
        0: np.arange(12, dtype=np.float32).reshape(4, 3),
        "000001": np.asfortranarray(np.arange(6, dtype=">i2").reshape(2, 3)),
        np.int64(2): np.zeros((0, 3)),
    }
    back = read_pickled_arrays(
        written(tmp_path / "a.npz", pickle.dumps(arrays, protocol=protocol)), "clouds"
    )
    assert list(back) == [0, "000001", 2]
    for key, array in arrays.items():
        np.testing.assert_array_equal(back[key], array)


def test_arrays_written_by_savez_are_read(tmp_path):
    np.savez(tmp_path / "a.npz", clouds={7: np.ones((2, 3))})
    assert read_pickled_arrays(tmp_path / "a.npz", "clouds")[7].tolist() == [[1, 1, 1]] * 2


@pytest.mark.parametrize(
    "value",
    [
        {0: pointer_array()},
        pointer_array(),
        {0: Calling(np.dtype("O").type)},
        {0: np.array([1, None], dtype=object)},
        {0: np.zeros(2, dtype=[("a", "f4")])},
        {0: np.array(["text"])},
        {0: Calling(Path.touch, Path("/tmp/never"))},
        {0: Calling(np._core.multiarray._reconstruct, np.matrix, (0,), b"b")},
        {0: Calling(np._core.multiarray.scalar, np.dtype("O"), b"\x41" * 8)},
        {0: Calling(np.dtype, "O", state=(3, "|", None, None, None, -1, -1, 63))},
        {0: [np.ones(3)]},
        [np.ones(3)],
        {(1, 2): np.ones(3)},
    ],
    ids=lambda value: type(value).__name__,
)
def test_anything_but_arrays_of_numbers_is_refused(tmp_path, value):
    file = written(tmp_path / "a.npz", pickle.dumps(value, protocol=4))
    with pytest.raises(LogError, match=r"a\.npz: entry 'clouds'"):
        read_pickled_arrays(file, "clouds")


def test_pointers_in_the_file_are_refused_in_process(tmp_path):
    file = written(tmp_path / "a.npz", pickle.dumps({0: pointer_array()}, protocol=4))
    with pytest.raises(LogError):
        street_gaussians.unpack_arrays(str(file), "clouds", str(tmp_path))


def test_truncated_pickles_are_refused(tmp_path):
    whole = pickle.dumps({0: np.arange(10, dtype=np.float32)}, protocol=4)
    for end in range(0, len(whole), 7):
        with pytest.raises(LogError, match="entry 'clouds'"):
            read_pickled_arrays(written(tmp_path / "a.npz", whole[:end]), "clouds")


def test_an_entry_beyond_the_size_limit_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(street_gaussians, "MAX_ENTRY_BYTES", 1000)
    np.savez_compressed(tmp_path / "a.npz", clouds={0: np.zeros(1000)})
    with pytest.raises(LogError, match="allowed are 1000"):
        street_gaussians.unpack_arrays(str(tmp_path / "a.npz"), "clouds", str(tmp_path))


def test_a_pickle_that_exhausts_memory_is_refused(tmp_path):
    greedy = b"\x80\x04" + b"N" + b"r\xff\xff\xff\x7f" + b"."
    with pytest.raises(LogError, match="memory"):
        read_pickled_arrays(written(tmp_path / "a.npz", greedy), "clouds")


def test_a_missing_entry_is_named(tmp_path):
    np.savez(tmp_path / "a.npz", others=np.ones(2))
    with pytest.raises(LogError, match="no entry 'clouds'"):
        read_pickled_arrays(tmp_path / "a.npz", "clouds")


def test_a_missing_file_is_an_error(tmp_path):
    with pytest.raises(LogError, match="cannot be read"):
        read_pickled_arrays(tmp_path / "a.npz", "clouds")
