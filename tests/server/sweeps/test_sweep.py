"""Sweeps: the same table whoever drives, and however often it is killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from real2sim.cli import build_app
from real2sim_server.console import CommandError
from real2sim_server.executors import Executor, InProcess, executor_of
from real2sim_server.scene import BundleError
from real2sim_server.sweeps import load_sweep, run_sweep
from real2sim_server.sweeps.episode import signed_gaps
from real2sim_server.sweeps.sweep import FORMAT, JOURNAL, RECORDINGS, TABLE, Journal
from real2sim_server.world.recording import first_difference, load_recording
from tests.server.planners import ALL, AND_LIMITS, REASONS, none_left_running

SLOW = pytest.mark.slow
SWEEP = {
    "case": {
        "name": "brakes",
        "scene": "tiny",
        "reset": {"agents": {"drivers": {"car_blue": {"kind": "hard_brake"}}}, "horizon": 15},
    },
    "parameters": {
        "gap": {"path": "agents.drivers.car_blue.gap", "low": 5, "high": 25},
        "braking": {"path": "agents.drivers.car_blue.braking", "low": 4, "high": 9},
    },
    "method": {"kind": "sobol", "count": 4},
    "planners": ["pid", "idm"],
    "metrics": ["nuplan_cls"],
    "worst": 2,
}


@pytest.fixture(scope="module")
def sweep_file(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("sweep") / "sweep.yaml"
    path.write_text(yaml.safe_dump(SWEEP))
    return path


@pytest.fixture(scope="module")
def alone(sweep_file, scene_folder, tmp_path_factory) -> Path:
    """The folder of a sweep that went through."""
    out = tmp_path_factory.mktemp("alone")
    run_sweep(load_sweep(sweep_file), out, InProcess(), scenes=scene_folder)
    return out


def test_the_table_has_one_row_per_episode_in_order(alone):
    rows = pq.read_table(alone / TABLE).to_pylist()
    assert [(r["point"], r["planner"]) for r in rows] == [
        (k, name) for k in range(4) for name in ("pid", "idm")
    ]
    assert all(r["error"] is None and r["steps"] > 0 and 5 <= r["gap"] <= 25 for r in rows)
    assert all(0 <= r["score_nuplan_cls"] <= 1 for r in rows)


def test_finished_episodes_are_not_driven_again(alone, sweep_file, scene_folder):
    before = (alone / TABLE).read_bytes()
    figures = run_sweep(load_sweep(sweep_file), alone, InProcess(), scenes=scene_folder)
    assert figures["driven now"] == 0
    assert (alone / TABLE).read_bytes() == before


def test_recordings_of_the_worst_episodes_replay_identically(alone, tiny_scene, scene_folder):
    from real2sim_server.scene.io import load_scene

    files = sorted((alone / RECORDINGS).iterdir())
    assert len(files) == 2
    for file in files:
        recording = load_recording(file)
        assert (
            first_difference(recording, recording.replayer(load_scene(scene_folder / "tiny")))
            is None
        )


def test_replay_finds_a_scene_by_the_name_that_the_sweep_gave(alone, scene_folder, tmp_path):
    recording, figures = next((alone / RECORDINGS).iterdir()), tmp_path / "figures.json"
    command = ["replay", str(recording), "--json", str(figures), "--scenes", str(scene_folder)]
    done = CliRunner().invoke(build_app(), [*command, "--scene", "tiny"])
    assert done.exit_code == 0, done.output
    assert json.loads(figures.read_text())["bit_identical"]
    unknown = CliRunner().invoke(build_app(), [*command, "--scene", "nowhere"])
    assert unknown.exit_code == 1
    assert "no scene 'nowhere'" in unknown.output


def test_recordings_may_be_read_by_whom_the_umask_allows(alone):
    umask = os.umask(0)
    os.umask(umask)
    for file in (alone / RECORDINGS).iterdir():
        assert file.stat().st_mode & 0o777 == 0o666 & ~umask


def test_cut_off_anywhere_the_journal_leads_to_the_same_table(
    alone, sweep_file, scene_folder, tmp_path
):
    """As after a kill at that byte; four rows of eight are enough to see it."""
    whole = (alone / JOURNAL).read_bytes()
    for k, cut in enumerate((0, 7, len(FORMAT) + 1, len(whole) // 2, len(whole) - 1)):
        out = tmp_path / str(k)
        out.mkdir()
        (out / JOURNAL).write_bytes(whole[:cut])
        figures = run_sweep(load_sweep(sweep_file), out, InProcess(), scenes=scene_folder)
        assert figures["driven now"] > 0
        assert (out / TABLE).read_bytes() == (alone / TABLE).read_bytes()


@settings(max_examples=20, deadline=None)
@given(cut=st.integers(0, 10_000), flip=st.integers(0, 10_000))
def test_of_a_journal_that_is_cut_and_damaged_only_rows_that_were_written_are_left(
    tmp_path_factory, cut, flip
):
    path = tmp_path_factory.mktemp("journal") / "journal"
    rows = {f"key{k}": {"x": k / 3, "text": "a\nb", "none": None} for k in range(5)}
    with Journal(path) as journal:
        for key, row in rows.items():
            journal.add(key, row)
    data = bytearray(path.read_bytes())
    head = len(FORMAT) + 1
    data[head + flip % (len(data) - head)] ^= 0x5A
    path.write_bytes(data[: max(head, cut % (len(data) + 1))])
    found = Journal(path).rows
    assert all(rows[key] == row for key, row in found.items())
    with Journal(path) as again:
        again.add("new", {"x": 1.5})
    assert Journal(path).rows == found | {"new": {"x": 1.5}}


def test_another_file_is_not_accepted_as_a_journal(tmp_path):
    path = tmp_path / "journal"
    path.write_text("something else\n")
    with pytest.raises(ValueError, match="not a journal"):
        Journal(path)


def test_a_stop_rule_ends_at_the_same_row_whatever_was_driven(alone, scene_folder, tmp_path):
    path = tmp_path / "stop.yaml"
    path.write_text(yaml.safe_dump(SWEEP | {"stop": {"episodes": 3}, "worst": 0}))
    run_sweep(load_sweep(path), tmp_path / "out", InProcess(), scenes=scene_folder)
    whole = pq.read_table(alone / TABLE).to_pylist()
    assert pq.read_table(tmp_path / "out" / TABLE).to_pylist() == whole[:3]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"metrics": ["beauty"]}, "no score 'beauty'"),
        ({"rank_by": "beauty"}, "not a column"),
        ({"planners": ["depth_sampling"]}, "sweeps only render rgb"),
        ({"planners": ["nobody"]}, "is unknown"),
        ({"case": SWEEP["case"] | {"scene": "nowhere"}}, "no scene 'nowhere'"),
        ({"parameters": {"steps": {"low": 0, "high": 1}}}, "name of a column"),
    ],
)
def test_invalid_sweeps_are_refused_before_driving(tmp_path, scene_folder, change, message):
    path = tmp_path / "sweep.yaml"
    path.write_text(yaml.safe_dump(SWEEP | change))
    with pytest.raises((CommandError, BundleError), match=message):
        run_sweep(load_sweep(path), tmp_path / "out", InProcess(), scenes=scene_folder)
    assert not (tmp_path / "out").exists()


def test_an_episode_that_cannot_start_gets_a_row_with_the_reason(tmp_path, scene_folder):
    path = tmp_path / "sweep.yaml"
    start = {"path": "start_us", "low": 1e9, "high": 2e9}
    path.write_text(yaml.safe_dump(SWEEP | {"parameters": {"start": start}, "planners": ["pid"]}))
    figures = run_sweep(load_sweep(path), tmp_path / "out", InProcess(), scenes=scene_folder)
    rows = pq.read_table(tmp_path / "out" / TABLE).to_pylist()
    assert figures["errors"] == len(rows) == 4
    assert rows[0]["reason"] == "refused"
    assert "start_us" in rows[0]["error"]


@pytest.mark.parametrize(
    ("failures", "limit_s"),
    [({"Exits": REASONS["Exits"]}, 60.0), *(pytest.param(*a, marks=SLOW) for a in AND_LIMITS)],
    ids=["exits", "misbehave", "never answer"],
)
def test_planners_that_misbehave_fail_in_their_own_rows(failures, limit_s, scene_folder, tmp_path):
    path, own = tmp_path / "sweep.yaml", "real2sim.planners.pid:PidFollowRoute"
    planners = [*(ALL[name] for name in failures), "pid", *([own] if limit_s > 1 else [])]
    one = {"method": {"kind": "sobol", "count": 1}, "planners": planners}
    path.write_text(yaml.safe_dump(SWEEP | one))
    out, sweep = tmp_path / "out", load_sweep(path)
    with none_left_running(tmp_path):
        figures = run_sweep(sweep, out, InProcess(), scenes=scene_folder, plan_limit_s=limit_s)
    rows = {row["planner"]: row for row in pq.read_table(out / TABLE).to_pylist()}
    assert figures["planner failed"] == figures["errors"] == len(failures)
    first = next(iter(failures))
    assert figures["first error"] == f"{ALL[first]}: {rows[ALL[first]]['error']}"
    for name, reason in failures.items():
        assert rows[ALL[name]]["reason"] == "planner failed"
        assert rows[ALL[name]]["error"].startswith(reason)
    good = [{**rows[n], "planner": None, "episode": None} for n in planners[len(failures) :]]
    assert all(row == good[0] for row in good)
    assert good[0]["error"] is None


@pytest.mark.slow
def test_two_processes_give_the_same_bytes_as_one(alone, sweep_file, scene_folder, tmp_path):
    two = executor_of("processes", workers=2)
    run_sweep(load_sweep(sweep_file), tmp_path, two, scenes=scene_folder)
    assert (tmp_path / TABLE).read_bytes() == (alone / TABLE).read_bytes()


@pytest.mark.ray
@pytest.mark.slow
def test_ray_gives_the_same_bytes_as_one_process(alone, sweep_file, scene_folder, tmp_path):
    pytest.importorskip("ray")
    run_sweep(load_sweep(sweep_file), tmp_path, executor_of("ray", workers=2), scenes=scene_folder)
    assert (tmp_path / TABLE).read_bytes() == (alone / TABLE).read_bytes()


class Mortal:
    """A worker whose process is killed at its second episode, once of all workers."""

    def __init__(self, recipe, folder: Path, threads: int) -> None:
        self._worker, self._folder, self._begun = recipe(threads), folder, 0

    def make(self, task):
        self._begun += 1
        with (self._folder / "begun").open("a") as file:
            file.write(f"{os.getpid()}\n")
        if self._begun == 2:
            with suppress(FileExistsError):
                (self._folder / "killed").touch(exist_ok=False)
                os.kill(os.getpid(), signal.SIGKILL)
        return self._worker.make(task)


@dataclass
class Deadly:
    """An executor whose workers are mortal."""

    executor: Executor
    folder: Path

    def run(self, recipe, tasks, on_result) -> None:
        self.executor.run(partial(Mortal, recipe, self.folder), tasks, on_result)


@pytest.mark.ray
@pytest.mark.slow
def test_an_actor_killed_in_a_sweep_costs_one_episode_and_changes_no_byte(
    alone, sweep_file, scene_folder, tmp_path
):
    pytest.importorskip("ray")
    deadly = Deadly(executor_of("ray", workers=2), tmp_path)
    figures = run_sweep(load_sweep(sweep_file), tmp_path / "out", deadly, scenes=scene_folder)
    begun = (tmp_path / "begun").read_text().split()
    assert (tmp_path / "killed").exists()
    assert len(begun) == figures["episodes"] + 1
    assert len(set(begun)) == 3
    assert (tmp_path / "out" / TABLE).read_bytes() == (alone / TABLE).read_bytes()


KILLED_AFTER_THREE = """
import os, signal
from real2sim.cli import main
from real2sim_server.sweeps.sweep import Journal
add = Journal.add
def add_and_die(self, key, row):
    add(self, key, row)
    if len(self.rows) == 3:
        os.kill(os.getpid(), signal.SIGKILL)
