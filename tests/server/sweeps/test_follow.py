"""``--follow``: a program that starts a sweep hears of it, and takes it along when it ends."""

from __future__ import annotations

import json
import os

import pytest

from tests.waiting import LIMIT_S, wait_until

from ..worker_processes import json_lines, start_real2sim


@pytest.fixture
def following(tmp_path, scene_folder):
    spec = {
        "case": {"name": "c", "scene": "tiny", "reset": {"horizon": 5}},
        "storyboard": "gallery:cut_in",
        "parameters": {"gap": {"low": 4.0, "high": 9.0}},
        "method": {"kind": "sobol", "count": 1_000},
    }
    (tmp_path / "sweep.json").write_text(json.dumps(spec))
    read, log_file = tmp_path / "input", tmp_path / "output"
    os.mkfifo(read)
    options = ["--out", tmp_path / "out", "--scenes", scene_folder, "--follow"]
    process = start_real2sim(
        [str(word) for word in ("sweep", tmp_path / "sweep.json", *options)],
        log_file=log_file,
        before=f"os.dup2(os.open({str(read)!r}, os.O_RDONLY), 0)",
    )
    try:
        with read.open("wb") as standard_input:
            yield process, standard_input, log_file
    finally:
        process.kill()
        process.join()


@pytest.mark.slow
def test_follow_reports_progress_and_ends_with_standard_input(following):
    process, standard_input, log_file = following
    wait_until(lambda: len(json_lines(log_file)) >= 2, "two lines of progress")
    assert json_lines(log_file)[:2] == [
        {"stage": "episodes", "done": done, "total": 1_000} for done in (1, 2)
    ]
    standard_input.close()
    process.join(LIMIT_S)
    assert process.exitcode == 1
