"""Runs a target in a process of its own, and fails with what it found."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).with_name("run_target.py")
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


def check_target(name: str, config, *, drive: Path | None = None, inputs: int = 2000) -> None:
    """Give a reader ``inputs`` damaged inputs, or as many as ``REAL2SIM_FUZZ_INPUTS`` says."""
    given = os.environ.get("REAL2SIM_FUZZ_CORPUS")
    corpus = Path(given) if given else config.cache.mkdir("fuzz")
    command = [sys.executable, SCRIPT, name, "--corpus", corpus]
    command += ["--inputs", os.environ.get("REAL2SIM_FUZZ_INPUTS", str(inputs))]
    command += ["--seed", os.environ.get("REAL2SIM_FUZZ_SEED", "0")]
    command += ["--drive", drive] if drive is not None else []
    paths = os.pathsep.join(path for path in sys.path if path)
    done = subprocess.run(
        [str(word) for word in command],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **ONE_THREAD, "PYTHONPATH": paths},
    )
    assert done.returncode == 0, (
        f"{name} ended by {done.returncode}; see {corpus}: {done.stderr[-3000:]}"
    )
    report = json.loads(done.stdout.splitlines()[-1])
    assert not report["failures"], json.dumps(report, indent=1)
    assert report["inputs"] > 0
