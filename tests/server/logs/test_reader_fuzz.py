"""Fuzzing of readers: drives with one damaged file raise only LogError."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path

import pytest

from real2sim_server.logs.readers import READERS

FUZZ = Path(__file__).resolve().parents[2] / "fuzz" / "check.py"


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", [reader.name for reader in READERS])
def test_a_damaged_drive_raises_only_log_errors(name, request, tmp_path):
    spec = importlib.util.spec_from_file_location("fuzz_check", FUZZ)
    check = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(check)
    drive = shutil.copytree(request.getfixturevalue(f"written_{name}"), tmp_path / "drive")
    check.check_target(name, request.config, drive=drive, inputs=300)
