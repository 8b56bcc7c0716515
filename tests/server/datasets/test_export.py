"""End to end: always the same bytes, even after a kill, and nothing left half done."""

from __future__ import annotations

import hashlib
import json
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from real2sim_proto.episode import ResetSpec
from real2sim_server.cli import export as command
from real2sim_server.console import CommandError
from real2sim_server.datasets.drive import DatasetError, EpisodeDrive
from real2sim_server.datasets.export import estimate, export_dataset, work_folder
from real2sim_server.datasets.plan import planned_clips
from real2sim_server.edit import ScenarioState
from real2sim_server.scene.io import load_scene, save_scene
from real2sim_server.world.recording import record
from real2sim_server.world.replay import KEPT_PLAN, Entry, Replayer, reset_payload


def contents(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


class Killed(BaseException):
    """Nothing catches it, just as nothing catches the death of a process."""


@pytest.mark.parametrize(
    "stage", [("frames", 4), pytest.param(("formats", 3), marks=pytest.mark.slow)]
)
def test_a_stopped_export_resumes_to_the_same_bytes(exported, tiny_drive, plan, tmp_path, stage):
    labelled = []

    def stop(*progress) -> None:
        if progress[:2] == stage:
            raise Killed

    def count(name: str, done: int, _total: int) -> None:
        labelled.append((name, done))

    out = tmp_path / "again"
    with pytest.raises(Killed):
        export_dataset(tiny_drive, plan, out, on_progress=stop)
    assert not out.exists()
    export_dataset(tiny_drive, plan, out, on_progress=count)
    assert contents(out) == contents(exported)
    # The clip that was complete is not rendered again.
    assert ("frames", 1) not in labelled
    assert not work_folder(out).exists()


def test_the_manifest_names_every_file_with_its_hash(exported):
    manifest = json.loads((exported / "manifest.json").read_text())
    found = contents(exported)
    del found["manifest.json"]
    assert {name: file["sha256"] for name, file in manifest["files"].items()} == found
    assert manifest["statistics"]["boxes"] == {"car": 10, "pole": 5}
    assert sorted({clip["split"] for clip in manifest["clips"].values()}) == ["train", "val"]


def test_the_export_includes_the_licence_of_the_source(tiny_drive, plan, tmp_path):
    terms = "CC BY-NC-SA 3.0 (Geiger et al. 2013)"
    provenance = {**tiny_drive.scene.provenance, "dataset": "KITTI", "licence": terms}
    drive = replace(tiny_drive, scene=replace(tiny_drive.scene, provenance=provenance))
    short = replace(plan, formats=("coco",), cameras=("left",), end_us=0, flow=False)
    out = export_dataset(drive, short, tmp_path / "out")
    assert terms in (out / "LICENSE.txt").read_text()
    assert json.loads((out / "manifest.json").read_text())["licence"] == terms


def test_an_export_of_something_else_is_not_resumed(tiny_drive, plan, tmp_path):
    out = tmp_path / "out"
    work_folder(out).mkdir()
    (work_folder(out) / "digest").write_text("another")
    with pytest.raises(DatasetError, match="stopped export"):
        export_dataset(tiny_drive, plan, out)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"formats": ("kitty",)}, "allowed are labels, kitti"),
        ({"formats": ()}, "at least one format"),
        ({"cameras": ("rear",)}, "the scene has front, left"),
        ({"end_us": 9_000_000}, "there is 0 to 2000000"),
        ({"splits": {"train": -1.0}}, "a share above 0"),
        ({"period_us": 0}, "must be positive"),
    ],
)
def test_invalid_exports_are_refused(tiny_drive, plan, tmp_path, change, message):
    with pytest.raises(DatasetError, match=message):
        export_dataset(tiny_drive, replace(plan, **change), tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_an_existing_folder_is_not_touched(tiny_drive, plan, tmp_path):
    with pytest.raises(DatasetError, match="exists already"):
        export_dataset(tiny_drive, plan, tmp_path)


def test_splits_depend_on_the_seed(tiny_drive, plan):
    long = replace(plan, end_us=2_000_000, clip_s=0.25, splits={"train": 0.75, "val": 0.25})
    drawn = [
        [clip.split for clip in planned_clips(tiny_drive, replace(long, seed=seed))]
        for seed in (0, 0, 1)
    ]
    assert drawn[0] == drawn[1] != drawn[2]
    assert all(names.count("val") == 2 for names in drawn)


def test_a_dry_run_reports_the_amount_of_data(tiny_drive, plan, exported):
    guess = estimate(tiny_drive, plan)
    assert (guess.frames, guess.images) == (5, 10)
    written = sum(path.stat().st_size for path in exported.rglob("*") if path.is_file())
    assert written / 3 < guess.nbytes < written * 3
    assert guess.minutes > 0


def test_the_command_exports_edited_scenes(tiny_scene, tmp_path):
    save_scene(tiny_scene, tmp_path / "tiny.r2s")
    edits = [{"op": "delete", "object_id": "car_blue"}]
    (tmp_path / "edits.json").write_text(json.dumps(edits))
    command.export_dataset(
        scene=tmp_path / "tiny.r2s",
        out=tmp_path / "out",
        format_=["coco"],
        operations=tmp_path / "edits.json",
        cameras="front",
        period=0.5,
        end_us=500_000,
        json=tmp_path / "figures.json",
    )
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert figures["frames"] == 2
    assert figures["boxes"] == {"car": 2, "pole": 2}
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert manifest["made_of"] == {"operations": edits}


def test_the_command_explains_invalid_options(tiny_scene, tmp_path):
    (tmp_path / "edits.json").write_text("[{}]")
    with pytest.raises(CommandError, match="allowed are shares such as"):
        command.export_dataset(scene=tmp_path, out=tmp_path, format_=["coco"], splits="train")
    with pytest.raises(CommandError, match="is not a list of edits"):
        command._edited(tiny_scene, tmp_path / "edits.json", None)


def recorded_episode(scene, tmp_path: Path) -> EpisodeDrive:
    """Four steps on the recorded drive."""
    entries = [Entry("reset", 0, reset_payload(ResetSpec()))]
    entries += [Entry("action", step, KEPT_PLAN) for step in range(4)]
    save_scene(scene, tmp_path / "tiny.r2s")
    saved = load_scene(tmp_path / "tiny.r2s")
    made = record(
        Replayer.on(saved, ScenarioState.of(saved)), entries, scene_hash=saved.content_hash
    )
    return EpisodeDrive.of(made, saved)


def test_an_episode_is_exported_as_it_happened(tiny_scene, plan, tmp_path):
    drive = recorded_episode(tiny_scene, tmp_path)
    short = replace(plan, formats=("labels",), period_us=200_000, end_us=400_000, flow=False)
    out = export_dataset(drive, short, tmp_path / "out")
    frames = json.loads((out / "labels" / "0000" / "labels.json").read_text())["frames"]
    moved = [frame["T_world_ego"][0][3] for frame in frames]
    assert moved == [world.T_world_body[0, 3] for world in drive.worlds[::2]]


PROGRAM = """
import os, signal, sys
from pathlib import Path
from real2sim_server.datasets.drive import ScenarioDrive
from real2sim_server.datasets.export import export_dataset
from real2sim_server.datasets.plan import ExportPlan
from real2sim_server.edit import ScenarioState
from real2sim_server.scene.io import load_scene
scene = load_scene(sys.argv[1])
plan = ExportPlan(formats=("kitti", "coco"), period_us=50_000, clip_s=0.4)
folder, clips = Path(sys.argv[3]), int(sys.argv[4])
def die(*_):
    if len(list(folder.glob("[0-9]*"))) == clips:
        os.kill(os.getpid(), signal.SIGKILL)
drive = ScenarioDrive(scene, ScenarioState.of(scene))
export_dataset(drive, plan, sys.argv[2], on_progress=die)
"""


@pytest.mark.slow
@pytest.mark.parametrize("clips", [1, 3, 5])
def test_a_killed_process_resumes_to_the_same_bytes(tiny_scene, tmp_path, clips):
    save_scene(tiny_scene, tmp_path / "tiny.r2s")

    clips_folder = work_folder(tmp_path / "killed") / "clips"

    def exported_to(name: str, kill_after: int = -1) -> int:
        words = [tmp_path / "tiny.r2s", tmp_path / name, clips_folder, kill_after]
        return subprocess.call([sys.executable, "-c", PROGRAM, *map(str, words)])

    assert exported_to("whole") == 0
    assert exported_to("killed", kill_after=clips) == -signal.SIGKILL
    assert not (tmp_path / "killed").exists()
    assert exported_to("killed") == 0
    assert contents(tmp_path / "killed") == contents(tmp_path / "whole")
