"""NVRTC compiles the serving kernels without a GPU and without register spills."""

from __future__ import annotations

from pathlib import Path

import pytest

from real2sim_server import _nvrtc
from real2sim_server._nvrtc import KernelSource
from real2sim_server.render import RenderError
from real2sim_server.render._cuda import launcher as compiling
from real2sim_server.render._cuda.launcher import Usage
from real2sim_server.render._cuda.needs import compiler_needs, unmet_nvrtc_need

MISSING = next((need.found for need in compiler_needs() if not need.met), "")
needs_nvrtc = pytest.mark.skipif(bool(MISSING), reason=MISSING)


@needs_nvrtc
@pytest.mark.parametrize(
    "architecture",
    [
        pytest.param(name, marks=[] if name == "sm_90" else [pytest.mark.slow])
        for name in compiling.ARCHITECTURES
    ],
)
def test_every_kernel_compiles_without_spills(architecture: str) -> None:
    code, usages = compiling.compile_kernels(architecture)
    assert code[:4] == b"\x7fELF"
    assert set(usages) == set(compiling.KERNELS)
    assert {name: usage.spilled for name, usage in usages.items() if usage.spilled} == {}
    assert all(usage.stack == 0 for usage in usages.values())
    # At least two blocks per multiprocessor, to hide latency.
    assert min(usage.occupancy(architecture) for usage in usages.values()) >= 0.25


@needs_nvrtc
def test_compiled_kernels_are_cached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    def compile_one(_: KernelSource, architecture: str) -> tuple[bytes, str]:
        made.append(architecture)
        return architecture.encode(), ""

    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path))
    monkeypatch.setattr(KernelSource, "_compile", compile_one)
    for name in ("sm_90", "sm_80", "sm_90"):
        assert compiling.compiled_kernels(name) == name.encode()
    assert made == ["sm_90", "sm_80"]
    monkeypatch.setattr(_nvrtc, "nvrtc_version", lambda: "99.0")
    compiling.compiled_kernels("sm_90")
    assert made == ["sm_90", "sm_80", "sm_90"]


@needs_nvrtc
def test_compiler_errors_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "serving.cu"
    source.write_text('extern "C" __global__ void blend() { nonsense; }', encoding="ascii")
    monkeypatch.setattr(compiling, "SOURCE", source)
    with pytest.raises(RenderError, match="nonsense"):
        compiling.compile_kernels("sm_90")


def test_occupancy_is_limited_by_registers() -> None:
    usage = Usage(registers=64, shared=12_288, stack=0, spilled=0)
    assert usage.occupancy("sm_90") == 0.5


def test_missing_requirements_have_a_remedy() -> None:
    need = unmet_nvrtc_need()
    if need is None:
        pytest.skip("everything is here")
    assert need.remedy
