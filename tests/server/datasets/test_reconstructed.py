"""Our own exports are logs like any other: a scene can be rebuilt from them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from real2sim_server.datasets.export import export_dataset
from real2sim_server.datasets.plan import ExportPlan
from real2sim_server.logs import open_log
from real2sim_server.reconstruct import InitialiseOptions, ReconstructOptions, reconstruct
from real2sim_server.scene.io import load_scene

PLAN = ExportPlan(
    formats=("kitti", "kitti_raw", "nuscenes", "argoverse2"),
    cameras=("front",),
    period_us=250_000,
    end_us=1_000_000,
    flow=False,
)
SMALL = InitialiseOptions(
    max_background=40_000, max_object=4_000, ground_spacing=0.15, sky_resolution=64
)
FOLDERS = {
    "kitti": ("kitti/tracking", "0000"),
    "kitti_raw": ("kitti_raw/2011_09_26", "2011_09_26_drive_0000_sync"),
    "nuscenes": ("nuscenes", "scene-0000"),
}


@pytest.fixture(scope="module")
def exported(tiny_drive, tmp_path_factory):
    out = tmp_path_factory.mktemp("logs") / "out"
    return export_dataset(tiny_drive, PLAN, out)


@pytest.mark.slow
@pytest.mark.parametrize("name", FOLDERS)
def test_a_scene_is_reconstructed_from_our_own_export(exported, tiny_drive, tmp_path, name):
    folder, sequence = FOLDERS[name]
    log = open_log(exported / folder, sequence=sequence)
    options = ReconstructOptions(initialise=replace(SMALL))
    report = reconstruct(log, tmp_path / "again.r2s", options)
    scene = load_scene(tmp_path / "again.r2s")
    assert report.psnr_lidar_db > 15
    assert len(scene.objects) >= 2
    driven = scene.ego.positions[-1] - scene.ego.positions[0]
    recorded = tiny_drive.ego_at(1_000_000)[:3, 3] - tiny_drive.ego_at(0)[:3, 3]
    assert abs(float((driven**2).sum() - (recorded**2).sum())) < 0.05
