"""Selection of the rendering backend."""

from __future__ import annotations

import logging

import pytest
import torch

from real2sim_server.render import RenderError, describe_backends, select_backend


@pytest.fixture(autouse=True)
def forget_choices() -> None:
    select_backend.cache_clear()


def test_auto_selects_the_cpu_without_a_gpu_and_logs_why(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with caplog.at_level(logging.INFO, logger="real2sim_server.render"):
        assert select_backend("auto").name == "cpu"
    assert "cpu" in caplog.text
    assert "real2sim[server,cuda]" in caplog.text or "driver" in caplog.text


def test_backends_are_cached() -> None:
    assert select_backend("cpu") is select_backend("cpu")
    assert select_backend("reference") is select_backend("reference")


def test_an_unusable_backend_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(RenderError, match="torch"):
        select_backend("cuda")


def test_unusable_backends_are_described_with_a_remedy() -> None:
    statuses = describe_backends()
    assert {status.name for status in statuses} == {"cuda", "cpu", "nvrtc", "reference"}
    for status in statuses:
        assert status.reason
        assert bool(status.remedy) != status.usable
