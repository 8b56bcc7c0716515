"""The ``--help`` texts of all commands of the client and the worker."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import typer
from typer.testing import CliRunner

from real2sim.cli import PANELS, build_app

APP = build_app()


def commands(command, path=()) -> Iterator[tuple[tuple[str, ...], object]]:
    yield path, command
    for name, child in getattr(command, "commands", {}).items():
        yield from commands(child, (*path, name))


COMMANDS = dict(commands(typer.main.get_command(APP)))


def shown(path) -> str:
    done = CliRunner().invoke(APP, [*path, "--help"], env={"COLUMNS": "400"})
    assert done.exit_code == 0, done.output
    return done.output


def words(text: str | None) -> list[str]:
    """Words of a help text in its source. Rendered Markdown omits the backquotes."""
    return (text or "").replace("`", "").split()


@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
def test_every_word_of_the_help_is_shown(path):
    output = shown(path)
    command = COMMANDS[path]
    texts = [command.help, *(parameter.help for parameter in command.params)]
    missing = [word for text in texts for word in words(text) if word not in output]
    assert not missing


@pytest.mark.parametrize(
    ("path", "unit"),
    [
        (("synth",), "Image width [px]."),
        (("track",), "Minimum distance that an object travels [m]."),
        (("render",), "Time [us] instead of a frame."),
        (("simulate",), "Speed of the experiment [m/s]."),
        (("simulate",), "[s]"),
        (("replay",), "Width of the video [px]."),
    ],
)
def test_units_are_shown_in_the_help(path, unit):
    assert unit in shown(path)


def test_every_command_is_in_one_panel():
    listed = " ".join(PANELS.values()).split()
    assert sorted(listed) == sorted(path[0] for path in COMMANDS if len(path) == 1)


def test_panels_and_their_commands_are_shown_in_order():
    lines = shown(()).splitlines()
    titles = [line.strip("╭╮─ ") for line in lines if line.startswith("╭")]
    assert titles == ["Options", *PANELS]
    first = [line.split()[1] for line in lines if line.startswith("│")]
    assert [word for word in first if not word.startswith("-")] == " ".join(PANELS.values()).split()


def test_the_help_lists_the_commands_of_the_sdk_alone(monkeypatch):
    monkeypatch.setattr("real2sim.cli.entry_points", lambda group: ())
    own = typer.main.get_command(build_app()).commands
    _, told = shown(()).split("With the SDK alone you have ")
    assert set(told.partition(".")[0].split(", ")) == set(own)


@pytest.mark.parametrize("words", ["serve", "render scene -o out.png", "token list"])
def test_a_worker_command_without_its_libraries_says_what_to_install(words, monkeypatch):
    monkeypatch.setattr("real2sim_server.console.SERVER_MODULES", ("a_library_of_the_worker",))
    done = CliRunner().invoke(APP, words.split(), env={"COLUMNS": "400"})
    assert done.exit_code == 1
    assert "pip install 'real2sim[server]'" in done.output
