"""gsplat's CUDA sources cut down to what the CUDA backend calls.

Packed projection, covariances, spherical harmonics, tile intersection and blending of three and
four channels, forward and backward: minutes of compiling less, and the same functions under the
same names, so that gsplat's own wrapper finds them.
"""

from __future__ import annotations

import re
from pathlib import Path

CHANNELS = ("3", "4")
"""Numbers of channels that are blended: RGB, and RGB with depth."""
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
    """Write the sources to ``folder``; the paths of what is to be compiled.

    Args:
        package: folder of the installed gsplat 1.5.
        folder: exists.
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
    """Without the instances of templates for other numbers of channels."""
    instance = re.compile(r"^[ \t]*(?:__INS__|__LAUNCH_KERNEL__)\((\d+)\)[ \t]*\n", re.MULTILINE)
    return instance.sub(lambda found: found[0] if found[1] in CHANNELS else "", text)


def _without_functions(text: str) -> str:
    """Without the functions that are not called; what precedes and closes them stays."""
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
