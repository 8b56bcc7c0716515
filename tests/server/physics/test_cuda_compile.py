"""NVRTC compiles the solver for GPUs that are not present, without register spills."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import pytest

from real2sim_server._nvrtc import ARCHITECTURES, KernelSource
from real2sim_server.physics import SolverError
from real2sim_server.physics.backends.cuda import launcher, source
from real2sim_server.physics.backends.cuda.launcher import THREADS
from real2sim_server.physics.backends.cuda.source import KERNELS, PRECISIONS
from real2sim_server.render._cuda.needs import compiler_needs

MISSING = next((need.found for need in compiler_needs() if not need.met), "")
ALWAYS = ("single", "sm_90")
needs_nvrtc = pytest.mark.skipif(bool(MISSING), reason=MISSING)


@needs_nvrtc
@pytest.mark.parametrize(
    ("precision", "architecture"),
    [
        pytest.param(*case, marks=[] if case == ALWAYS else [pytest.mark.slow])
        for case in itertools.product(PRECISIONS, ARCHITECTURES)
    ],
)
def test_every_kernel_compiles_without_spills(precision: str, architecture: str) -> None:
    code, usages = launcher.compile_kernels(precision, architecture)
    assert code[:4] == b"\x7fELF"
    assert set(usages) == set(KERNELS)
    assert {name: usage.spilled for name, usage in usages.items() if usage.spilled} == {}
    assert all(usage.stack == 0 for usage in usages.values())
    # At least one block of threads works while another waits.
    few = min(usage.occupancy(architecture, THREADS) for usage in usages.values())
    assert few >= 2 * THREADS / 2048


@needs_nvrtc
def test_compiled_kernels_are_cached_by_precision_and_architecture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[tuple[str, str]] = []

    def compile_one(source: KernelSource, architecture: str) -> tuple[bytes, str]:
        made.append((source.kept_as.removeprefix("solver-"), architecture))
        return architecture.encode(), ""

    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path))
    monkeypatch.setattr(KernelSource, "_compile", compile_one)
    asked = [("single", "sm_90"), ("double", "sm_90"), ("single", "sm_80"), ("single", "sm_90")]
    for one in asked:
        assert launcher.compiled_kernels(*one) == one[1].encode()
    assert made == asked[:3]
    monkeypatch.setattr(launcher, "solver_source", lambda precision: "another law")
    launcher.compiled_kernels("single", "sm_90")
    assert len(made) == 4


@needs_nvrtc
def test_compiler_errors_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path))
    monkeypatch.setattr(launcher, "solver_source", lambda precision: "void f() { nonsense; }")
    with pytest.raises(SolverError, match="nonsense"):
        launcher.compile_kernels("single", "sm_90")


FACTOR = 2.5


def shortened(v: Any, length: Any) -> Any:
    """A function for the translator tests below."""
    total = 0
    for axis in range(3):
        total += v[axis] * v[axis]
    if total > length:
        v = (v[0] / FACTOR, v[1] / FACTOR, math.sqrt(v[2]))
    return v, total


def spread(values: Any) -> Any:
    return [value * 2 for value in values]


def test_a_function_is_translated_to_cpp_with_the_right_types() -> None:
    made = source.Translator("double", "some_")
    name, kind = made.add(shortened, (("real",) * 3, "real"))
    assert (name, kind) == ("shortened", (("real",) * 3, "real"))
    assert "double total{};" in made.text  # It starts as an integer but does not stay one.
    assert "(v[1] / double(2.5))" in made.text
    assert "root(v[2])" in made.text


def test_unsupported_syntax_is_refused_with_its_location() -> None:
    made = source.Translator("double", "some_")
    with pytest.raises(source.Untranslatable, match=r"spread, line \d+: .*\[value \* 2 for"):
        made.add(spread, (("real",) * 3,))
