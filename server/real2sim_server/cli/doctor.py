"""``real2sim doctor``: capabilities of this machine, missing parts, and how to fix them."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from .._files import atomic_file
from ..console import (
    SERVER_MODULES,
    CommandError,
    console,
    run_command,
    telling_of_compiling,
    write_json,
)
from .common import JsonFile, app

if TYPE_CHECKING:
    from ..render._cuda.launcher import Usage

DISTRIBUTIONS = (
    "real2sim",
    "torch",
    "numba",
    "numpy",
    "fastapi",
    "uvicorn",
    "gsplat",
    "numba-cuda",
    "cuda-core",
)


@app.command("doctor")
def doctor(
    *,
    warm: Annotated[
        bool, typer.Option("--warm", help="Compile all kernels of a worker into the cache.")
    ] = False,
    warmed: Annotated[
        bool, typer.Option("--warmed", help="Fail if any kernel is not compiled yet.")
    ] = False,
    build_gpu: Annotated[
        bool, typer.Option("--build-gpu", help="Compile gsplat's kernels (takes minutes).")
    ] = False,
    arch: Annotated[
        list[str] | None,
        typer.Option(
            help="GPU architecture to compile for, such as sm_90; repeatable. Default: this GPU's."
        ),
    ] = None,
    need_cuda: Annotated[
        bool, typer.Option("--need-cuda", help="Fail if CUDA rendering is not usable.")
    ] = False,
    without_device: Annotated[
        bool,
        typer.Option(
            "--without-device", help="With --need-cuda: ignore that the GPU itself is missing."
        ),
    ] = False,
    serving_kernels: Annotated[
        bool,
        typer.Option(
            "--serving-kernels",
            help="Compile the kernels of --backend nvrtc, for images and LiDAR, for each --arch "
            "(default: all tested ones) and print their registers and occupancy; fail if one "
            "spills registers. Needs no GPU.",
        ),
    ] = False,
    solver_kernels: Annotated[
        bool,
        typer.Option(
            "--solver-kernels",
            help="The same for the physics solver's CUDA kernels, in both precisions.",
        ),
    ] = False,
    gpu_check: Annotated[
        bool,
        typer.Option(
            "--gpu-check",
            help="Test this machine's GPU: compare images, LiDAR and training with the CPU, and "
            "measure frames, physics and memory. Takes minutes; fails if a comparison fails.",
        ),
    ] = False,
    out: Annotated[
        Path | None, typer.Option(help="With --gpu-check: write the table as Markdown.")
    ] = None,
    json: JsonFile = None,
) -> None:
    """Report what this machine can do, what is missing, and how to fix it."""
    findings = {"python": platform.python_version(), "cores": str(os.cpu_count())}
    findings |= {name: _version(name) for name in DISTRIBUTIONS}
    missing = [name for name in SERVER_MODULES if importlib.util.find_spec(name) is None]
    if missing:
        advice = [f"pip install 'real2sim[server]'  # for {', '.join(missing)}"]
        _report(_Report(findings, advice=advice), json)
        raise typer.Exit(1)
    if gpu_check:
        run_command(_check_gpu, out=out, json=json)
        return
    if build_gpu:
        run_command(_build_gpu, findings=findings, arch=arch)
    report = _inspected(findings)
    if serving_kernels:
        run_command(_compile_serving, report=report, arch=arch)
    if solver_kernels:
        run_command(_compile_solver, report=report, arch=arch)
    compiled: list[str] = []
    if warm or warmed:
        seconds, compiled = _warm_up()
        findings["kernels ready in"] = f"{seconds:.1f} s, {len(compiled)} compiled"
    if warmed and compiled:
        report.advice.append(
            f"real2sim doctor --warm  # compiles {', '.join(sorted(compiled)[:8])}"
        )
    _report(report, json)
    if need_cuda:
        run_command(_require_cuda, without_device=without_device)
    if warmed and compiled:
        raise typer.Exit(1)


@dataclass
class _Report:
    """Results: rows of backends, needs and kernels, for printing and for JSON."""

    findings: dict[str, str]
    backends: list[dict[str, object]] = field(default_factory=list)
    cuda: list[dict[str, object]] = field(default_factory=list)
    kernels: list[dict[str, object]] = field(default_factory=list)
    advice: list[str] = field(default_factory=list)


def _version(distribution: str) -> str:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _build_gpu(*, findings: dict[str, str], arch: list[str] | None) -> None:
    """Compile gsplat's kernels for ``arch``, or for the GPU of this machine."""
    from ..render._cuda.gsplat_build import build_kernels

    names = sorted({_capability(name) for name in arch or _own_architecture()})
    there = _compiled_already(names)
    if there is not None:
        findings["gsplat's kernels"] = f"{there}, compiled before; remove it to compile it again"
        return
    console.print(f"compiling gsplat's kernels for {', '.join(names)}: this takes minutes")
    built, seconds = build_kernels(names)
    megabytes = built.library.stat().st_size / 1e6
    findings["gsplat's kernels"] = f"{built.library}, {megabytes:.1f} MB, in {seconds:.0f} s"


