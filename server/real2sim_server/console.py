"""How commands talk to a person: progress, tables, errors as sentences, figures as JSON."""

from __future__ import annotations

import importlib.util
import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.file_proxy import FileProxy
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

SERVER_MODULES = ("torch", "numba", "fastapi", "uvicorn", "cv2", "sqlalchemy", "safetensors")

LINE_EVERY_S = 10.0
"""Interval of the lines of a :class:`StatusLine` without a terminal."""

console = Console()
errors = Console(stderr=True)


class CommandError(Exception):
    """A command cannot continue; the message gives the value, the allowed ones, and a fix."""


def run_command(command: Callable[..., None], **arguments: Any) -> None:
    """Run a command; report user errors as one sentence with exit code 1."""
    require_server_extra()
    try:
        with telling_of_compiling():
            command(**arguments)
    except typer.Exit:
        raise
    except KeyboardInterrupt:
        errors.print("stopped")
        raise typer.Exit(130) from None
    except Exception as error:
        if os.environ.get("REAL2SIM_DEBUG") or not is_expected(error):
            raise
        errors.print(f"[bold red]error:[/] {escape(str(error))}", highlight=False, soft_wrap=True)
        raise typer.Exit(1) from None


def is_expected(error: Exception) -> bool:
    """Whether an error is one of ours or the system's, rather than a bug."""
    if isinstance(error, CommandError | OSError):
        return True
    module = type(error).__module__.split(".")[0]
    return module in ("real2sim", "real2sim_proto", "real2sim_server")


def require_server_extra() -> None:
    """Exit with a message if the base install runs a command of the worker."""
    missing = [name for name in SERVER_MODULES if importlib.util.find_spec(name) is None]
    if missing:
        errors.print(
            f"[bold red]error:[/] this command runs a worker and needs {', '.join(missing)}; "
            "install them with: pip install 'real2sim\\[server]'",
            highlight=False,
        )
        raise typer.Exit(1)


class StatusLine:
    """A status line for long operations: updated in place on a terminal, else printed now and then.

    Args:
        tell: writes a line if standard error is not a terminal.
    """

    def __init__(self, tell: Callable[[str], object] | None = None) -> None:
        self._tell = tell or (lambda text: print(text, file=sys.stderr, flush=True))
        self._width = 0
        self._next = 0.0

    def show(self, text: str) -> None:
        """Say how far it is."""
        # A progress bar takes whole lines and prints them above itself.
        if sys.stderr.isatty() and not isinstance(sys.stderr, FileProxy):
            # Other output overwrites it, from the start of the line.
            print(text.ljust(self._width), end="\r", file=sys.stderr, flush=True)
            self._width = len(text)
        elif time.monotonic() >= self._next:
            self._tell(text)
            self._next = time.monotonic() + LINE_EVERY_S

    def end(self) -> None:
        """Take the line away."""
        if self._width:
            print(" " * self._width, end="\r", file=sys.stderr, flush=True)
        self._width = 0


LISTENERS: list[Callable[[str], object]] = []
"""The last listener gets the progress of kernel compilation."""


@contextmanager
def telling_of_compiling() -> Iterator[None]:
    """Tell the person of kernels that the block compiles: how many there are, and are ready."""
    line = StatusLine()
    LISTENERS.append(line.show)
    try:
        yield
    finally:
        LISTENERS.remove(line.show)
        line.end()


@contextmanager
def progress(description: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar; the yielded function takes (done, total)."""
    with staged_progress() as report:
        yield lambda done, total: report(description, done, total)


@contextmanager
def staged_progress() -> Iterator[Callable[..., None]]:
    """Progress bars by stage; the yielded function takes (stage, done, total[, text])."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=errors, transient=not sys.stderr.isatty()) as bar:
        tasks: dict[str, Any] = {}

        def report(stage: str, done: int, total: int, text: str | None = None) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total)
            bar.update(tasks[stage], completed=done, total=total, description=text or stage)

        yield report


@contextmanager
def reported_progress(*, follow: bool) -> Iterator[Callable[..., None]]:
    """Progress bars as :func:`staged_progress`, or JSON lines for a program that follows.

    With ``follow``, each report is one line of JSON on standard output, and the process ends when
    its standard input is closed, for example because the following program has died.
    """
    if not follow:
        with staged_progress() as report:
            yield report
        return
    threading.Thread(target=_end_with_input, daemon=True).start()

    def tell(stage: str, done: int, total: int, _text: str | None = None) -> None:
        print(json.dumps({"stage": stage, "done": done, "total": total}), flush=True)

    yield tell


def _end_with_input() -> None:
    while os.read(0, 4096):
        pass
    os._exit(1)


def print_figures(title: str, figures: Mapping[str, Any]) -> None:
    """A two-column table of figures; nested mappings get separate rows."""
    table = Table(title=title, show_header=False, title_justify="left")
    for name, figure in _flat(figures):
        text = f"{figure:.4g}" if isinstance(figure, float) else str(figure)
        table.add_row(escape(name), escape(text))
    console.print(table)


def _flat(figures: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in figures.items():
        if isinstance(value, Mapping):
            yield from ((f"{name} {part}", figure) for part, figure in _flat(value))
        else:
            yield name, value


def write_json(path: Path | None, figures: Mapping[str, Any]) -> None:
    """Write figures to ``path`` atomically; nothing if it is None.

    Numbers and arrays may be NumPy's.
    """
    if path is None:
        return
    from ._files import atomic_file

    with atomic_file(path) as file:
        file.write((json.dumps(figures, indent=2, default=_plain) + "\n").encode())


def _plain(value: Any) -> Any:
    if not hasattr(value, "tolist"):
        raise TypeError(f"a {type(value).__name__} cannot be written as JSON")
    return value.tolist()


def refuse_existing(path: Path, *, overwrite: bool) -> None:
    """Raise when ``path`` exists and may not be replaced."""
    if path.exists() and not overwrite:
        raise CommandError(
            f"{path} exists already; give another --out, or --overwrite to replace it"
        )
