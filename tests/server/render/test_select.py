"""Which backend is chosen, and why."""

from __future__ import annotations

import logging

import pytest
import torch

from real2sim_server.render import RenderError, describe_backends, select_backend
from real2sim_server.render.backends.cpu.kernel import source_fingerprint


@pytest.fixture(autouse=True)
def forget_choices() -> None:
    select_backend.cache_clear()


def test_auto_takes_the_cpu_without_a_gpu_and_logs_why(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with caplog.at_level(logging.INFO, logger="real2sim_server.render"):
        assert select_backend("auto").name == "cpu"
    assert "cpu" in caplog.text
    assert "no CUDA device" in caplog.text


def test_a_backend_is_made_once() -> None:
    assert select_backend("cpu") is select_backend("cpu")
    assert select_backend("reference") is select_backend("reference")


def test_backend_that_cannot_be_used_is_refused_with_the_remedy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(RenderError, match="CUDA build of torch"):
        select_backend("cuda")


def test_every_backend_is_described_with_a_reason_and_a_remedy_where_needed() -> None:
    statuses = describe_backends()
    assert {status.name for status in statuses} == {"cuda", "cpu", "reference"}
    for status in statuses:
        assert status.reason
        assert bool(status.remedy) != status.usable


def test_kernel_cache_follows_every_source_file(
    monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("backends") / "cpu"
    folder.mkdir()
    (folder.parent / "base.py").write_text("a = 1")
    monkeypatch.setattr("real2sim_server.render.backends.cpu.kernel.FOLDER", folder)
    fingerprints = set()
    for text in ("b = 1", "b = 2", "b = 1"):
        (folder / "records.py").write_text(text)
        fingerprints.add(source_fingerprint.__wrapped__())
    assert len(fingerprints) == 2