def _compiled_already(architectures: list[str]) -> Path | None:
    """The kernels for exactly these architectures, if they can be loaded."""
    from ..render import RenderError
    from ..render._cuda.gsplat_build import built_kernels, load_kernels

    for kernels in built_kernels():
        if sorted(kernels.architectures) != architectures:
            continue
        try:
            load_kernels(kernels)
        except (RenderError, ImportError):
            continue
        return kernels.library
    return None


def _own_architecture() -> list[str]:
    import torch

    if not torch.cuda.is_available():
        raise CommandError(
            "torch finds no CUDA device, so --build-gpu needs the architecture: "
            "--arch sm_90 for H100 and H200, sm_89 for L4 and RTX 40, sm_86 for RTX 30, sm_80 for "
            "A100; repeat the option for several"
        )
    major, minor = torch.cuda.get_device_capability()
    return [f"sm_{major}{minor}"]


def _capability(name: str) -> str:
    """``9.0`` of ``sm_90`` or of ``9.0``."""
    digits = name.removeprefix("sm_").replace(".", "")
    if not digits.isdecimal() or len(digits) not in (2, 3) or int(digits) < 70:
        raise CommandError(f"--arch {name!r}; allowed are such as sm_75, sm_90, sm_120, or 9.0")
    return f"{digits[:-1]}.{digits[-1]}"


def _check_gpu(*, out: Path | None, json: Path | None) -> None:
    """Run all checks on the GPU of this machine, and print the results."""
    from ..render._cuda.needs import unmet_nvrtc_need

    need = unmet_nvrtc_need()
    if need is not None:
        raise CommandError(f"there is no GPU to check: {need.found}; {need.remedy}")
    from . import gpu_check

    check = gpu_check.run(gpu_check.this_gpu(), on_part=lambda part: console.print(f"{part} ..."))
    text = check.markdown()
    console.print(text, highlight=False, soft_wrap=True, markup=False)
    if out is not None:
        with atomic_file(out) as file:
            file.write(text.encode())
    write_json(json, asdict(check))
    if not check.right:
        raise CommandError("something is not right: see the lines that do not hold, or failed")


def _compile_serving(*, report: _Report, arch: list[str] | None) -> None:
    """Add the resource usage of each serving kernel, by architecture."""
    _require_compiler()
    from ..render._cuda.launcher import ARCHITECTURES, THREADS, compile_kernels
    from ..render.cast.cuda import compile_kernels as compile_casting

    for architecture in _given(arch) or ARCHITECTURES:
        _, usages = compile_kernels(architecture)
        _, casting = compile_casting(architecture)
        _put_down(report, architecture, usages | casting, THREADS)
    _refuse_spills(report)


def _compile_solver(*, report: _Report, arch: list[str] | None) -> None:
    """Add the resource usage of each solver kernel, by architecture."""
    _require_compiler()
    from .._nvrtc import ARCHITECTURES
    from ..physics.backends.cuda.launcher import THREADS, compile_kernels
    from ..physics.backends.cuda.source import PRECISIONS

    for architecture in _given(arch) or ARCHITECTURES:
        for precision in PRECISIONS:
            _, usages = compile_kernels(precision, architecture)
            named = {f"{kernel} ({precision})": usage for kernel, usage in usages.items()}
            _put_down(report, architecture, named, THREADS)
    _refuse_spills(report)


def _require_compiler() -> None:
    from ..render._cuda.needs import compiler_needs

    for need in compiler_needs():
        if not need.met:
            raise CommandError(f"{need.found}; {need.remedy}")


def _given(arch: list[str] | None) -> list[str]:
    return [f"sm_{_capability(name).replace('.', '')}" for name in arch or []]


def _put_down(
    report: _Report, architecture: str, usages: Mapping[str, Usage], threads: int
) -> None:
    from ..render._cuda.launcher import MULTIPROCESSORS

    known = architecture in MULTIPROCESSORS
    for kernel, usage in usages.items():
        occupancy = usage.occupancy(architecture, threads) if known else None
        row = {"architecture": architecture, "kernel": kernel, **vars(usage)}
        report.kernels.append({**row, "occupancy": occupancy})


