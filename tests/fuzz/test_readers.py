"""Every reader refuses damaged files with its documented errors, within limits of time and memory.

``REAL2SIM_FUZZ_INPUTS`` (default 2000 per reader) sets the number of inputs, ``REAL2SIM_FUZZ_SEED``
(default 0) the seed, and ``REAL2SIM_FUZZ_CORPUS`` the folder that keeps inputs of interest between
runs.
"""

from __future__ import annotations

import contextlib
import importlib.util
import random
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


@pytest.fixture
def fuzzer(monkeypatch):
    """The modules of the fuzzer, which import each other by name."""
    monkeypatch.syspath_prepend(str(FOLDER))
    names = ("mutation", "readers", "run_target")
    yield SimpleNamespace(**{name: importlib.import_module(name) for name in names})
    for name in names:
        sys.modules.pop(name, None)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", [n for n in NAMES if n.startswith(("map_", "openscenario"))])
def test_sixty_damaged_maps_and_scenarios_are_read_or_refused(fuzzer, tmp_path, name):
    target = fuzzer.readers.target(name, None)
    samples = target.sample(tmp_path)
    read = 0
    for number in range(60):
        rng = random.Random(f"{name} {number}")
        parts = fuzzer.run_target.damaged(rng.choice(samples), samples, rng)
        with contextlib.suppress(*target.errors):
            target.read(target.write(parts, tmp_path))
            read += 1
    assert read


def test_the_same_seed_gives_the_same_inputs(fuzzer):
    data = b"0123456789" * 50
    runs = [fuzzer.mutation.damaged_bytes(data, [], random.Random(7)) for _ in range(2)]
    assert runs[0] == runs[1] != b"0123456789" * 50
