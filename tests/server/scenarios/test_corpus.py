"""Public scenario files are read and drive like in esmini.

Each folder is a checkout, named by an environment variable: esmini/esmini, asam-oss/
OSC-ALKS-scenarios and vectorgrp/OSC-NCAP-scenarios. ``REAL2SIM_ESMINI_LIBRARY`` is the path of
esmini's shared library. Run with ``pytest -n 0 -s --run-slow``.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from real2sim_server.maps import read_map
from real2sim_server.scenarios import ScenarioError
from real2sim_server.scenarios.flat_scene import begun_alone, nobody_around
from real2sim_server.scenarios.openscenario import read_openscenario
from real2sim_server.world import WorldError
from real2sim_server.world.storyboard.roads import GraphNetwork

pytestmark = [pytest.mark.slow, pytest.mark.timeout(7200)]

SETS = {
    "esmini resources": ("REAL2SIM_ESMINI", "resources/xosc", 0.92, 0.48),
    "esmini unit tests": ("REAL2SIM_ESMINI", "EnvironmentSimulator/Unittest/xosc", 0.97, 0.62),
    "ALKS": ("REAL2SIM_ALKS", ".", 1.0, 0.75),
    "Euro NCAP": ("REAL2SIM_NCAP", ".", 1.0, 0.86),
}
"""Variable, folder, share of files that are read, and share of those within 5 cm of esmini."""

NEAR, SECONDS = 0.05, 30.0
STEPS = (0.01, 0.001)
"""Both simulators are compared at the second step if they differ at the first one [s]."""


def folder(name: str) -> Path:
    variable, inside, *_ = SETS[name]
    if variable not in os.environ:
        pytest.skip(f"{variable} does not name a checkout")
    return Path(os.environ[variable]) / inside


def files_of(name: str) -> list[Path]:
    """Scenarios and variations, without catalogs."""
    found = [f for f in sorted(folder(name).rglob("*.xosc")) if "Catalogs" not in f.parts]
    texts = {file: file.read_text("utf-8", errors="replace") for file in found}
    return [f for f, text in texts.items() if "<Storyboard" in text or "<Catalog " not in text]


@pytest.mark.parametrize("name", SETS)
def test_files_are_read(name: str) -> None:
    files, refused = files_of(name), dict[str, str]()
    for file in files:
        try:
            read_openscenario(file)
        except ScenarioError as error:
            refused[file.name] = str(error)
    for file_name, reason in refused.items():
        print(f"{file_name}: {reason}")
    print(f"{name}: {len(files) - len(refused)} of {len(files)} files are read")
    assert 1.0 - len(refused) / len(files) >= SETS[name][2]


def own_courses(file: Path, step: float) -> dict[str, np.ndarray]:
    """x, y of the box centres every 10 ms, [N, 2] by name; the storyboard moves the ego too."""
    found = read_openscenario(file)
    board = found.board.model_copy(update={"drives_ego": True})
    network = None if found.road_file is None else GraphNetwork(read_map(found.road_file))
    now, around = begun_alone(board, network), nobody_around(board)
    step_us = round(step * 1e6)
    every, count = round(0.01 / step), round(SECONDS / 0.01) + 1
    courses = {name: np.full((count, 2), np.nan) for name in now.entities}
    for k in range(count * every):
        for name, actor in now.entities.items() if k % every == 0 else ():
            if actor.visible:
                courses[name][k // every] = actor.middle
        if now.over:
            break
        now = now.advance(replace(around, t_us=k * step_us, dt_us=step_us))
    return courses


def difference(file: Path, step: float, scratch: Path) -> float | None:
    """Largest distance of an entity from where esmini has it [m]; None if one does not run it."""
    out = scratch / "courses.npz"
    out.unlink(missing_ok=True)
    esmini = Path(os.environ["REAL2SIM_ESMINI"])
    paths = [esmini / p for p in ("resources/xodr", "EnvironmentSimulator/Unittest/xodr")]
    paths.append(esmini / "resources/xosc/Catalogs")
    words = [os.environ["REAL2SIM_ESMINI_LIBRARY"], file, out, step, SECONDS, *paths]
    script = Path(__file__).with_name("esmini_courses.py")
    subprocess.run([sys.executable, script, *map(str, words)], cwd=scratch, check=False,
                   capture_output=True, timeout=600)  # fmt: skip
    if not out.is_file():
        return None
    try:
        own = own_courses(file, step)
    except (ScenarioError, WorldError):
        return None
    gaps = list[float]()
    with np.load(out) as theirs:
        for name in theirs.files:
            # esmini takes its first state before a motion and its last one after an evaluation.
            known = np.flatnonzero(~np.isnan(theirs[name][:, 0]))
            if name in own and len(known) > 2:
                rows = known[1:-1]
                gap = np.hypot(*(theirs[name][rows] - own[name][rows]).T)
                gaps.append(float(np.nanmax(gap, initial=0.0)))
    return max(gaps, default=None)


@pytest.mark.parametrize("name", SETS)
def test_files_drive_like_in_esmini(name: str, tmp_path: Path) -> None:
    files = files_of(name)
    if "REAL2SIM_ESMINI_LIBRARY" not in os.environ or "REAL2SIM_ESMINI" not in os.environ:
        pytest.skip("REAL2SIM_ESMINI and REAL2SIM_ESMINI_LIBRARY do not name esmini")
    compared = dict[str, float]()
    for file in files:
        for step in STEPS:
            gap = difference(file, step, tmp_path)
            if gap is None:
                break
            key = str(file.relative_to(folder(name)))
            compared[key] = min(gap, compared.get(key, gap))
            if compared[key] <= NEAR:
                break
    for key, gap in sorted(compared.items(), key=lambda item: -item[1]):
        print(f"{gap:10.3f} m  {key}")
    near = sum(gap <= NEAR for gap in compared.values())
    print(f"{name}: {near} of {len(compared)} files within {NEAR} m")
    assert near / len(compared) >= SETS[name][3]