def _refuse_spills(report: _Report) -> None:
    spilled = [
        f"{row['kernel']} on {row['architecture']}" for row in report.kernels if row["spilled"]
    ]
    if spilled:
        raise CommandError(f"registers do not hold {', '.join(spilled)}: they would run slowly")


def _inspected(findings: dict[str, str]) -> _Report:
    import torch

    from ..render import describe_backends, select_backend
    from ..render._cuda.needs import compiler_needs, cuda_needs

    described, used = describe_backends(), select_backend("auto").name
    # Only useful if CUDA is expected: torch is built for it, or a driver is loaded.
    wanted = torch.version.cuda is not None or Path("/proc/driver/nvidia/version").is_file()
    needs = [*cuda_needs(), *compiler_needs()] if wanted else []
    # Requirements shared by both GPU backends are reported once.
    told = {"cuda", "nvrtc"} if needs else {"nvrtc"}
    mend = {f"{b.name}: {b.remedy}" for b in described if b.remedy and b.name not in told}
    return _Report(
        findings=findings,
        backends=[
            {"name": b.name, "usable": b.usable, "used": b.name == used, "reason": b.reason}
            for b in described
        ],
        cuda=[vars(need) for need in needs],
        advice=[*sorted(mend), *(f"{need.name}: {need.remedy}" for need in needs if need.remedy)],
    )


def _require_cuda(*, without_device: bool) -> None:
    """Exit with an error if CUDA is not usable; ``without_device`` tolerates a missing device."""
    from ..render._cuda.needs import try_without_device, unmet_gsplat_need

    need = unmet_gsplat_need(without_device=without_device)
    if need is not None:
        raise CommandError(f"CUDA is not usable: {need.found}; {need.remedy}")
    try:
        try_without_device()
    except Exception as error:
        raise CommandError(f"CUDA is not usable: {type(error).__name__}: {error}") from error


def _warm_up() -> tuple[float, list[str]]:
    """Compile a worker's kernels; return the duration [s] and the names of newly compiled ones."""
    from numba.core import event

    from .. import render, world

    start = time.perf_counter()
    with telling_of_compiling(), event.install_recorder("numba:compile") as recorder:
        render.warm_up()
        render.warm_up_small_images()
        world.warm_up()
        world.warm_up_planning()
        world.warm_up_deformation()
    began = (found for _, found in recorder.buffer if found.is_start)
    names = {found.data["dispatcher"].__name__ for found in began}
    return time.perf_counter() - start, sorted(names)


def _report(report: _Report, json: Path | None) -> None:
    table = Table(title="this machine", title_justify="left", show_header=False)
    for name, value in report.findings.items():
        table.add_row(name, value)
    console.print(table)
    if report.backends:
        table = Table("backend", "usable", "reason", title="rendering", title_justify="left")
        for row in report.backends:
            usable = "used" if row["used"] else "yes" if row["usable"] else "no"
            table.add_row(str(row["name"]), usable, str(row["reason"]))
        console.print(table)
    if report.cuda:
        table = Table("cuda needs", "here", "found", title="CUDA", title_justify="left")
        for row in report.cuda:
            table.add_row(str(row["name"]), "yes" if row["met"] else "no", str(row["found"]))
        console.print(table)
    if report.kernels:
        console.print(_kernels_table(report.kernels))
    for line in report.advice:
        console.print(f"to mend: {line}", highlight=False, soft_wrap=True, markup=False)
    write_json(json, asdict(report))


def _kernels_table(rows: list[dict[str, object]]) -> Table:
    """One row per kernel: registers per thread by architecture, with occupancy in brackets."""
    architectures = list(dict.fromkeys(str(row["architecture"]) for row in rows))
    table = Table("kernel", *architectures, "shared [bytes]", title="registers of kernels")
    table.title_justify = "left"
    cells: dict[str, dict[str, str]] = {}
    shared: dict[str, object] = {}
    for row in rows:
        share = row["occupancy"]
        known = f" ({share:.0%})" if isinstance(share, float) else ""
        kernel = str(row["kernel"])
        cells.setdefault(kernel, {})[str(row["architecture"])] = f"{row['registers']}{known}"
        shared[kernel] = row["shared"]
    for kernel, found in cells.items():
        table.add_row(kernel, *(found.get(a, "") for a in architectures), f"{shared[kernel]}")
    return table
