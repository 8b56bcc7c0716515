"""How the solver's launches reach a GPU: a fake cuda-core records what it is given."""

from __future__ import annotations

import sys
import types
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from real2sim_server.physics.backends.cuda import launcher as launcher_module
from real2sim_server.physics.backends.cuda.launcher import GRAPHS, CudaLauncher, Launch
from real2sim_server.service.engine import _loses_device

LAUNCHES = (Launch("collect_fields", 12, 3), Launch("advance_blocks", 5, 1 << 16))


class Builder:
    """Records what is captured, like a stream that runs nothing."""

    def __init__(self, taken: list[Any]) -> None:
        self._taken = taken

    def begin_building(self) -> Builder:
        return self

    def end_building(self) -> Builder:
        return self

    def complete(self) -> Any:
        self._taken.append("captured")
        return SimpleNamespace(launch=lambda stream: self._taken.append(("graph", stream)))


@pytest.fixture
def taken(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Any]]:
    """The calls that cuda-core received, on a machine with one GPU."""
    taken: list[Any] = []
    device = SimpleNamespace(set_current=lambda: None, create_graph_builder=lambda: Builder(taken))
    code = SimpleNamespace(get_kernel=lambda name: f"kernel {name}")
    core: Any = types.ModuleType("cuda.core")
    core.Device = lambda index: device
    core.ObjectCode = SimpleNamespace(from_cubin=lambda cubin: code)
    core.Stream = SimpleNamespace(from_handle=lambda handle: f"stream {handle}")
    core.LEGACY_DEFAULT_STREAM = "default stream"
    core.LaunchConfig = lambda grid, block: (grid, block)
    core.launch = lambda *arguments: taken.append(arguments)
    monkeypatch.setitem(sys.modules, "cuda", types.ModuleType("cuda"))
    monkeypatch.setitem(sys.modules, "cuda.core", core)
    monkeypatch.setattr(launcher_module, "compiled_kernels", lambda *asked: b"")
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: None)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda index: (9, 0))
    stream = SimpleNamespace(cuda_stream=0)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: stream)
    launcher_module._loaded_kernels.cache_clear()
    yield taken
    launcher_module._loaded_kernels.cache_clear()


def test_a_sequence_is_launched_then_captured_then_launched_as_a_graph(taken: list[Any]) -> None:
    launcher = CudaLauncher("single")
    for _ in range(3):
        launcher.run(LAUNCHES, 0x7000)
    first, captured, again = taken[:2], taken[2:6], taken[6:]
    assert first == [
        ("default stream", (12, 128), "kernel collect_fields", 0x7000, np.uint32(3)),
        ("default stream", (5, 128), "kernel advance_blocks", 0x7000, np.uint32(1 << 16)),
    ]
    # A kernel takes a 64-bit address and a 32-bit number.
    assert type(first[0][3]) is int
    assert type(first[0][4]) is np.uint32
    assert isinstance(captured[0][0], Builder)
    assert [arguments[2:] for arguments in captured[:2]] == [a[2:] for a in first]
    assert captured[2:] == ["captured", ("graph", "default stream")]
    assert again == [("graph", "default stream")]


def test_only_a_few_graphs_are_kept(taken: list[Any]) -> None:
    launcher = CudaLauncher("single")
    for number in range(3 * GRAPHS):
        launcher.run((Launch("begin_run", 1, number),), 0x7000)
    assert len(launcher._graphs) == GRAPHS


def test_a_failed_launch_counts_as_a_lost_device(
    taken: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    launcher = CudaLauncher("single")

    def fail(*_: Any) -> None:
        raise Exception("CUDA_ERROR_ILLEGAL_ADDRESS")

    monkeypatch.setattr(sys.modules["cuda.core"], "launch", fail)
    with pytest.raises(RuntimeError, match="CUDA_ERROR_ILLEGAL_ADDRESS") as raised:
        launcher.run(LAUNCHES, 0)
    assert _loses_device(raised.value)
