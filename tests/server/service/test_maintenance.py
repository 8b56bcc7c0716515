"""Cleanup of leftovers at the start, and of old data later."""

from __future__ import annotations

import os
import time

from real2sim_server._files import sweep_leftovers
from real2sim_server.service.maintenance import Maintenance
from real2sim_server.service.storage import store as store_module

from .waiting import succeeded

HOUR_S = 3600


def test_uploads_of_a_killed_worker_are_removed_at_the_next_start(run_worker, tmp_path):
    assets = tmp_path / "data" / "assets"
    (assets / ".upload-abcdef012345").mkdir(parents=True)
    (assets / ".upload-abcdef012345" / "big.ply").write_bytes(bytes(1000))
    (assets / ".upload-fedcba543210.ply").write_bytes(bytes(1000))
    with run_worker():
        assert list(assets.iterdir()) == []


def test_an_upload_in_progress_survives_the_hourly_sweep(run_worker, tmp_path):
    staging = tmp_path / "data" / "assets" / ".upload-abcdef012345"
    with run_worker() as client:
        staging.mkdir(parents=True)
        (staging / "upload.ply").write_bytes(b"ply")
        worker = client.app.state.worker
        Maintenance(worker.settings, worker.store, worker.jobs, worker.sessions).sweep()
        assert staging.exists()


def test_recent_uploads_of_another_worker_in_a_shared_folder_are_kept(run_worker, scenes_dir):
    fresh, old = scenes_dir / ".upload-aaaaaaaaaaaa.ply", scenes_dir / ".upload-bbbbbbbbbbbb.ply"
    for file in (fresh, old):
        file.write_bytes(b"ply")
    long_ago = time.time() - 2 * HOUR_S
    os.utime(old, (long_ago, long_ago))
    try:
        with run_worker():
            assert (fresh.exists(), old.exists()) == (True, False)
    finally:
        fresh.unlink(missing_ok=True)
        old.unlink(missing_ok=True)


def test_a_folder_moved_aside_is_restored_if_its_name_is_free(tmp_path):
    for name in (".kept.r2s.old-0123456789ab", ".gone.r2s.old-0123456789ab", "gone.r2s"):
        (tmp_path / name).mkdir()
    (tmp_path / ".half.r2s.tmp-0123456789ab").mkdir()
    (tmp_path / ".hidden").touch()
    sweep_leftovers(tmp_path, unused_s=0.0)
    assert {p.name for p in tmp_path.iterdir()} == {"kept.r2s", "gone.r2s", ".hidden"}


def test_old_jobs_are_deleted_with_their_files(client):
    body = {"scene": "tiny", "camera": "front", "fps": 1, "width": 64}
    job = succeeded(client, client.post("/v1/exports", json=body))
    worker = client.app.state.worker
    folder = worker.settings.jobs_path / job["job_id"]
    assert folder.is_dir()
    client.portal.call(worker.jobs.forget_before, store_module.now_us() + 1)
    assert client.get(f"/v1/jobs/{job['job_id']}").status_code == 404
    assert not folder.exists()
