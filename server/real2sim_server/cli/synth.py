"""``real2sim synth``: write a synthetic driving log."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

from ..console import CommandError, console, print_figures, progress, refuse_existing, write_json
from ..logs.open import open_log
from ..synthetic import SyntheticConfig, synthesize


def run(
    *,
    out: Path,
    sizes: Mapping[str, int],
    cars: Mapping[str, int],
    json_path: Path | None,
) -> None:
    """Generate the log that ``sizes`` and ``cars`` (fields of SyntheticConfig) describe."""
    refuse_existing(out, overwrite=False)
    try:
        config = SyntheticConfig(**sizes, **cars)
    except ValueError as error:
        raise CommandError(str(error)) from error
    start = time.perf_counter()
    with progress("casting rays") as report:
        synthesize(config, out, on_progress=report)
    log = open_log(out)
    figures = {
        "log": str(out),
        "frames": log.frame_count,
        "cameras": len(log.rig),
        "tracks": len(log.tracks),
        "seconds": time.perf_counter() - start,
    }
    print_figures("synthetic log", figures)
    console.print(f"next: real2sim reconstruct {out} --out out/scenes/{out.name}")
    write_json(json_path, figures)
