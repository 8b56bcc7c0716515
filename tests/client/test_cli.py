"""The command line of the client."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
import simplejpeg
import typer

from real2sim import cli
from real2sim._commands import drive as drive_command
from real2sim_proto.episode import ResetSpec

from .fake_episode import IMAGE
from .fake_worker import FakeWorker


@dataclass
class Done:
    """Outcome of a command."""

    returncode: int
    stdout: str
    stderr: str


Run = Callable[..., Done]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run the command in this process. Starting a new one each time takes seconds."""

    def run(*arguments: str, **environment: str) -> Done:
        for name, value in ({"NO_COLOR": "1", "COLUMNS": "120"} | environment).items():
            monkeypatch.setenv(name, value)
        monkeypatch.setattr("sys.argv", ["real2sim", *arguments])
        with pytest.raises(SystemExit) as left:
            cli.main()
        code = left.value.code
        return Done(code if isinstance(code, int) else 0, *capsys.readouterr())

    return run


@pytest.mark.network
def test_status_shows_the_worker(run: Run, worker: FakeWorker) -> None:
    done = run("status", "--url", worker.url)
    assert (done.returncode, done.stderr) == (0, "")
    assert "worker w0" in done.stdout
    assert "ready" in done.stdout


@pytest.mark.network
def test_json_output_goes_to_standard_output(run: Run, worker: FakeWorker) -> None:
    done = run("scenes", "--json", "-", REAL2SIM_URL=worker.url)
    assert [scene["scene"] for scene in json.loads(done.stdout)] == ["street"]


@pytest.mark.network
def test_frame_saves_the_rendered_image(run: Run, worker: FakeWorker, tmp_path: Path) -> None:
    target = tmp_path / "front.jpg"
    options = ("--scene", "street", "--camera", "front", "--out", str(target))
    assert run("frame", *options, "--url", worker.url).returncode == 0
    assert simplejpeg.decode_jpeg(target.read_bytes()).shape == IMAGE.shape


@pytest.mark.network
def test_edit_applies_a_file_of_operations(run: Run, worker: FakeWorker, tmp_path: Path) -> None:
    file = tmp_path / "edit.json"
    file.write_text(json.dumps([{"op": "duplicate", "object_id": "car_3", "y": 3.2}]))
    done = run("edit", str(file), "--scene", "street", "--url", worker.url)
    assert done.returncode == 0, done.stderr
    assert "car_3_copy1" in done.stdout
    assert "car_3_copy1" in worker.objects


@pytest.fixture
def operations(tmp_path: Path) -> Path:
    file = tmp_path / "edit.json"
    file.write_text(json.dumps([{"op": "translate", "object_id": "car_3", "y": 3.2}]))
    return file


@pytest.mark.network
def test_a_new_scenario_is_deleted_if_its_edit_is_refused(
    run: Run, worker: FakeWorker, operations: Path
) -> None:
    worker.mischief = "refuses edits"
    done = run("edit", str(operations), "--scene", "street", "--url", worker.url)
    assert done.returncode == 1
    assert "error: refused by the test" in done.stderr
    assert worker.deleted == ["sc_1"]


@pytest.mark.network
def test_a_dry_run_deletes_its_new_scenario(run: Run, worker: FakeWorker, operations: Path) -> None:
    options = ("--scene", "street", "--dry-run", "--url", worker.url)
    done = run("edit", str(operations), *options)
    assert done.returncode == 0, done.stderr
    assert "would apply 1 operations to a new scenario on street" in done.stdout
    assert worker.deleted == ["sc_1"]


@pytest.mark.network
def test_an_existing_scenario_is_kept_if_its_edit_is_refused(
    run: Run, worker: FakeWorker, operations: Path
) -> None:
    worker.mischief = "refuses edits"
    assert run("edit", str(operations), "--scenario", "sc_1", "--url", worker.url).returncode == 1
    assert worker.deleted == []


@pytest.mark.network
def test_a_new_scenario_is_kept_if_its_edit_applies(
    run: Run, worker: FakeWorker, operations: Path
) -> None:
    assert run("edit", str(operations), "--scene", "street", "--url", worker.url).returncode == 0
    assert worker.deleted == []


@pytest.mark.network
def test_drive_reports_rates_and_saves_frames(run: Run, worker: FakeWorker, tmp_path: Path) -> None:
    figures, out = tmp_path / "figures.json", tmp_path / "out"
    done = run(
        *("drive", "--scene", "street", "--steps", "5", "--cameras", "front"),
        *("--url", worker.url, "--json", str(figures), "--out", str(out)),
    )
    assert done.returncode == 0, done.stderr
    assert "5 steps, 0.5 s" in done.stdout
    summary = json.loads(figures.read_text())
    assert summary["stages_ms"]["step"]["count"] == 5
    assert json.loads((out / "summary.json").read_text()) == summary
    frames = sorted(path.name for path in (out / "front").iterdir())
    assert frames == [f"{step:06d}.jpg" for step in range(6)]
    picture = simplejpeg.decode_jpeg((out / "front" / frames[-1]).read_bytes())
    assert np.abs(picture.astype(int) - IMAGE).max() <= 8


