"""Which renderer a command draws with, and on which device."""

from __future__ import annotations

import os

from ..console import CommandError

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
