"""The ``--json`` option of every worker command, on real figures.

Benches are tested in ``benchmarks/test_environment.py``, client commands in the client's tests.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import typer.main
from typer.testing import CliRunner

from real2sim.cli import build_app
from real2sim_server.scene.io import save_scene
from real2sim_server.synthetic import SyntheticConfig, synthesize

CLIENT = {"status", "scenes", "scenario", "edit", "drive"}
MADE = {
    "synth": "--out {log} --frames 4 --width 96 --height 64 --moving-cars 0 --parked-cars 0",
    "reconstruct": "{log} --out {street} --iterations 1 --width 96",
    "run": "gallery:ccrs --seconds 1 --save {episode} --scene-out {flat}",
    "export": "{tiny} --out {splats} --object car_red",
}
"""Commands whose output is read by others, in order."""
COMMANDS = {
    **MADE,
    "log-info": "{log} --check",
    "track": "{moving} --out {out}",
    "fit-lidar": "{street} {log} --out {out} --steps 1",
    "fit-uncertainty": "{street} {log} --out {out} --views 2",
    "import": "{splats}/001_car_red.ply --out {out}.r2s --asset",
    "export-dataset": "{tiny} --out {out} -f labels --width 64 --end-us 100000",
    "render": "{tiny} --out {out}.png --width 64",
    "evaluate": "{street} {log} --frames 1 --shifts none --width 64",
    "validate": "--cases handover --page {out}.html",
    "simulate": "{tiny} --out {out} --experiment drop --duration 0.02",
    "calibrate": "{tiny} --object car_blue --fit speed --steps 1 --duration 0.3",
    "ground": "{tiny}",
    "map": "{tiny} --from {roads} --as-it-is --out {out}.json",
    "sweep": "{spec} --out {out} --scenes {scenes}",
    "train-policy": "{flat} --out {out}.safetensors --epochs 1 --shifted 0",
    "replay": "{episode} --scene {flat}",
    "gallery": "",
    "doctor": "",
}
SPEC = """
case: {name: alone, scene: tiny.r2s, reset: {horizon: 5}}
parameters: {after: {low: 0.0, high: 0.1}}
method: {kind: random, count: 1}
planners: [follow_route]
"""


LANELET = """<osm>
<node id="1" lat="49" lon="8.4"/><node id="2" lat="49" lon="8.401"/>
<node id="3" lat="48.99997" lon="8.4"/><node id="4" lat="48.99997" lon="8.401"/>
<way id="11"><nd ref="1"/><nd ref="2"/></way><way id="12"><nd ref="3"/><nd ref="4"/></way>
<relation id="21"><tag k="type" v="lanelet"/><member type="way" role="left" ref="11"/>
<member type="way" role="right" ref="12"/></relation></osm>"""


def figures_of(command: str, words: dict[str, Any], path: Path) -> Any:
    given = COMMANDS[command].format(**words, out=path.with_suffix(""))
    done = CliRunner().invoke(build_app(), [command, *given.split(), "--json", str(path)])
    assert done.exit_code == 0, f"{done.output}{done.exception!r}"
    return json.loads(path.read_text())


@pytest.fixture(scope="module")
def made(tiny_scene, tmp_path_factory):
    """Paths by name, and the figures of the commands that created them."""
    folder = tmp_path_factory.mktemp("figures")
    names = {"log": "log", "street": "street.r2s", "episode": "a.r2e", "tiny": "tiny.r2s"}
    names |= {"flat": "flat.r2s", "splats": "splats.ply", "roads": "a.osm", "moving": "moving"}
    words = {key: folder / name for key, name in names.items()}
    words |= {"spec": folder / "sweep.yaml", "scenes": folder}
    synthesize(SyntheticConfig(frames=8, width=96, height=64, moving_cars=1), words["moving"])
    words["spec"].write_text(SPEC)
    words["roads"].write_text(LANELET)
    save_scene(tiny_scene, words["tiny"])
    found = {name: figures_of(name, words, folder / f"{name}.json") for name in MADE}
    return words, found


def test_every_command_with_a_json_option_is_tested():
    commands = typer.main.get_command(build_app()).commands  # type: ignore[attr-defined]
    with_figures = {
        name
        for name, command in commands.items()
        if any("--json" in parameter.opts for parameter in command.params)
    }
    assert with_figures - CLIENT == set(COMMANDS) | {"search"}


TAKE_LOGS = {
    "reconstruct": "{gone} --out {out}",
    "log-info": "{gone}",
    "track": "{gone} --out {out}",
    "evaluate": "{tiny} {gone}",
    "fit-lidar": "{tiny} {gone} --out {out}",
    "fit-uncertainty": "{tiny} {gone} --out {out}",
    "render": "{tiny} --out {out}.png --width 64 --log {gone}",
    "ground": "{tiny} --log {gone}",
    "map": "{tiny} --from log --log {gone} --out {out}.json",
    "train-policy": "{gone} --out {out}.safetensors",
}


@pytest.mark.parametrize("command", TAKE_LOGS)
def test_every_command_says_the_same_of_a_log_that_is_not_there(made, command, tmp_path):
    words = made[0] | {"gone": tmp_path / "gone.tfrecord", "out": tmp_path / "out"}
    given = TAKE_LOGS[command].format(**words).split()
    done = CliRunner().invoke(build_app(), [command, *given], env={"COLUMNS": "400"})
    assert done.exit_code == 1
    assert f"{words['gone']}: no such file or folder; give the folder of a log" in done.output


SLOW = {"fit-lidar", "track", "train-policy"}


@pytest.mark.parametrize("command", [
    pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in COMMANDS
])  # fmt: skip
def test_commands_write_json_figures(made, command, tmp_path):
    words, found = made
    figures = found.get(command) or figures_of(command, words, tmp_path / "figures.json")
    assert figures