@pytest.mark.network
def test_drive_flags_set_the_reset_options(run: Run, worker: FakeWorker) -> None:
    done = run(
        *("drive", "--scene", "street", "--steps", "1", "--url", worker.url),
        *("--beyond-log", "loop", "--spawn", '{"density": 30}', "--seed", "4"),
        *("--lidar", "vlp-16,os1-128", "--radar", "corner"),
        *("--randomization", '{"latency_us": 5000}', "--reset", '{"agents": {"default": "idm"}}'),
    )
    assert done.returncode == 0, done.stderr
    (reset,) = [m for m in worker.messages if m["type"] == "reset"]
    spec = ResetSpec.model_validate(reset["spec"])
    assert (spec.seed, spec.beyond_log, spec.horizon) == (4, "loop", 36_000)
    assert (spec.agents.default, spec.agents.spawn.density) == ("idm", 30)
    assert spec.randomization.latency_us == 5000
    assert [s.lidar for s in spec.lidars] == ["vlp-16", "os1-128"]
    assert [s.radar for s in spec.radars] == ["corner"]


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (("--spawn", "{"), "--spawn is not JSON"),
        (("--randomization", "3"), "--randomization is not a JSON object"),
        (("--reset", '{"horison": 3}'), "horison"),
        (("--beyond-log", "for ever"), "beyond_log"),
    ],
)
@pytest.mark.network
def test_invalid_flags_are_named_in_the_error(
    run: Run, worker: FakeWorker, flags: tuple[str, str], sentence: str
) -> None:
    done = run("drive", "--scene", "street", "--url", worker.url, *flags)
    assert done.returncode != 0
    assert sentence in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.network
def test_a_refused_handshake_prints_an_error_without_a_traceback(
    run: Run, worker: FakeWorker
) -> None:
    worker.mischief = "426 at the handshake"
    done = run("drive", "--scene", "street", "--url", worker.url)
    assert done.returncode == 1
    assert "error: the client offers" in done.stderr
    assert "hint: install a newer client" in done.stderr
    assert "Traceback" not in done.stderr


def test_without_a_worker_the_error_says_how_to_start_one(run):
    done = run("status", "--url", "http://127.0.0.1:9")
    assert done.returncode == 1
    assert done.stderr.startswith("error: no worker answers at http://127.0.0.1:9")
    assert "hint: start a worker with `real2sim serve`" in done.stderr


def test_real2sim_debug_shows_tracebacks(monkeypatch):
    monkeypatch.setenv("REAL2SIM_DEBUG", "1")
    monkeypatch.setattr("sys.argv", ["real2sim", "status", "--url", "nonsense"])
    with pytest.raises(ValueError, match="is not an address"):
        cli.main()


def test_the_installed_command_starts():
    command = [sys.executable, "-m", "real2sim.cli", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("real2sim ")


@pytest.mark.parametrize(
    ("command", "named"),
    [
        ("drive", "--scene, --scenario and --session"),
        ("frame --camera front -o a.jpg", "--scene and --scenario"),
    ],
)
def test_a_scene_or_a_scenario_is_required(run, command, named):
    done = run(*command.split())
    assert done.returncode == 2
    assert f"exactly one of {named}" in done.stderr


@pytest.mark.parametrize(
    ("content", "sentence"), [("{", "is not JSON"), ("{}", "give a list of operations")]
)
def test_an_invalid_operations_file_is_explained(run, tmp_path, content, sentence):
    file = tmp_path / "edit.json"
    file.write_text(content)
    done = run("edit", str(file), "--scene", "street")
    assert done.returncode == 1
    assert sentence in done.stderr


def test_commands_of_other_packages_are_added(monkeypatch):
    entry = EntryPoint("x", f"{__name__}:extension", cli.COMMAND_GROUP)
    monkeypatch.setattr(EntryPoint, "load", lambda self: extension)
    monkeypatch.setattr(cli, "entry_points", lambda group: [entry])
    names = typer.main.get_command(cli.build_app()).list_commands(None)
    assert {"status", "drive", "fly"} <= set(names)


def test_a_broken_package_is_reported_and_other_commands_remain(monkeypatch, capsys):
    entry = EntryPoint("x", "no_such_package:app", cli.COMMAND_GROUP)
    monkeypatch.setattr(cli, "entry_points", lambda group: [entry])
    names = typer.main.get_command(cli.build_app()).list_commands(None)
    assert "status" in names
    assert "no_such_package" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (ValueError("wrong"), "error: wrong"),
        (KeyError("no object"), "error: no object"),
        (RuntimeError("odd"), "error: RuntimeError: odd\nhint: REAL2SIM_DEBUG=1"),
    ],
)
def test_errors_are_printed_as_one_sentence(error, sentence, capsys):
    cli.print_error(error)
    assert capsys.readouterr().err.startswith(sentence)


extension = typer.Typer()


@extension.command()
def fly() -> None:
    """Not a car."""


@extension.command()
def swim() -> None:
    """Not a car either."""


def test_the_width_also_applies_to_cameras_of_the_planner():
    needed = [
        {"camera": "front", "modalities": ["rgb"], "width": None},
        {"camera": "left", "modalities": ["depth"], "width": 64},
    ]
    shown = drive_command._sensors(["left"], 320, needed)
    assert shown == [
        {"camera": "front", "modalities": ["rgb"], "width": 320},
        {"camera": "left", "modalities": ["depth", "rgb"], "width": 320},
    ]
    assert drive_command._sensors([], 320, needed)[1]["width"] == 64
