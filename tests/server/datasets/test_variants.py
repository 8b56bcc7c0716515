"""Sweeps, starts beside the path, detector errors and custom rigs."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from real2sim_proto.jobs import DatasetSweep
from real2sim_server.cli import export as command
from real2sim_server.console import CommandError
from real2sim_server.datasets.clips import Clip
from real2sim_server.datasets.drive import DatasetError
from real2sim_server.datasets.export import export_dataset
from real2sim_server.datasets.labels import boxes_at, ego_future
from real2sim_server.datasets.labels.boxes import BoxNoise, noisy_boxes
from real2sim_server.datasets.perturbed import Perturbation, PerturbedDrive, perturbed
from real2sim_server.datasets.plan import (
    ExportPlan,
    planned_cameras,
    planned_lidar,
    planned_shards,
    swept,
)
from real2sim_server.geometry import invert_transform

PLAN = ExportPlan(
    formats=("labels",),
    cameras=("front",),
    width=48,
    period_us=500_000,
    end_us=500_000,
    clip_s=0.5,
    flow=False,
)
SWEEP = DatasetSweep.model_validate(
    {
        "parameters": {
            "ahead": {"range": [0.0, 4.0, 3]},
            "beside": {"normal": [0.0, 0.2]},
        },
        "draws": 2,
        "operations": [{"op": "translate", "object_id": "car_blue", "x": "$ahead", "y": "$beside"}],
    }
)


def variants(drive, sweep=SWEEP, seed: int = 0):
    return swept(drive.scene, drive.state, sweep, seed)


def test_a_sweep_has_every_combination_with_its_own_draws(tiny_drive):
    found = variants(tiny_drive)
    assert [v.values["ahead"] for v in found] == [0.0, 0.0, 2.0, 2.0, 4.0, 4.0]
    assert len({v.values["beside"] for v in found}) == 6
    before = next(o for o in boxes_at(tiny_drive.placed_at(0)) if o.object_id == "car_blue")
    for variant in found:
        after = next(o for o in boxes_at(variant.drive.placed_at(0)) if o.object_id == "car_blue")
        moved = after.T_world_object[:2, 3] - before.T_world_object[:2, 3]
        np.testing.assert_allclose(moved, [variant.values["ahead"], variant.values["beside"]])


def test_draws_depend_on_the_seed(tiny_drive):
    drawn = [[v.values["beside"] for v in variants(tiny_drive, seed=s)] for s in (1, 1, 2)]
    assert drawn[0] == drawn[1] != drawn[2]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"operations": [{"op": "delete", "object_id": "$other"}]}, r"an edit has \$other"),
        ({"operations": [{"op": "delete", "object_id": "car_blue"}]}, r"no edit has \$ahead"),
        ({"draws": 500}, "1500 variants; 1000 is the most"),
    ],
)
def test_invalid_sweeps_are_refused(tiny_drive, change, message):
    with pytest.raises(DatasetError, match=message):
        variants(tiny_drive, SWEEP.model_copy(update=change))


def test_all_variants_of_a_segment_are_in_one_split(tiny_drive):
    plan = replace(PLAN, end_us=2_000_000, splits={"train": 0.5, "val": 0.5})
    shards = planned_shards(variants(tiny_drive), replace(plan, perturb=Perturbation(copies=2)))
    assert [shard.name for shard in shards] == [f"{k:04d}" for k in range(len(shards))]
    splits = {}
    for shard in shards:
        splits.setdefault(shard.times_us[0], set()).add(shard.split)
    assert len(shards) == len(splits) * 12
    assert all(len(names) == 1 for names in splits.values())
    assert set.union(*splits.values()) == {"train", "val"}


def test_an_ego_beside_its_path_returns_to_it(tiny_drive):
    drive = PerturbedDrive.beside(tiny_drive, 0, 1.0, 0.1, 1.5)
    assert drive.offset_at(0) == pytest.approx((1.0, 0.1))
    assert drive.offset_at(2_000_000) == pytest.approx((0.0, 0.0), abs=1e-6)
    poses = np.array([drive.ego_at(t) for t in range(0, 1_600_000, 10_000)])
    steps = np.diff(poses[:, :2, 3], axis=0)
    ways = np.arctan2(steps[:, 1], steps[:, 0])
    turns = np.arctan2(poses[1:, 1, 0], poses[1:, 0, 0])
    # It faces where it drives, and turns as a car can.
    np.testing.assert_allclose(ways, turns, atol=0.01)
    curvature = np.abs(np.diff(ways)) / np.linalg.norm(steps[1:], axis=1)
    assert curvature.max() < 0.2


def test_the_future_of_an_ego_beside_its_path_leads_back(tiny_drive):
    drive = PerturbedDrive.beside(tiny_drive, 0, 1.0, 0.0, 1.5)
    last = ego_future(drive, 0)[-1]
    assert last[2] == pytest.approx(-1.0, abs=0.02)
    assert last[3] == pytest.approx(0.0, abs=0.01)


def test_a_start_on_another_vehicle_is_redrawn(tiny_drive):
    wide = Perturbation(lateral_sigma=5.0, heading_sigma=0.0)
    found = [perturbed(tiny_drive, wide, (0, 500_000), (0, k)) for k in range(12)]
    again = [perturbed(tiny_drive, wide, (0, 500_000), (0, k)) for k in range(12)]
    assert [d.lateral for d in found] == [d.lateral for d in again]
    assert len({d.lateral for d in found}) == 12
    placed = tiny_drive.placed_at(0)
    car = next(k for k, o in enumerate(placed.objects) if o.category == "car")
    for drive in found:
        away = invert_transform(drive.ego_at(0)) @ placed.transforms[car]
        assert abs(away[1, 3]) > 1.5 or abs(away[0, 3]) > 3.0


def test_perturbed_clips_record_their_variant(tiny_drive, tmp_path):
    noise = BoxNoise(position=0.3, false=2.0)
    one = replace(PLAN, end_us=0, perturb=Perturbation(), noise=noise)
    chosen = variants(tiny_drive)[:2]
    out = export_dataset(chosen, one, tmp_path / "out")
    manifest = json.loads((out / "manifest.json").read_text())
    assert [c["values"] for c in manifest["clips"].values()] == [dict(v.values) for v in chosen]
    clip = Clip.open(out / "labels" / "0000")
    beside = clip.frames[0]["beside_path"]
    recorded = tiny_drive.ego_at(0)
    moved = np.array(clip.frames[0]["T_world_ego"])[:3, 3] - recorded[:3, 3]
    assert moved @ recorded[:3, 1] == pytest.approx(beside["lateral"])
    assert beside["lateral"] != 0
    found = {d["object_id"] for d in clip.frames[0]["detections"]}
    assert found >= {o["object_id"] for o in clip.frames[0]["objects"]}


def test_a_detector_makes_the_requested_errors(tiny_drive):
    boxes = boxes_at(tiny_drive.placed_at(0))
    poses = [box.T_world_object for box in boxes]
    noise = BoxNoise(position=0.5, heading=0.1, missed=0.25, false=1.5)
    frames = [noisy_boxes(boxes, poses, noise, (0, k)) for k in range(400)]
    true = [d for f in frames for d in f if d["object_id"] is not None]
    false = [d for f in frames for d in f if d["object_id"] is None]
    assert len(true) / (400 * len(boxes)) == pytest.approx(0.75, abs=0.05)
    assert len(false) / 400 == pytest.approx(1.5, abs=0.2)
    by_id = {box.object_id: box for box in boxes}
    errors = [
        np.array(d["T_ego_object"])[:3, 3] - by_id[d["object_id"]].T_world_object[:3, 3]
        for d in true
    ]
    assert np.std(errors) == pytest.approx(0.5, rel=0.05)


RIG = {
    "cameras": [
        {"name": "front", "width": 48},
        {"name": "wide", "width": 64, "height": 32, "hfov_deg": 90.0, "yaw_deg": 90.0},
    ],
    "lidar": "vlp-16",
}


def test_a_custom_rig_has_its_own_cameras(tiny_drive):
    plan = replace(PLAN, cameras=(), width=None, rig=RIG)
    front, wide = planned_cameras(tiny_drive, plan)
    assert front.width == 48
    assert wide.K[0, 0] == pytest.approx(32.0)
    np.testing.assert_allclose(wide.T_vehicle_camera[:3, 2], [0, 1, 0], atol=1e-12)
    lidar = planned_lidar(plan)
    assert lidar is not None
    assert lidar.name == "vlp-16"


@pytest.mark.parametrize(
    ("cameras", "message"),
    [
        ([{"name": "rear"}], "the scene has front, left"),
        ([{"name": "own", "hfov_deg": 90.0}], "needs width and height"),
        ([{"name": "front"}, {"name": "front"}], "must be unique"),
        ([{"name": "front", "hfov_deg": 300.0}], "hfov_deg"),
    ],
)
def test_invalid_rigs_are_refused(tiny_drive, cameras, message):
    with pytest.raises(DatasetError, match=message):
        planned_cameras(tiny_drive, replace(PLAN, cameras=(), rig={"cameras": cameras}))


def test_invalid_start_and_noise_options_state_what_is_allowed():
    found = command._perturbation("lateral=1,heading=8,copies=3")
    assert (found.lateral_sigma, found.copies) == (1.0, 3)
    assert found.heading_sigma == pytest.approx(math.radians(8))
    assert command._noise("missed=0.1").missed == 0.1
    with pytest.raises(CommandError, match=r"allowed are lateral=0\.5"):
        command._perturbation("sideways=1")
