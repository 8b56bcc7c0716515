"""The Typer app that carries the worker's commands, and how a function becomes one of them."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import typer

from ..console import run_command

Function = TypeVar("Function", bound=Callable[..., None])

app = typer.Typer(no_args_is_help=True)


def command(name: str, *, group: typer.Typer = app) -> Callable[[Function], Function]:
    """Register a function as the command ``name``; its parameters are the command's options.

    On the command line, errors that a person can mend become one sentence and exit code 1; the
    function itself is left as it is, and raises them.
    """

    def register(function: Function) -> Function:
        @functools.wraps(function)
        def invoke(**options: Any) -> None:
            run_command(function, **options)

        group.command(name)(invoke)
        return function

    return register
