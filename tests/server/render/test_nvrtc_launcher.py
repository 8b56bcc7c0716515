"""Kernel launches, recorded by a fake cuda-core."""

from __future__ import annotations

import sys
import types
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from real2sim_server.render._cuda import launcher as launcher_module
from real2sim_server.render._cuda.launcher import CudaLauncher
from real2sim_server.service.engine import _loses_device


@pytest.fixture
def launches(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """Recorded arguments of cuda.core.launch on a fake GPU."""
    taken: list[tuple[Any, ...]] = []
    code = SimpleNamespace(get_kernel=lambda name: f"kernel {name}")
    core: Any = types.ModuleType("cuda.core")
    core.Device = lambda index: SimpleNamespace(set_current=lambda: taken.append(("device", index)))
    core.ObjectCode = SimpleNamespace(from_cubin=lambda cubin: code)
    core.Stream = SimpleNamespace(from_handle=lambda handle: f"stream {handle}")
    core.LEGACY_DEFAULT_STREAM = "default stream"
    core.LaunchConfig = lambda grid, block: (grid, block)
    core.launch = lambda *arguments: taken.append(arguments)
    monkeypatch.setitem(sys.modules, "cuda", types.ModuleType("cuda"))
    monkeypatch.setitem(sys.modules, "cuda.core", core)
    monkeypatch.setattr(launcher_module, "compiled_kernels", lambda name: name.encode())
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: None)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda index: (9, 0))
    stream = SimpleNamespace(cuda_stream=0)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: stream)
    copying = SimpleNamespace(wait_stream=lambda other: taken.append(("waits for", other)))
    monkeypatch.setattr(torch.cuda, "Stream", lambda device: copying)
    monkeypatch.setattr(torch.cuda, "stream", lambda given: nullcontext(taken.append(given)))
    return taken


def test_a_launch_passes_stream_grid_kernel_and_arguments(
    launches: list[tuple[Any, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    launcher = CudaLauncher()
    launches.clear()
    launcher.launch("blend", 12, 0x7000, 17)
    assert launches == [
        ("device", 0),
        ("default stream", (12, 256), "kernel blend", 0x7000, np.uint32(17)),
    ]
    # The kernel takes a 64-bit address and a 32-bit number.
    assert type(launches[1][3]) is int
    assert type(launches[1][4]) is np.uint32
    other = SimpleNamespace(cuda_stream=5)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: other)
    launcher.launch("find_ranges", 1, 0x7000)
    assert launches[2][0] == "stream 5"


def test_images_are_copied_on_a_separate_stream(
    launches: list[tuple[Any, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Event:
        def __init__(self, *, blocking: bool) -> None:
            assert blocking

        def record(self, stream: object) -> None:
            launches.append(("records", stream))

        def synchronize(self) -> None:
            launches.append(("waits",))

    monkeypatch.setattr(torch.cuda, "Event", Event)
    launcher = CudaLauncher()
    launches.clear()
    source = SimpleNamespace(record_stream=lambda stream: launches.append(("kept for", stream)))
    target = SimpleNamespace(
        copy_=lambda given, non_blocking: launches.append(("copies", given, non_blocking))
    )
    ready = launcher.copy_out(source, target)  # type: ignore[arg-type]
    copying = launcher._copying
    assert launches == [
        ("waits for", torch.cuda.current_stream(None)),
        copying,
        ("copies", source, True),
        ("records", copying),
        ("kept for", copying),
    ]
    launches.clear()
    ready()
    ready()
    assert launches == [("waits",)] * 2


def test_a_failed_launch_counts_as_a_lost_device(
    launches: list[tuple[Any, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    launcher = CudaLauncher()

    def fail(*_: Any) -> None:
        raise Exception("CUDA_ERROR_ILLEGAL_ADDRESS")

    monkeypatch.setattr(sys.modules["cuda.core"], "launch", fail)
    with pytest.raises(RuntimeError, match="blend: CUDA_ERROR_ILLEGAL_ADDRESS") as raised:
        launcher.launch("blend", 1, 0)
    assert _loses_device(raised.value)
