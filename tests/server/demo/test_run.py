from __future__ import annotations

import pytest

from real2sim import ReplyTimeoutError
from real2sim_server.demo import run as demo
from real2sim_server.demo.run import wait_ready


class Worker:
    """Ready after some calls of ``wait_ready``."""

    def __init__(self, refusals: int) -> None:
        self.refusals = refusals

    def wait_ready(self, timeout: float) -> None:
        self.refusals -= 1
        if self.refusals >= 0:
            raise ReplyTimeoutError("ready worker", timeout, hint="warming up kernels")


def test_a_slow_start_is_explained_by_worker_progress(capsys):
    wait_ready(Worker(refusals=1))
    assert "warming up kernels" in capsys.readouterr().err


def test_a_quick_start_prints_nothing(capsys):
    wait_ready(Worker(refusals=0))
    assert capsys.readouterr().err == ""


def test_a_worker_that_is_never_ready_is_an_error(monkeypatch):
    monkeypatch.setattr(demo, "WARM_UP_S", 0.0)
    with pytest.raises(ReplyTimeoutError):
        wait_ready(Worker(refusals=2))
