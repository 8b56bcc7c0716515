"""Options that several commands share, and the choice of renderer and device."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..console import CommandError

if TYPE_CHECKING:
    from ..logs import LogSelection


JsonFile = Annotated[
    Path | None, typer.Option("--json", help="Also write the figures to this file.", dir_okay=False)
]
SceneBundle = Annotated[Path, typer.Argument(help="Scene bundle.")]
LogFolder = Annotated[Path, typer.Argument(help="Folder of a driving log.")]
LogFormat = Annotated[str | None, typer.Option("--format", help="Default: recognised.")]
Sequence = Annotated[str | None, typer.Option(help="Where a dataset holds several.")]
LogFrames = Annotated[
    str, typer.Option(help="Stretch of the log, first:stop such as 50:100, stop not included.")
]
LogCameras = Annotated[
    str | None, typer.Option(help="Of the log, such as front,front_left; default: all.")
]
LogEvery = Annotated[int, typer.Option(min=1, help="Of the log's frames, each so many-th.")]
Follow = Annotated[
    bool,
    typer.Option(
        "--follow",
        help="For programs: progress as lines of JSON on standard output, and an end with the end "
        "of standard input.",
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")]
RenderBackend = Annotated[str, typer.Option(help="auto, cpu, cuda or reference")]
RenderDevice = Annotated[
    str | None, typer.Option(help="cpu, cuda, cuda:1 ...; default: that of the backend.")
]


def log_selection(frames: str, cameras: str | None, every: int) -> LogSelection:
    """Of ``--frames``, ``--cameras`` and ``--every``. Raises CommandError."""
    from ..logs import LogSelection

    first, colon, stop = frames.partition(":")
    numbers = [part.strip() for part in (first, stop)]
    if not colon or not all(part.isdecimal() or not part for part in numbers):
        raise CommandError(
            f"--frames {frames!r}; allowed is a stretch first:stop such as 50:100, 50: or :100"
        )
    names = None if cameras is None else tuple(name.strip() for name in cameras.split(","))
    return LogSelection(int(numbers[0] or 0), int(numbers[1]) if numbers[1] else None, every, names)


# --- Renderer and device -------------------------------------------------------------------------

ON_CPU = ("auto", "cpu", "reference")
ON_CUDA = ("auto", "cuda", "nvrtc")


def chosen_backend(backend: str, device: str | None) -> str:
    """The backend that ``--backend`` and ``--device`` ask for; before CUDA is used.

    A device with a number becomes the only one that this process sees, so that every library in it
    works on the same one.

    Args:
        backend: ``auto``, ``cpu``, ``cuda``, ``nvrtc`` or ``reference``.
        device: ``cpu``, ``cuda``, ``cuda:1`` ...; None takes the backend's own.

    Raises:
        CommandError: the device is none, or not one of the backend.
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
    """The device ``number`` of those that this process was given."""
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    if given is None:
        return str(number)
    names = [name.strip() for name in given.split(",") if name.strip()]
    if number >= len(names):
        raise CommandError(
            f"--device {device}, but CUDA_VISIBLE_DEVICES={given!r} shows {len(names)} of them"
        )
    return names[number]
