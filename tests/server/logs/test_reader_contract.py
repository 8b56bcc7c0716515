from __future__ import annotations

from pathlib import Path

import pytest

from real2sim_server.logs.readers import READERS

from .reader_contract import ReaderContract


class TestKnownReaders(ReaderContract):
    """Every reader with the drive of its fixture ``written_<name>``."""

    @pytest.fixture(params=[*(reader.name for reader in READERS), "kitti_jam"])
    def folder(self, request: pytest.FixtureRequest) -> Path:
        if request.param == "kitti_jam":
            path: Path = request.getfixturevalue("test_data") / "kitti_jam"
            if not path.is_dir():
                pytest.skip(f"no sample drive at {path}")
            return path
        written: Path = request.getfixturevalue(f"written_{request.param}")
        return written
