"""Exclusive ownership of state folders and worker names."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

from real2sim_server.service.preflight import check_start
from real2sim_server.service.storage.connection import (
    StateFolderError,
    check_state_folder,
    owned_folder,
)
from real2sim_server.service.storage.store import StoreError

HOLD = (
    "import sys, time\n"
    "from pathlib import Path\n"
    "from real2sim_server.service.storage.connection import owned_folder\n"
    "with owned_folder(Path(sys.argv[1])):\n"
    "    print('held', flush=True)\n"
    "    time.sleep(3600)\n"
)


def test_a_second_worker_on_a_state_folder_is_refused_with_the_owner_pid(tmp_path):
    command = [sys.executable, "-c", HOLD, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as first:
        try:
            assert first.stdout.readline() == "held\n"
            with pytest.raises(StateFolderError, match=f"process {first.pid} ") as refused:
                check_state_folder(tmp_path)
            assert "--data" in str(refused.value)
        finally:
            first.kill()
    # The folder is free again, however the process ended.
    check_state_folder(tmp_path)


def test_a_worker_on_an_owned_folder_is_refused_at_the_start_check(make_settings, tmp_path):
    with (
        owned_folder(tmp_path / "data"),
        pytest.raises(StateFolderError, match=f"process {os.getpid()}"),
    ):
        check_start(make_settings())


def test_a_refused_worker_does_not_interrupt_jobs(run_worker, held_videos):
    with run_worker() as client:
        body = {"scene": "tiny", "camera": "front", "fps": 1}
        job = client.post("/v1/exports", json=body).headers["Location"]
        before = client.get(job).json()["state"]
        with pytest.raises(StateFolderError), run_worker():
            pass
        assert "interrupted" not in {before, client.get(job).json()["state"]}


@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_a_worker_name_is_unique_on_a_shared_store(kind, request, run_worker, tmp_path):
    url = f"sqlite:///{tmp_path / 'shared.db'}"
    if kind == "postgresql":
        url = request.getfixturevalue("postgres").new_database()
    first, second = tmp_path / "first", tmp_path / "second"
    with run_worker(data_dir=first, store_url=url):
        with (
            pytest.raises((StoreError, StateFolderError), match=f"process {os.getpid()} .*WORKER"),
            run_worker(data_dir=second, store_url=url),
        ):
            pass
        with run_worker(data_dir=second, store_url=url, worker_id="w1") as other:
            assert other.get("/v1/scenarios").status_code == 200
    with run_worker(data_dir=second, store_url=url) as heir:
        assert heir.get("/v1/scenarios").status_code == 200


@contextlib.contextmanager
def unprivileged() -> Iterator[None]:
    """Drop root privileges inside the block, because root can write everywhere."""
    if os.getuid() != 0:
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


def test_an_unwritable_folder_is_refused_with_a_hint(tmp_path):
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o555)
    with unprivileged(), pytest.raises(StateFolderError, match="cannot be written to") as refused:
        check_state_folder(closed)
    assert "--data" in str(refused.value)
