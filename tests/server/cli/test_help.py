"""What ``--help`` says of every command, the client's and the worker's."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import typer
from typer.testing import CliRunner

from real2sim.cli import build_app

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
    """Of a help text in its source; Markdown shows what stands between backquotes without them."""
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
        (("track",), "How far an object must go [m]."),
        (("render",), "Or a time stamp [us]."),
        (("simulate",), "Of an experiment [m/s]."),
        (("simulate",), "[s]"),
        (("replay",), "Of the video [px]."),
    ],
)
def test_units_are_shown(path, unit):
    assert unit in shown(path)
