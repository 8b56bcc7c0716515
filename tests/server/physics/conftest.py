"""What all tests of the solver share."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from .scenes import cube, solve


def pytest_collection_modifyitems(items):
    """Time limits are for tests: compiling kernels takes minutes where others compute as well."""
    here = Path(__file__).parent
    for item in items:
        if here in item.path.parents and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(300, func_only=True))


@pytest.fixture(autouse=True, scope="session")
def compiled_kernels():
    """Kernels of the CPU backend in both precisions."""
    for precision in ("single", "double"):
        solve([cube()], precision=precision).step(1e-4)


@pytest.fixture(autouse=True)
def one_torch_thread():
    """Small tensors gain nothing from threads and lose much when others compute."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
