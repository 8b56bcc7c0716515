"""Run fuzz targets in separate processes, and fail on their findings."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent
REPOSITORY = FOLDER.parents[1]
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


def check_target(name: str, config, *, drive: Path | None = None, inputs: int = 2000) -> None:
    """Give a reader ``inputs`` damaged inputs, or ``REAL2SIM_FUZZ_INPUTS`` if set."""
    corpus = corpus_folder(config)
    options = ["--drive", drive] if drive is not None else []
    _check(_run("run_target.py", name, "--corpus", corpus, *options, inputs=_inputs(inputs)))


def corpus_folder(config) -> Path:
    """Folder for inputs of interest, kept between runs."""
    if given := os.environ.get("REAL2SIM_FUZZ_CORPUS"):
        return Path(given)
    cache = getattr(config, "cache", None)  # None with ``-p no:cacheprovider``.
    folder = Path(cache.mkdir("fuzz")) if cache is not None else REPOSITORY / "out/fuzz"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def check_service(*names: str, inputs: int) -> None:
    """Attack a worker with ``inputs`` damaged inputs for each named target."""
    for report in _run("run_service.py", *names, inputs=inputs):
        _check(report)
        assert report["steps_beside"] > 0


def _inputs(usual: int) -> int:
    return int(os.environ.get("REAL2SIM_FUZZ_INPUTS", usual))


def _run(script: str, *words: object, inputs: int) -> Any:
    command = [sys.executable, FOLDER / script, *words, "--inputs", inputs]
    command += ["--seed", os.environ.get("REAL2SIM_FUZZ_SEED", "0")]
    paths = os.pathsep.join(path for path in sys.path if path)
    done = subprocess.run(
        [str(word) for word in command],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **ONE_THREAD, "PYTHONPATH": paths},
    )
    assert done.returncode == 0, f"{words} ended by {done.returncode}: {done.stderr[-3000:]}"
    return json.loads(done.stdout.splitlines()[-1])


def _check(report: dict[str, Any]) -> None:
    print(json.dumps(report))
    assert not report["failures"], json.dumps(report["failures"], indent=1)
    assert report["inputs"] > 0
