"""Every reader refuses damaged files with its documented errors, within limits of time and memory.

``REAL2SIM_FUZZ_INPUTS`` (default 2000 per reader) sets the number of inputs, ``REAL2SIM_FUZZ_SEED``
(default 0) the seed, and ``REAL2SIM_FUZZ_CORPUS`` the folder that keeps inputs of interest between
runs.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

FOLDER = Path(__file__).parent


def _module(name: str):
    spec = importlib.util.spec_from_file_location(f"fuzz_{name}", FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


check = _module("check")
NAMES = (
    "ply", "playcanvas_ply", "spz", "spz_packed", "spz4", "splat", "bundle", "asset", "packed",
    "packed_zip", "recording", "recording_zip", "mcap", "pickle", "checkpoint", "checkpoint_zip",
    "old_checkpoint", "image", "sweep", "protobuf", "tfrecord", "parquet", "feather", "message",
    "sweep_space", "openscenario", "episode_journal",
    "map_native", "map_opendrive", "map_lanelet2", "map_argoverse2", "map_nuscenes",
)  # fmt: skip


def test_without_a_pytest_cache_the_corpus_is_below_out(monkeypatch, tmp_path):
    monkeypatch.delenv("REAL2SIM_FUZZ_CORPUS", raising=False)
    monkeypatch.setattr(check, "REPOSITORY", tmp_path)
    assert check.corpus_folder(SimpleNamespace()) == tmp_path / "out/fuzz"
    assert (tmp_path / "out/fuzz").is_dir()


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", NAMES)
def test_damaged_input_is_refused(name, pytestconfig):
    if name == "mcap":
        pytest.importorskip("mcap")
    check.check_target(name, pytestconfig)


def test_the_same_seed_gives_the_same_inputs():
    sys.path.insert(0, str(FOLDER))
    try:
        import random

        mutation = _module("mutation")
        runs = [mutation.damaged_bytes(b"0123456789" * 50, [], random.Random(7)) for _ in range(2)]
    finally:
        sys.path.remove(str(FOLDER))
    assert runs[0] == runs[1] != b"0123456789" * 50