Journal.add = add_and_die
main()
"""


@pytest.mark.slow
def test_killed_before_its_end_the_command_goes_on_to_the_same_table(
    alone, sweep_file, scene_folder, tmp_path
):
    command = ["sweep", str(sweep_file), "--out", str(tmp_path), "--scenes", str(scene_folder)]
    ended = subprocess.call([sys.executable, "-c", KILLED_AFTER_THREE, *command])
    assert ended == -signal.SIGKILL
    assert len(Journal(tmp_path / JOURNAL).rows) == 3
    done = CliRunner().invoke(build_app(), command)
    assert done.exit_code == 0, done.output
    assert (tmp_path / TABLE).read_bytes() == (alone / TABLE).read_bytes()


boxes = st.tuples(
    st.floats(-10, 10), st.floats(-10, 10), st.floats(-4, 4), st.floats(0.5, 6), st.floats(0.5, 3)
)


@settings(max_examples=60, deadline=None)
@given(one=boxes, other=boxes)
def test_gaps_between_boxes_are_those_of_points_along_their_sides(one, other):
    """Sampled every few centimetres; boxes that overlap have a gap below 0."""

    def sides(box):
        x, y, yaw, length, width = box
        u = np.linspace(-0.5, 0.5, 60)
        half = np.full(60, 0.5)
        local = np.concatenate(
            [np.stack(p, 1) for p in ((u, half), (u, -half), (half, u), (-half, u))]
        ) * [length, width]
        c, s = np.cos(yaw), np.sin(yaw)
        return local @ np.array([[c, s], [-s, c]]) + [x, y]

    a, b = sides(one), sides(other)
    sampled = np.sqrt(((a[:, None] - b) ** 2).sum(axis=2)).min()
    x, y, yaw, length, width = other
    gap = signed_gaps(one, np.array([[x, y]]), np.array([yaw]), np.array([[length, width]]))[0]
    if gap > 0:
        assert gap <= sampled + 1e-9
        assert sampled <= gap + 0.15
    else:
        assert sampled < 0.15 or gap < -0.05
