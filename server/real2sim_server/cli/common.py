"""The Typer app of the server's commands, and the options that several commands share."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from ..console import CommandError, console, progress, run_command

if TYPE_CHECKING:
    from ..logs import DrivingLog, LogSelection
    from ..settings import Settings


Function = TypeVar("Function", bound=Callable[..., None])

app = typer.Typer(no_args_is_help=True)


def command(name: str, *, group: typer.Typer = app) -> Callable[[Function], Function]:
    """Register a function as the command ``name``; its parameters are the command's options.

    On the command line, errors that a user can fix become one sentence and exit code 1. The
    function itself is unchanged and raises them.
    """

    def register(function: Function) -> Function:
        @functools.wraps(function)
        def invoke(**options: Any) -> None:
            run_command(function, **options)

        group.command(name)(invoke)
        return function

    return register


# --- Options --------------------------------------------------------------------------------------

JsonFile = Annotated[
    Path | None,
    typer.Option("--json", help="Also write the results to this JSON file.", dir_okay=False),
]
SceneBundle = Annotated[
    Path, typer.Argument(help="Scene bundle, packed scene (.r2s.zip) or demo_street.")
]
DrivingLogPath = Annotated[
    Path, typer.Argument(help="Driving log: a folder, or a single file (.tfrecord).")
]
LogFormat = Annotated[
    str | None, typer.Option("--format", help="Format of the log; default: detected.")
]
SequenceName = Annotated[
    str | None, typer.Option(help="Sequence of a data set that holds several.")
]
LogFrames = Annotated[
    str, typer.Option(help="Part of the log as FIRST:STOP such as 50:100 (end-exclusive).")
]
LogCameras = Annotated[
    str | None, typer.Option(help="Comma-separated cameras of the log; default: all.")
]
Strict = Annotated[
    bool, typer.Option("--strict", help="Refuse a log of which anything cannot be used.")
]
LogEvery = Annotated[int, typer.Option(min=1, help="Use every Nth frame.")]
PlanLimit = Annotated[
    float,
    typer.Option(min=0.1, max=86_400, help="Maximum time of a planner for each answer [s]."),
]
Follow = Annotated[
    bool,
    typer.Option(
        "--follow",
        help="For programs: print progress as JSON lines; stop when standard input closes.",
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace existing output.")]
RenderBackend = Annotated[str, typer.Option(help="Renderer: auto, cpu, cuda or reference.")]
RenderDevice = Annotated[
    str | None, typer.Option(help="Device: cpu, cuda, cuda:1, ...; default: the renderer's.")
]


def changed_bundle(scene: Path, out: Path | None) -> Path:
    """The bundle that a command writes: ``out``, by default the scene itself.

    Raises:
        CommandError: the scene is not a bundle.
    """
    if out is None and not scene.is_dir():
        raise CommandError(
            f"{scene} is not a bundle that can be changed; name a new one with --out"
        )
    return scene if out is None else out


def read_settings(**given: Any) -> Settings:
    """The settings of the environment, and given ones.

    Raises:
        CommandError: names the invalid setting, without a secret.
    """
    from pydantic import ValidationError

    from real2sim_proto.base import invalid_reason

    from ..settings import Settings

    try:
        return Settings(**given)
    except ValidationError as error:
        first = error.errors()[0]
    name = ".".join(str(part) for part in first["loc"])
    raise CommandError(
        f"setting {name}: {invalid_reason(first)}" if name else invalid_reason(first)
    )


def log_selection(frames: str, cameras: str | None, every: int) -> LogSelection:
    """Frame selection from ``--frames``, ``--cameras`` and ``--every``. Raises CommandError."""
    from ..logs import LogSelection

    first, colon, stop = frames.partition(":")
    numbers = [part.strip() for part in (first, stop)]
    if not colon or not all(part.isdecimal() or not part for part in numbers):
        raise CommandError(
            f"--frames {frames!r}; allowed is a stretch first:stop such as 50:100, 50: or :100"
        )
    names = None if cameras is None else tuple(name.strip() for name in cameras.split(","))
    return LogSelection(int(numbers[0] or 0), int(numbers[1]) if numbers[1] else None, every, names)


def opened_log(
    path: Path,
    log_format: str | None = None,
    sequence: str | None = None,
    *,
    provenance: Mapping[str, Any] | None = None,
) -> DrivingLog:
    """A log without what cannot be used, which is printed.

    Args:
        path: see :func:`~.logs.open_log`.
        log_format: see :func:`~.logs.open_log`.
        sequence: see :func:`~.logs.open_log`.
        provenance: of a scene made from a part of the log, which is selected.

    Raises:
        LogError: see :func:`~.logs.usable_log`.
    """
    from ..logs import open_log, same_part, usable_log

    log = open_log(path, format=log_format, sequence=sequence)
    if provenance is not None:
        log = same_part(log, provenance)
    with progress("checking files") as on_progress:
        log = usable_log(log, on_progress=on_progress)
    print_left_out(log)
    return log


def print_left_out(log: DrivingLog) -> None:
    """Print what of a log is not used."""
    from ..logs.driving_log import left_out_lines

    for line in left_out_lines(log.left_out):
        console.print(f"left out  {line}", highlight=False, markup=False, soft_wrap=True)


# --- Renderer and device -------------------------------------------------------------------------

ON_CPU = ("auto", "cpu", "reference")
ON_CUDA = ("auto", "cuda", "nvrtc")


def chosen_backend(backend: str, device: str | None) -> str:
    """The backend for ``--backend`` and ``--device``. Call it before CUDA is used.

    A device with a number becomes the only one visible to this process, so all libraries use the
    same one.

    Args:
        backend: ``auto``, ``cpu``, ``cuda``, ``nvrtc`` or ``reference``.
        device: ``cpu``, ``cuda``, ``cuda:1`` ...; None uses the default of the backend.

    Raises:
        CommandError: the device does not exist, or does not fit the backend.
    """
    if device is None:
        return backend
    kind, _, number = device.partition(":")
    if kind not in ("cpu", "cuda") or (
        ":" in device and not (kind == "cuda" and number.isdecimal())
    ):
        raise CommandError(f"--device {device!r}; allowed are cpu, cuda, or cuda:1 and so on")
    allowed = ON_CPU if kind == "cpu" else ON_CUDA
    if backend not in allowed:
        raise CommandError(
            f"--backend {backend} does not draw on --device {device}; "
            f"there it is one of {', '.join(allowed)}"
        )
    if number:
        os.environ["CUDA_VISIBLE_DEVICES"] = _visible(int(number), device)
    return kind if backend == "auto" else backend


def _visible(number: int, device: str) -> str:
    """The device ``number`` among the devices visible to this process."""
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    if given is None:
        return str(number)
    names = [name.strip() for name in given.split(",") if name.strip()]
    if number >= len(names):
        raise CommandError(
            f"--device {device}, but CUDA_VISIBLE_DEVICES={given!r} shows {len(names)} of them"
        )
    return names[number]
