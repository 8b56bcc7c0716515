"""``real2sim reconstruct``: from a driving log to a scene."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from ..console import console, print_figures, refuse_existing, staged_progress, write_json
from ..reconstruct import reconstruct
from ..reconstruct.training.schedule import preset as training_preset


@dataclass(frozen=True)
class Training:
    """How to train.

    Attributes:
        preset: its name.
        resume: whether a run that was broken off goes on.
        width: of the training images [px]; by the preset where None.
        box_noise: scatter added to boxes, a share of their size.
    """

    preset: str
    resume: bool
    width: int | None = None
    box_noise: float = 0.0


def run(
    *,
    log: Path,
    out: Path,
    iterations: int,
    training: Training,
    log_format: str | None,
    sequence: str | None,
    overwrite: bool,
    json_path: Path | None,
) -> None:
    """Reconstruct the log in folder ``log`` into the bundle ``out``."""
    refuse_existing(out, overwrite=overwrite)
    options = training_preset(training.preset)
    if training.width is not None:
        options = replace(options, width=training.width, max_width=training.width)
    with _told() as told:
        result = reconstruct(
            log,
            out,
            iterations=iterations,
            training=options if iterations else None,
            resume=training.resume,
            box_noise=training.box_noise,
            log_format=log_format,
            sequence=sequence,
            overwrite=overwrite,
            **told,
        )
    figures = asdict(result)
    print_figures(f"scene {out}", {k: v for k, v in figures.items() if v is not None})
    console.print(f"next: real2sim render {out} --log {log} -o {out.name}.png")
    write_json(json_path, figures)


@contextmanager
def _told() -> Iterator[dict[str, Any]]:
    """Progress bars for the stages, and the figures of training in the bar of that stage."""
    with staged_progress() as report:

        def on_training(news: Any) -> None:
            stage = (
                f"training {news.rate:.1f}/s, loss {news.loss:.4f}, {news.psnr:.2f} dB, "
                f"{news.gaussians:,} Gaussians"
            )
            report("training", news.iteration, news.iterations, stage)

        yield {"on_progress": report, "on_training": on_training}
