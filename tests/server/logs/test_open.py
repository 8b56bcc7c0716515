from __future__ import annotations

from pathlib import Path

import pytest

from real2sim_server.logs import LogError, open_log
from real2sim_server.logs.readers import READERS, LogReader
from real2sim_server.logs.readers.native import NativeReader


def test_missing_path_is_named(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"(?s)nowhere: no such file or folder; .*native: log\.json"):
        open_log(tmp_path / "nowhere")


def test_a_drive_that_is_one_file_opens_like_its_folder(written_waymo_v1: Path) -> None:
    log = open_log(written_waymo_v1 / "tiny.tfrecord")
    assert log.provenance == open_log(written_waymo_v1).provenance
    assert log.frame_count == 3


def test_the_sequence_of_a_file_is_its_name(written_waymo_v1: Path) -> None:
    file = written_waymo_v1 / "tiny.tfrecord"
    assert open_log(file, sequence="tiny").frame_count == 3
    with pytest.raises(LogError, match=r"tiny\.tfrecord: holds .*'tiny'.*there is no 'other'"):
        open_log(file, sequence="other")


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_no_reader_takes_a_file_of_another_kind(reader: LogReader, tmp_path: Path) -> None:
    file = tmp_path / "notes.txt"
    file.write_text("no log")
    assert not reader.recognises(file)
    with pytest.raises(LogError, match=r"notes\.txt"):
        open_log(file, format=reader.name)


def test_empty_folder_lists_all_formats(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"(?s)not a log.*native: log\.json.*kitti: .*velodyne"):
        open_log(tmp_path)


def test_unknown_format_lists_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"(?s)unknown log format 'rosbag'.*kitti"):
        open_log(tmp_path, format="rosbag")


def test_named_format_is_not_guessed(written_native: Path) -> None:
    with pytest.raises(LogError, match="image_02"):
        open_log(written_native, format="kitti")


def test_unexpected_reader_errors_become_log_errors(native_folder, monkeypatch):
    def fail(self, path, *, sequence=None):
        raise KeyError("a token")

    monkeypatch.setattr(NativeReader, "read", fail)
    with pytest.raises(LogError, match=r"native.*is damaged.*KeyError.*a token"):
        open_log(native_folder)
