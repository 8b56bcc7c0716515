"""``--follow``: a program that starts a sweep hears of it, and takes it along when it ends."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest


@pytest.fixture
def following(tmp_path, scene_folder):
    spec = {
        "case": {"name": "c", "scene": "tiny", "reset": {"horizon": 5}},
        "storyboard": "gallery:cut_in",
        "parameters": {"gap": {"low": 4.0, "high": 9.0}},
        "method": {"kind": "sobol", "count": 1_000},
    }
    (tmp_path / "sweep.json").write_text(json.dumps(spec))
    options = ["--out", tmp_path / "out", "--scenes", scene_folder, "--follow"]
    command = [sys.executable, "-m", "real2sim", "sweep", tmp_path / "sweep.json", *options]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe) as process:
        yield process
        process.kill()


def test_it_tells_how_far_it_is_and_ends_with_its_standard_input(following):
    told = [json.loads(following.stdout.readline()) for _ in range(2)]
    assert told == [{"stage": "episodes", "done": done, "total": 1_000} for done in (1, 2)]
    following.stdin.close()
    assert following.wait() == 1
