"""Missing requirements of the CUDA backend and the remedies it suggests."""

from __future__ import annotations

import importlib.metadata
import json
import logging
from pathlib import Path

import pytest
import torch

from real2sim_server._nvrtc import kernels_folder
from real2sim_server.render import RenderError, select, select_backend
from real2sim_server.render._cuda import gsplat_build, needs
from real2sim_server.render._cuda.gsplat_build import (
    BuiltKernels,
    build_kernels,
    write_slim_sources,
)

VERSIONS = {"gsplat": "1.5.3", "numba-cuda": "0.30.4"}


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, str]:
    """An H200 with everything except compiled kernels. Tests may remove package versions."""
    versions = dict(VERSIONS)

    def version(name: str) -> str:
        if name not in versions:
            raise importlib.metadata.PackageNotFoundError(name)
        return versions[name]

    monkeypatch.setattr(importlib.metadata, "version", version)
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (9, 0))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "NVIDIA H200")
    monkeypatch.setattr(needs, "gsplat_package", lambda: None)
    toolkit = tmp_path / "cuda"
    (toolkit / "lib").mkdir(parents=True)
    (toolkit / "lib" / "libnvvm.so.4").touch()
    monkeypatch.setattr(needs, "cuda_folders", lambda: [toolkit])
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path / "kernels"))
    return versions


def have_built(*architectures: str) -> None:
    folder = kernels_folder() / f"{gsplat_build._key()}-{'_'.join(architectures)}"
    folder.mkdir(parents=True)
    (folder / gsplat_build.LIBRARY).touch()
    record = {"architectures": list(architectures)}
    (folder / gsplat_build.RECORD).write_text(json.dumps(record))


def test_missing_kernels_are_reported_with_the_build_command(machine: dict[str, str]) -> None:
    need = needs.unmet_gsplat_need()
    assert need is not None
    assert need.name == "kernels"
    assert need.remedy == "real2sim doctor --build-gpu"


def test_nothing_is_missing_with_compiled_kernels(machine: dict[str, str]) -> None:
    have_built("8.0", "9.0")
    assert needs.unmet_gsplat_need() is None


def test_prebuilt_gsplat_kernels_need_no_build(
    machine: dict[str, str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "csrc.cpython-311-x86_64-linux-gnu.so").touch()
    monkeypatch.setattr(needs, "gsplat_package", lambda: tmp_path)
    assert needs.unmet_gsplat_need() is None


def test_kernels_of_other_devices_do_not_count(machine: dict[str, str]) -> None:
    have_built("8.0")
    need = needs.unmet_gsplat_need()
    assert need is not None
    assert "8.0 only" in need.found


@pytest.mark.parametrize("name", ["gsplat", "numba-cuda"])
def test_a_missing_library_is_named_with_its_extra(machine: dict[str, str], name: str) -> None:
    del machine[name]
    need = needs.unmet_gsplat_need()
    assert need is not None
    assert name in need.found
    assert "real2sim[server,cuda]" in need.remedy


def test_an_unsupported_gsplat_version_is_refused(machine: dict[str, str]) -> None:
    machine["gsplat"] = "1.6.0"
    need = needs.unmet_gsplat_need()
    assert need is not None
    assert "1.6.0" in need.found


def test_a_container_image_needs_only_the_device(
    machine: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    have_built("9.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert needs.unmet_gsplat_need(without_device=True) is None
    need = needs.unmet_gsplat_need()
    assert need is not None
    assert need.of_device
    assert "driver" in need.remedy


def test_rendering_on_the_cpu_despite_a_gpu_logs_a_warning(
    machine: dict[str, str],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(select.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(needs, "installed_version", VERSIONS.get)
    monkeypatch.setattr(
        needs, "_kernels", lambda: needs.Need("kernels", False, "none", needs.BUILD)
    )
    select_backend.cache_clear()
    with caplog.at_level(logging.INFO, logger="real2sim_server.render"):
        assert select_backend("auto").name == "cpu"
    warned = [record for record in caplog.records if record.levelno == logging.WARNING]
    assert [record for record in warned if "doctor --build-gpu" in record.getMessage()]


def test_kernels_serve_devices_of_their_generation() -> None:
    kernels = BuiltKernels(Path("csrc.so"), ("8.0", "12.0"))
    assert kernels.serves((8, 0))
    assert kernels.serves((8, 9))
    assert kernels.serves((12, 1))
    assert not kernels.serves((7, 5))
    assert not kernels.serves((9, 0))


def test_building_without_gsplat_names_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gsplat_build, "gsplat_package", lambda: None)
    with pytest.raises(RenderError, match=r"real2sim\[server,cuda\]"):
        build_kernels(["9.0"])


def test_building_with_a_cpu_only_torch_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gsplat_build, "gsplat_package", lambda: Path("gsplat"))
    monkeypatch.setattr(torch.version, "cuda", None)
    with pytest.raises(RenderError, match="CPU only"):
        build_kernels(["9.0"])


RASTERIZATION = """
#include "Rasterization.h"
namespace gsplat {

std::tuple<at::Tensor, at::Tensor> rasterize_to_pixels_3dgs_fwd(
    int channels
) {
    switch (channels) {
        __LAUNCH_KERNEL__(1)
        __LAUNCH_KERNEL__(3)
    }
}

std::tuple<
    at::Tensor,
    at::Tensor>
rasterize_to_pixels_2dgs_fwd(
    int channels
) {
    rasterize_to_pixels_3dgs_fwd(channels);
}

} // namespace gsplat
"""


def test_only_the_used_gsplat_functions_are_compiled(tmp_path: Path) -> None:
    package = tmp_path / "gsplat"
    sources = package / "cuda" / "csrc"
    sources.mkdir(parents=True)
    from real2sim_server.render._cuda import gsplat_build

    for name in gsplat_build.SOURCES:
        (sources / name).write_text(RASTERIZATION if name == "Rasterization.cpp" else "")
    (package / "cuda" / "ext.cpp").write_text(
        'm.def("adam", &gsplat::adam);\nm.def(\n "intersect_tile", &gsplat::intersect_tile\n);\n'
    )
    out = tmp_path / "slim"
    out.mkdir()
    written = {path.name: path.read_text() for path in write_slim_sources(package, out)}
    slim = written["Rasterization.cpp"]
    assert "rasterize_to_pixels_3dgs_fwd" in slim
    assert "2dgs" not in slim
    assert "__LAUNCH_KERNEL__(3)" in slim
    assert "__LAUNCH_KERNEL__(1)" not in slim
    assert slim.rstrip().endswith("} // namespace gsplat")
    assert "adam" not in written["ext.cpp"]
    assert "intersect_tile" in written["ext.cpp"]
