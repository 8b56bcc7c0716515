"""Compiles gsplat's slim sources, as a program: ``<folder of gsplat> <folder to work in>``.

Started by :mod:`.gsplat_build` with the variables by which torch finds the compiler.
"""

from __future__ import annotations

import sys
from pathlib import Path

from torch.utils import cpp_extension

from .slim_gsplat import write_slim_sources


def compile_gsplat(package: Path, work: Path) -> None:
    """Leave ``csrc.so`` in ``work``."""
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


if __name__ == "__main__":
    compile_gsplat(Path(sys.argv[1]), Path(sys.argv[2]))
