"""``real2sim evaluate``: how close a scene comes to its log."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..console import CommandError, console, print_figures, staged_progress, write_json
from ..logs.open import open_log
from ..reconstruct.evaluation import EvaluateOptions, Evaluation, evaluate_scene, write_report
from ..scene.io import load_scene


@dataclass(frozen=True)
class Asked:
    """The options as they were typed.

    Attributes:
        frames: ``held-out``, ``all``, or numbers with commas between them.
        shifts: distances [m] with commas between them, or ``none``.
        width: of the compared images [px].
        backend: of the renderer.
        around: whether to look at vehicles from all sides.
    """

    frames: str = "held-out"
    shifts: str = "1,2,3"
    width: int | None = None
    backend: str = "auto"
    around: bool = False


def run(
    *,
    scene: Path,
    log: Path,
    asked: Asked,
    log_format: str | None,
    sequence: str | None,
    report: Path | None,
    json_path: Path | None,
) -> None:
    """Compare the bundle ``scene`` with the log in folder ``log``; leave figures and a page."""
    options = EvaluateOptions(
        frames=_frames(asked.frames),
        width=asked.width,
        shifts=_shifts(asked.shifts),
        backend=asked.backend,
        around=asked.around,
    )
    loaded, opened = load_scene(scene), open_log(log, format=log_format, sequence=sequence)
    with staged_progress() as tell:
        result = evaluate_scene(loaded, opened, options=options, on_progress=tell)
    print_figures(f"{scene.name} against {opened.name}", _table(result))
    if not result.frames_unseen:
        console.print(
            "the scene names no held-out frames, so these may have been used to make it",
            soft_wrap=True,
        )
    if result.no_shifted:
        console.print(result.no_shifted, soft_wrap=True)
    write_json(json_path, result.as_json())
    if report is not None:
        page = write_report(loaded, opened, result, report, options=options)
        console.print(f"report: {page}", soft_wrap=True)


def _frames(text: str) -> str | tuple[int, ...]:
    if text in ("held-out", "all"):
        return text
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise CommandError(
            f"--frames {text!r}; allowed are held-out, all, or numbers such as 3,7,11"
        ) from None


def _shifts(text: str) -> tuple[float, ...]:
    if text == "none":
        return ()
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise CommandError(
            f"--shifts {text!r}; allowed are none, or distances in metres such as 1,2,3"
        ) from None


def _table(result: Evaluation) -> dict[str, object]:
    figures: dict[str, object] = {
        "frames": ", ".join(map(str, result.frames)),
        "psnr [dB]": result.psnr,
        "ssim": result.ssim,
        "psnr_objects [dB]": result.psnr_objects,
        "depth_error_m [m]": result.depth_error_m,
        "box_error_m [m]": result.box_error_m,
        "frames_per_second": result.frames_per_second,
    }
    for shift in result.shifted:
        figures[f"psnr from {shift.shift_m:g} m beside [dB]"] = shift.psnr
    if result.around is not None:
        figures |= {
            "vehicles' seen sides [dB]": result.around.psnr_seen,
            "vehicles' other sides [dB]": result.around.psnr_unseen,
            "of these covered": result.around.coverage_unseen,
        }
    return figures
