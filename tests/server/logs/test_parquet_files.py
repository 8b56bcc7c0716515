"""Table damage that surfaces only when values are converted."""

from __future__ import annotations

import struct

import pyarrow as pa
import pytest
from pyarrow import feather
from pyarrow import parquet as pq

from real2sim_server.logs import LogError
from real2sim_server.logs.readers.files import ParquetFile, read_feather


def test_invalid_text_is_refused(tmp_path):
    good = "a text that can be found"
    file = tmp_path / "a.feather"
    feather.write_feather(pa.table({"t": [good]}), file, compression="uncompressed")
    whole = file.read_bytes()
    assert whole.count(good.encode()) == 1
    file.write_bytes(whole.replace(good.encode(), b"\xff" * len(good)))
    with pytest.raises(LogError, match=r"a\.feather: .*(broken|cannot be read)"):
        read_feather(file, ["t"])


def test_offsets_beyond_the_file_are_refused(tmp_path):
    good = "a text that can be found"
    file = tmp_path / "a.feather"
    feather.write_feather(pa.table({"t": [good]}), file, compression="uncompressed")
    whole = file.read_bytes()
    offsets = struct.pack("<ii", 0, len(good))
    at = whole.rindex(offsets, 0, whole.index(good.encode()))
    file.write_bytes(whole[:at] + struct.pack("<ii", 0, 1 << 30) + whole[at + 8 :])
    with pytest.raises(LogError, match=r"a\.feather: cannot be read as a Feather file"):
        read_feather(file, ["t"])


def test_invalid_column_names_in_feather_are_refused(tmp_path):
    name = "a_name_that_can_be_found"
    file = tmp_path / "a.feather"
    feather.write_feather(pa.table({name: [1]}), file, compression="uncompressed")
    file.write_bytes(file.read_bytes().replace(name.encode(), b"\x92" * len(name)))
    with pytest.raises(LogError, match=r"a\.feather: cannot be read as a Feather file"):
        read_feather(file, [name])


def test_invalid_column_names_in_parquet_are_refused(tmp_path):
    path = tmp_path / "damaged.parquet"
    pq.write_table(pa.table({"column": [1.0]}), path)
    path.write_bytes(path.read_bytes().replace(b"column", b"co\xffumn"))
    with pytest.raises(LogError, match="cannot be read as Parquet"):
        ParquetFile(path)
