"""The options ``--backend`` and ``--device``, and the CUDA report of ``doctor``."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

from real2sim.cli import build_app
from real2sim_server.cli.common import chosen_backend
from real2sim_server.console import CommandError
from real2sim_server.reconstruct import ReconstructOptions, reconstruct
from real2sim_server.render import RenderError, select_backend
from real2sim_server.render._cuda import gsplat_build
from real2sim_server.render._cuda.gsplat_build import BuiltKernels


@pytest.fixture(autouse=True)
def no_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    select_backend.cache_clear()


def test_the_device_selects_the_backend() -> None:
    assert chosen_backend("auto", None) == "auto"
    assert chosen_backend("auto", "cpu") == "cpu"
    assert chosen_backend("auto", "cuda") == "cuda"
    assert chosen_backend("reference", "cpu") == "reference"


def test_a_numbered_device_becomes_the_only_visible_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,5")
    assert chosen_backend("cuda", "cuda:1") == "cuda"
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "5"
    with pytest.raises(CommandError, match="shows 1 of them"):
        chosen_backend("cuda", "cuda:1")


@pytest.mark.parametrize("device", ["gpu", "cuda:", "cuda:x", "cpu:0", ""])
def test_an_unknown_device_is_refused(device: str) -> None:
    with pytest.raises(CommandError, match="allowed are cpu, cuda"):
        chosen_backend("auto", device)


def test_a_backend_for_another_device_is_refused() -> None:
    with pytest.raises(CommandError, match="does not draw on --device cpu"):
        chosen_backend("cuda", "cpu")


def test_a_reconstruction_with_an_unusable_backend_fails_before_reading_the_log(
    tmp_path: Path,
) -> None:
    options = ReconstructOptions(backend="cuda")
    with pytest.raises(RenderError, match="'cuda' is not usable"):
        reconstruct(tmp_path / "no_such_log", tmp_path / "scene.r2s", options)


def doctor(*arguments: str) -> tuple[int, str]:
    done = CliRunner().invoke(build_app(), ["doctor", *arguments], env={"COLUMNS": "300"})
    return done.exit_code, done.output


def test_doctor_reports_the_backend_and_what_to_install() -> None:
    code, output = doctor()
    assert code == 0
    assert "used" in output
    assert "real2sim[server,cuda]" in output or "driver" in output


def test_doctor_fails_if_cuda_is_required_but_unusable() -> None:
    code, output = doctor("--need-cuda")
    assert code == 1
    assert "CUDA is not usable" in output


def test_doctor_asks_for_an_architecture_without_a_gpu() -> None:
    code, output = doctor("--build-gpu")
    assert code == 1
    assert "--arch sm_90" in output
    code, output = doctor("--build-gpu", "--arch", "hopper")
    assert code == 1
    assert "'hopper'" in output


def test_doctor_does_not_recompile_usable_kernels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    built = BuiltKernels(tmp_path / "csrc.so", ("9.0",))
    monkeypatch.setattr(gsplat_build, "built_kernels", lambda: [built])
    loaded: list[BuiltKernels] = []
    monkeypatch.setattr(gsplat_build, "load_kernels", loaded.append)
    monkeypatch.setattr(gsplat_build, "build_kernels", lambda names: (built, 1.0))
    code, output = doctor("--build-gpu", "--arch", "sm_90")
    assert (code, loaded) == (0, [built])
    assert "compiled before" in output
    assert "takes minutes" in doctor("--build-gpu", "--arch", "sm_80")[1]

    def refuse(kernels: BuiltKernels) -> None:
        raise RenderError(f"{kernels.library} cannot be loaded")

    monkeypatch.setattr(gsplat_build, "load_kernels", refuse)
    assert "takes minutes" in doctor("--build-gpu", "--arch", "sm_90")[1]


def test_doctor_gpu_check_fails_without_a_gpu() -> None:
    code, output = doctor("--gpu-check")
    assert code == 1
    assert "there is no GPU to check" in output


def test_doctor_reports_serving_kernel_occupancy_without_a_gpu(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("cuda.core")
    from real2sim_server.render._cuda import launcher as compiling
    from real2sim_server.render._cuda.launcher import Usage
    from real2sim_server.render.cast import cuda as casting

    taken = {"blend": Usage(64, 0, 0, 0), "find_seen": Usage(32, 0, 0, 0)}
    monkeypatch.setattr(compiling, "compile_kernels", lambda name: (b"", taken))
    casts = {"follow": Usage(64, 0, 0, 0)}
    monkeypatch.setattr(casting, "compile_kernels", lambda name: (b"", casts))
    report = tmp_path / "report.json"
    code, output = doctor("--serving-kernels", "--arch", "9.0", "--json", str(report))
    assert code == 0, output
    rows = json.loads(report.read_text())["kernels"]
    found = [(row["architecture"], row["kernel"], row["occupancy"]) for row in rows]
    assert found == [("sm_90", "blend", 0.5), ("sm_90", "find_seen", 1.0), ("sm_90", "follow", 0.5)]
    assert "blend" in output
    taken["blend"] = Usage(255, 0, 0, 64)
    code, output = doctor("--serving-kernels", "--arch", "9.0")
    assert code == 1
    assert "blend on sm_90" in output


def test_doctor_reports_solver_kernel_occupancy_in_both_precisions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("cuda.core")
    from real2sim_server.physics.backends.cuda import launcher as compiling
    from real2sim_server.render._cuda.launcher import Usage

    def compile_kernels(precision: str, architecture: str) -> tuple[bytes, dict[str, Usage]]:
        return b"", {"advance_blocks": Usage(128 if precision == "single" else 256, 0, 0, 0)}

    monkeypatch.setattr(compiling, "compile_kernels", compile_kernels)
    report = tmp_path / "report.json"
    code, output = doctor("--solver-kernels", "--arch", "sm_90", "--json", str(report))
    assert code == 0, output
    rows = json.loads(report.read_text())["kernels"]
    found = [(row["kernel"], row["occupancy"]) for row in rows]
    assert found == [("advance_blocks (single)", 0.25), ("advance_blocks (double)", 0.125)]


def test_the_gpu_solver_bench_reports_missing_requirements() -> None:
    from real2sim_server.render._cuda.needs import unmet_nvrtc_need

    if unmet_nvrtc_need() is None:
        pytest.skip("everything is here")
    arguments = ["bench", "physics", "--backend", "cuda"]
    done = CliRunner().invoke(build_app(), arguments, env={"COLUMNS": "300"})
    assert done.exit_code == 1
    assert "'cuda' is not usable here" in done.output
    done = CliRunner().invoke(build_app(), [*arguments, "--peers"], env={"COLUMNS": "300"})
    assert done.exit_code == 1
    assert "--backend cpu" in done.output


def test_the_serving_backend_is_refused_without_a_gpu() -> None:
    with pytest.raises(RenderError, match="'nvrtc' is not usable"):
        select_backend("nvrtc")
