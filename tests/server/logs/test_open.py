from __future__ import annotations

from pathlib import Path

import pytest

from real2sim_server.logs import LogError, open_log
from real2sim_server.logs.readers.native import NativeReader


def test_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="nowhere: no such folder"):
        open_log(tmp_path / "nowhere")


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
