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
from fnmatch import fnmatch
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
    "esmini resources": ("REAL2SIM_ESMINI", "resources/xosc", 0.92, 0.53),
    "esmini unit tests": ("REAL2SIM_ESMINI", "EnvironmentSimulator/Unittest/xosc", 0.97, 0.69),
    "ALKS": ("REAL2SIM_ALKS", ".", 1.0, 0.9),
    "Euro NCAP": ("REAL2SIM_NCAP", ".", 1.0, 0.86),
}
"""Variable, folder, share of files that are read, and share of those within 5 cm of esmini."""

REASONS = {
    "controllers of esmini": (
        "follow_route_* perform_single_* *ghost* *sumo* cut-in_interactive cut-in_sloppy "
        "friction_and_* race_hid driver_lane_bouncing* junction-selector cut-in_external "
        "drive_when_close follow_reference"
    ),
    "properties of esmini": "traj_use_cases traj_heading_and_* follow_trajectory_by_front_axle*",
    "trailers": "trailer* trajectory_speed trajectory_heading cut-in_cr truck_with*",
    "constraints of parameters": "alks_scenario_4_3_*variation alks_scenario_4_4_1*variation",
    "an entity that is placed across": "drop-bike",
    "a relative orientation of a position on a route": "*CBFA*",
    "a position relative to an entity, beyond a junction": "relative_pos_over_intersection",
    "`<offset>` of an OpenDRIVE header": "geo_pos",
    "slopes and banked roads": "star pitch_by* positioning_slope* tilted_crest velodrome",
    "lanes that widen": (
        "lane_width_and_offset two_plus_one_road lane_offset_intersection ref_point routing-test"
    ),
    "a random route": "random_route_action",
    "a route": "route_detour highway_exit_with_route route_lane_change",
    "times of a trajectory": "trajectory-test brake_by_* bicycle_fall_over parking_demo",
    "end of a clothoid spline": "lane-change_clothoid_spline_based_trajectory",
    "end of a trajectory": "trajectory_special_cases",
    "limits of a distance action": (
        "highway_merge* distance_test keep_lateral_distance lat_dist_road_test"
    ),
    "a lateral distance in the frame": "lat_dist_entity*",
    "start of a synchronisation": (
        "synchronize ltap-od pedestrian_traj_synch *CCFhol* *CBNA* *CPTAfo*"
    ),
    "offset of a lane offset action": "test_action_dynamics",
    "off the road": "lane_change",
    "a followed speed beyond": "relative_speed_phases",
    "speeds that refer to each other": "init_actions_reorder",
    "a relative speed with a direction": "direction_dimension_trig",
    "an act that its stop trigger stops": "multi_lane_changes",
    "a position relative to a moving": "relative_lane_pos_* pedestrian_collision",
}
"""Start of a row in the table of differences of docs/scenarios.md, and patterns of file names."""

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


def reason_of(key: str) -> str | None:
    """Start of the row that explains why a file drives differently."""
    name = Path(key).stem
    known = ((row, patterns.split()) for row, patterns in REASONS.items())
    return next((row for row, found in known if any(fnmatch(name, p) for p in found)), None)


def test_each_reason_is_a_row_of_the_docs() -> None:
    text = (Path(__file__).parents[3] / "docs" / "scenarios.md").read_text("utf-8")
    assert [row for row in REASONS if f"\n| {row}" not in text] == []


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
    unexplained = list[str]()
    for key, gap in sorted(compared.items(), key=lambda item: -item[1]):
        why = reason_of(key) if gap > NEAR else ""
        print(f"{gap:10.3f} m  {key}  {why}")
        unexplained += [key] if why is None else []
    near = sum(gap <= NEAR for gap in compared.values())
    print(f"{name}: {near} of {len(compared)} files within {NEAR} m")
    assert near / len(compared) >= SETS[name][3]
    assert not unexplained
