"""NVRTC compiles the serving kernels for GPUs that are not there, and nothing spills."""

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
def test_every_kernel_compiles_and_none_spills(architecture: str) -> None:
    code, usages = compiling.compile_kernels(architecture)
    assert code[:4] == b"\x7fELF"
    assert set(usages) == set(compiling.KERNELS)
    assert {name: usage.spilled for name, usage in usages.items() if usage.spilled} == {}
    assert all(usage.stack == 0 for usage in usages.values())
    # Two blocks of a multiprocessor at least: one works while the other waits.
    assert min(usage.occupancy(architecture) for usage in usages.values()) >= 0.25


@needs_nvrtc
def test_what_was_compiled_is_kept_by_source_and_architecture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
def test_a_source_that_is_wrong_is_refused_in_the_words_of_the_compiler(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "serving.cu"
    source.write_text('extern "C" __global__ void blend() { nonsense; }', encoding="ascii")
    monkeypatch.setattr(compiling, "SOURCE", source)
    with pytest.raises(RenderError, match="nonsense"):
        compiling.compile_kernels("sm_90")


def test_usage_that_leaves_half_of_the_threads_is_said() -> None:
    usage = Usage(registers=64, shared=12_288, stack=0, spilled=0)
    assert usage.occupancy("sm_90") == 0.5


def test_a_machine_without_a_gpu_says_what_the_backend_needs() -> None:
    need = unmet_nvrtc_need()
    if need is None:
        pytest.skip("everything is here")
    assert need.remedy
