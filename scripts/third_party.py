"""Writes THIRD_PARTY.md: what an installed worker is made of besides Real2Sim, and its licences.

``python scripts/third_party.py`` reads docker/requirements.txt and the metadata of what is
installed here; ``--check`` only says whether the file is what it would write.
"""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).parents[1]
PINS = ROOT / "docker" / "requirements.txt"
VENDOR = ROOT / "server" / "real2sim_server" / "service" / "ui" / "vendor"
NOTICES = ROOT / "THIRD_PARTY.md"

HEAD = """\
# Third-party software

What `pip install 'real2sim[server,postgres,objects,tracing]'` and the images bring along.
Real2Sim's own licence is in `LICENSE`. Written by `scripts/third_party.py`; a CycloneDX SBOM is
attached to each release.

## Native libraries inside wheels that have conditions of their own

- **FFmpeg** (LGPL-2.1-or-later), in opencv-contrib-python-headless. It is linked dynamically: the
  libraries beside the wheel may be replaced by builds of your own. Sources are at ffmpeg.org, the
  full text is in the wheel's `LICENSE-3RD-PARTY.txt`.
- **OpenSSL 1.1.1k** (OpenSSL and SSLeay licences), in opencv-contrib-python-headless, where FFmpeg
  uses it for network streams. Real2Sim opens none: videos are written to files. 1.1.1 gets no
  public fixes any more.
- **libgfortran, libquadmath** (GPL-3.0 with the GCC runtime exception, LGPL-2.1), in numpy, scipy
  and opencv-contrib-python-headless. The exception covers programs that are linked with them.
- **CUDA, cuDNN, NCCL** and others (NVIDIA's licences), with torch's CUDA builds on GPU images. Read
  their terms before you publish such an image.

## Data

- **The body model** (CC0-1.0), `real2sim_server/body/asset.npz`, made from data of MakeHuman; where
  they come from is in `ASSET.md` beside it.

## Modules of the studio

Served as they were published on npm, from `real2sim_server/service/ui/vendor`, where their licences
lie beside them: `three` (MIT, the authors of three.js) draws, `@sparkjsdev/spark` (MIT, the
authors of Spark) draws Gaussians with it, with `fflate` (MIT) inside.

| file | sha256 |
|---|---|
"""

DISTRIBUTIONS = """\

## Python distributions

| name | version | licence |
|---|---|---|
"""


def main() -> int:
    """Write or check the file; the exit code."""
    text = HEAD + "".join(f"| {name} | `{digest}` |\n" for name, digest in vendored())
    text += DISTRIBUTIONS + "".join(
        f"| {name} | {version} | {licence_of(name)} |\n" for name, version in pins()
    )
    if "--check" not in sys.argv:
        NOTICES.write_text(text, encoding="utf-8")
        return 0
    if NOTICES.read_text(encoding="utf-8") == text:
        return 0
    print("THIRD_PARTY.md is not that of what is installed: python scripts/third_party.py")
    return 1


def vendored() -> Iterator[tuple[str, str]]:
    """Path and SHA-256 of each file of other projects that the studio serves."""
    for path in sorted(VENDOR.rglob("*")):
        if path.is_file():
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            yield path.relative_to(VENDOR).as_posix(), digest


def pins() -> Iterator[tuple[str, str]]:
    """Name and version of each distribution that an image installs, torch among them."""
    names = re.findall(r"(?m)^([A-Za-z0-9._-]+)==([^ ;\\]+)", PINS.read_text(encoding="utf-8"))
    constraints = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    torch = re.search(r"(?m)^torch==(\S+)", constraints)
    if torch is not None:
        names.append(("torch", torch[1]))
    yield from sorted(names)


def licence_of(name: str) -> str:
    """SPDX expression or name of the licence, as the distribution's metadata states it."""
    try:
        stated = metadata.metadata(name)
    except metadata.PackageNotFoundError:
        return ABSENT.get(name, "not installed here: see its page on PyPI")
    licence: str = stated["License-Expression"] or ""
    if not licence:
        classifiers = stated.get_all("Classifier") or []
        named = [c.split(" :: ")[-1] for c in classifiers if c.startswith("License ::")]
        licence = ", ".join(named) or (stated["License"] or "not stated").splitlines()[0]
    return licence.replace("|", "/")


ABSENT = {"colorama": "BSD-3-Clause"}
"""Licences of what other systems alone install."""


if __name__ == "__main__":
    sys.exit(main())
