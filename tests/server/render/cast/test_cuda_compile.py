"""NVRTC compiles the kernels of cast() without a GPU and without register spills."""

from __future__ import annotations

import pytest

from real2sim_server.render._cuda.launcher import ARCHITECTURES
from real2sim_server.render._cuda.needs import compiler_needs
from real2sim_server.render.cast.cuda import KERNELS, compile_kernels

MISSING = next((need.found for need in compiler_needs() if not need.met), "")


@pytest.mark.skipif(bool(MISSING), reason=MISSING)
@pytest.mark.parametrize(
    "architecture",
    [
        pytest.param(name, marks=[] if name == "sm_90" else [pytest.mark.slow])
        for name in ARCHITECTURES
    ],
)
def test_every_kernel_compiles_without_spills(architecture: str) -> None:
    code, usages = compile_kernels(architecture)
    assert code[:4] == b"\x7fELF"
    assert set(usages) == set(KERNELS)
    assert all(usage.spilled == usage.stack == 0 for usage in usages.values())
    assert min(usage.occupancy(architecture) for usage in usages.values()) >= 0.25
