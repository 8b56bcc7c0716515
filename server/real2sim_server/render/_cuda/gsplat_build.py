"""Compiling gsplat's kernels from wheels, and finding compiled ones.

gsplat on PyPI has no compiled kernels. It compiles them on first use, which takes minutes, with
whichever compiler it finds. Here this is a separate step, ``real2sim doctor --build-gpu``, with the
compiler version that torch was built with, from the ``cuda`` extra. The result is cached by the
versions of gsplat, torch and Python and by the architectures.

To save minutes, only functions that the CUDA backend calls are compiled: packed projection,
covariances, spherical harmonics, tile intersection and blending of three and four channels, forward
and backward. They keep their names, so gsplat's own wrapper finds them. Run as a program with the
arguments ``<folder of gsplat> <work folder>``, the module compiles these sources.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from ..._files import atomic_folder
from ..._nvrtc import kernels_folder
from ..types import RenderError

CHANNELS = ("3", "4")
"""Supported numbers of channels: RGB, and RGB with depth."""
FUNCTIONS = (
    "quat_scale_to_covar_preci_fwd",
    "quat_scale_to_covar_preci_bwd",
    "spherical_harmonics_fwd",
    "spherical_harmonics_bwd",
    "projection_ewa_3dgs_packed_fwd",
    "projection_ewa_3dgs_packed_bwd",
    "intersect_tile",
    "intersect_offset",
    "rasterize_to_pixels_3dgs_fwd",
    "rasterize_to_pixels_3dgs_bwd",
)
SOURCES = (
    "QuatScaleToCovar.cpp",
    "QuatScaleToCovarCUDA.cu",
    "SphericalHarmonics.cpp",
    "SphericalHarmonicsCUDA.cu",
    "Projection.cpp",
    "ProjectionEWA3DGSPacked.cu",
    "Intersect.cpp",
    "IntersectTile.cu",
    "Rasterization.cpp",
    "RasterizeToPixels3DGSFwd.cu",
    "RasterizeToPixels3DGSBwd.cu",
)
FUNCTION_START = re.compile(r"^(?=(?:std::tuple<|at::Tensor |void ))", re.MULTILINE)


def write_slim_sources(package: Path, folder: Path) -> list[Path]:
    """Write the sources to ``folder``; return the paths of the files to compile.

    Args:
        package: folder of the installed gsplat 1.5.
        folder: existing folder.
    """
    written = []
    for name in SOURCES:
        text = (package / "cuda" / "csrc" / name).read_text(encoding="utf-8")
        text = _without_channels(text)
        if name.endswith(".cpp"):
            text = _without_functions(text)
        written.append(folder / name)
        written[-1].write_text(text, encoding="utf-8")
    bindings = (package / "cuda" / "ext.cpp").read_text(encoding="utf-8")
    written.append(folder / "ext.cpp")
    written[-1].write_text(_without_bindings(bindings), encoding="utf-8")
    return written


def _without_channels(text: str) -> str:
    """Remove template instances for other numbers of channels."""
    instance = re.compile(r"^[ \t]*(?:__INS__|__LAUNCH_KERNEL__)\((\d+)\)[ \t]*\n", re.MULTILINE)
    return instance.sub(lambda found: found[0] if found[1] in CHANNELS else "", text)


def _without_functions(text: str) -> str:
    """Remove functions that are not called; text before and after them stays."""
    body, closing, rest = text.rpartition("} // namespace gsplat")
    head, *functions = FUNCTION_START.split(body)
    kept = [part for part in functions if _name_of(part) in FUNCTIONS]
    return head + "".join(kept) + closing + rest


def _name_of(function: str) -> str:
    found = re.search(r"\b(\w+)\s*\(", function)
    return found[1] if found else ""


def _without_bindings(text: str) -> str:
    binding = re.compile(r"m\.def\(\s*\"(\w+)\",\s*&gsplat::\w+\s*\);")
    return binding.sub(lambda found: found[0] if found[1] in FUNCTIONS else "", text)


# Compilation


def compile_gsplat(package: Path, work: Path) -> None:
    """Compile ``csrc.so`` in ``work``."""
    from torch.utils import cpp_extension

    sources = work / "sources"
    sources.mkdir()
    cuda = package / "cuda"
    cpp_extension.load(
        name="csrc",
        sources=[str(path) for path in write_slim_sources(package, sources)],
        extra_cflags=["-O3", "-Wno-attributes"],
        extra_cuda_cflags=["-O3", "--use_fast_math"],
        extra_include_paths=[
            str(cuda / "include"),
            str(cuda / "csrc"),
            str(cuda / "csrc" / "third_party" / "glm"),
        ],
        extra_ldflags=[f"-L{work / 'lib'}"],
        build_directory=str(work),
        is_python_module=False,
        verbose=True,
    )


# Build and cache

LIBRARY = "csrc.so"
RECORD = "built.json"
INSTALL = "pip install 'real2sim[server,cuda]'"
CUDA_TORCH = f"in a fresh environment, with torch from PyPI: {INSTALL}"
BUILD_TIMEOUT_S = 3600.0


@dataclass(frozen=True)
class BuiltKernels:
    """Compiled kernels on disk.

    Attributes:
        library: path of the extension module.
        architectures: its compute capabilities, such as ``9.0``.
    """

    library: Path
    architectures: tuple[str, ...]

    def serves(self, capability: tuple[int, int]) -> bool:
        """Whether a device with that compute capability can run it: same major, same or higher
        minor version."""
        pairs = [tuple(map(int, name.split("."))) for name in self.architectures]
        return any(major == capability[0] and minor <= capability[1] for major, minor in pairs)


def built_kernels() -> list[BuiltKernels]:
    """All kernels compiled for this gsplat, torch, CUDA and Python."""
    found = []
    for record in sorted(kernels_folder().glob(f"{_key()}-*/{RECORD}")):
        names = json.loads(record.read_text(encoding="ascii"))["architectures"]
        found.append(BuiltKernels(record.parent / LIBRARY, tuple(names)))
    return found


def load_kernels(kernels: BuiltKernels) -> None:
    """Make gsplat use ``kernels``; call before gsplat's first use.

    Raises:
        RenderError: the library cannot be loaded.
    """
    if "gsplat.csrc" in sys.modules:
        return
    import gsplat

    spec = importlib.util.spec_from_file_location("gsplat.csrc", kernels.library)
    assert spec is not None
    assert spec.loader is not None
    try:
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    except ImportError as error:
        raise RenderError(
            f"{kernels.library} cannot be loaded: {error}; build it again: "
            "real2sim doctor --build-gpu"
        ) from error
    sys.modules["gsplat.csrc"] = gsplat.csrc = module


def build_kernels(architectures: Sequence[str]) -> tuple[BuiltKernels, float]:
    """Compile for ``architectures`` (``9.0``, ``8.6`` ...); returns the kernels and the seconds.

    Raises:
        RenderError: a requirement is missing, or the compiler failed.
    """
    home, package = cuda_home(), gsplat_package()
    if package is None:
        raise RenderError(f"gsplat is not installed; {INSTALL}")
    if torch.version.cuda is None:
        raise RenderError(f"torch {torch.__version__} is built for CPU only; {CUDA_TORCH}")
    if home is None:
        raise RenderError(
            f"no compiler of CUDA {torch.version.cuda}, which torch is built for; {INSTALL}"
        )
    if shutil.which("g++") is None:
        raise RenderError("gsplat needs a C++ compiler; apt-get install g++")
    if not (Path(sysconfig.get_path("include")) / "Python.h").is_file():
        raise RenderError("gsplat needs the headers of Python; apt-get install python3-dev")
    target = kernels_folder() / f"{_key()}-{'_'.join(sorted(architectures))}"
    target.parent.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    with atomic_folder(target) as folder:
        _compile(folder, home, package, architectures)
        record = {"architectures": sorted(architectures)}
        (folder / RECORD).write_text(json.dumps(record) + "\n", encoding="ascii")
    built = BuiltKernels(target / LIBRARY, tuple(sorted(architectures)))
    return built, time.perf_counter() - start


def _compile(folder: Path, home: Path, package: Path, architectures: Sequence[str]) -> None:
    """Compile in a subprocess, because torch determines the CUDA folder on import."""
    work = folder / "work"
    links = work / "lib"
    links.mkdir(parents=True)
    for library in sorted((home / "lib").glob("libcudart.so.*")):
        # The wheel only has the versioned name; the linker needs the unversioned one.
        (links / "libcudart.so").symlink_to(library)
        break
    variables = {
        "CUDA_HOME": str(home),
        "TORCH_CUDA_ARCH_LIST": ";".join(architectures),
        "LIBRARY_PATH": os.pathsep.join([str(links), os.environ.get("LIBRARY_PATH", "")]),
        "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]),
    }
    program = "real2sim_server.render._cuda.gsplat_build"
    done = subprocess.run(
        [sys.executable, "-m", program, str(package), str(work)],
        env={"MAX_JOBS": str(os.cpu_count() or 1), **os.environ, **variables},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=BUILD_TIMEOUT_S,
        check=False,
    )
    if done.returncode:
        said = "\n".join(done.stdout.strip().splitlines()[-15:])
        raise RenderError(f"gsplat's kernels cannot be compiled with {home}:\n{said}")
    shutil.copy2(work / LIBRARY, folder / LIBRARY)
    shutil.rmtree(work)


def cuda_home() -> Path | None:
    """CUDA toolkit with the version that torch was built with, from wheels or the system."""
    wanted = torch.version.cuda
    return next((p for p in cuda_folders() if wanted and _compiler_version(p) == wanted), None)


def cuda_folders() -> list[Path]:
    """Candidate folders of a CUDA toolkit; that of the wheels is first."""
    spec = importlib.util.find_spec("nvidia")
    wheels = (spec.submodule_search_locations or ()) if spec else ()
    major = (torch.version.cuda or "13").split(".")[0]
    places = [Path(folder) / f"cu{major}" for folder in wheels]
    given = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH")
    places += [Path(given)] if given else []
    return [*places, Path("/usr/local/cuda")]


def _compiler_version(home: Path) -> str | None:
    """Version of the compiler in ``home``, such as ``13.0``; None without a compiler."""
    compiler = home / "bin" / "nvcc"
    if not compiler.is_file():
        return None
    said = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=False)
    _, _, release = said.stdout.partition("release ")
    return release.split(",")[0] or None


def gsplat_package() -> Path | None:
    """Folder of the installed gsplat."""
    spec = importlib.util.find_spec("gsplat")
    return None if spec is None or spec.origin is None else Path(spec.origin).parent


def _key() -> str:
    try:
        version = importlib.metadata.version("gsplat")
    except importlib.metadata.PackageNotFoundError:
        version = "none"
    tag = f"cp{sys.version_info.major}{sys.version_info.minor}"
    return f"gsplat-{version}-torch{torch.__version__}-{tag}"


if __name__ == "__main__":
    compile_gsplat(Path(sys.argv[1]), Path(sys.argv[2]))
