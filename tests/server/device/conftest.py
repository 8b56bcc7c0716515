"""Fixtures for the pretended device and the CUDA backend on it."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest

from real2sim_server.render.backend import Backend

from . import gsplat_stand_in, pretended


@pytest.fixture
def device_counts() -> Iterator[pretended.Counts]:
    """Activates the pretended device. Counts launches, copies and waits."""
    with pretended.pretending() as counts:
        yield counts


@pytest.fixture
def cuda_backend(
    device_counts: pretended.Counts, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Backend]:
    """The CUDA backend on the pretended device, with a stand-in for gsplat."""
    name = "real2sim_server.render._cuda.gsplat"
    monkeypatch.setitem(sys.modules, "gsplat", gsplat_stand_in.module())
    monkeypatch.delitem(sys.modules, name, raising=False)
    from real2sim_server.render._cuda import gsplat

    for name_of_image in ("instance_image", "median_depth_image"):
        monkeypatch.setattr(gsplat, name_of_image, getattr(gsplat_stand_in, name_of_image))
    yield gsplat.CudaBackend(pretended.DEVICE)
    sys.modules.pop(name, None)
