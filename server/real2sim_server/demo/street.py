"""The street of the demo: shipped trained, or built from a synthetic drive.

``python -m real2sim_server.demo.street FILE`` records and trains it again, in about a quarter of an
hour on two cores.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

from ..console import staged_progress
from ..scene.io import SHIPPED_STREET, load_scene, read_packed, save_scene, write_packed

SHIPPED = SHIPPED_STREET
DURATION_S = 10.4
"""Duration of the shipped drive [s]: 100 steps of 0.1 s and a small margin."""
TRAINING_HZ, UNTRAINED_HZ = 5.0, 2.0
MAX_BACKGROUND, MAX_OBJECT = 250_000, 12_000
"""Maximum numbers of Gaussians, a third of the defaults: enough for images of this size, and fast
to render."""


def unpack_street(scenes: Path, name: str) -> None:
    """Write the shipped street as the bundle ``name`` in the folder ``scenes``."""
    save_scene(read_packed(SHIPPED_STREET), scenes / name)


def record_street(log: Path, *, duration_s: float, hz: float) -> None:
    """Write a synthetic drive of the demo's street to the folder ``log``."""
    from ..synthetic import SyntheticConfig, synthesize

    config = SyntheticConfig(frames=int(duration_s * hz) + 2, hz=hz, width=480, height=320)
    with staged_progress() as report:
        synthesize(config, log, on_progress=lambda done, total: report("record", done, total))


def build_street(log: Path, scenes: Path, name: str) -> None:
    """Build the bundle ``name`` from the log without training."""
    from ..reconstruct import InitialiseOptions, ReconstructOptions, reconstruct

    small = InitialiseOptions(max_background=MAX_BACKGROUND, max_object=MAX_OBJECT)
    with staged_progress() as report:
        reconstruct(log, scenes / name, ReconstructOptions(initialise=small), on_progress=report)


def train_street(out: Path) -> None:
    """Record and train the street, and pack it into the file ``out``."""
    from ..reconstruct import ReconstructOptions, reconstruct
    from ..reconstruct.training.schedule import preset

    folder = Path(tempfile.mkdtemp(prefix="real2sim-street-"))
    try:
        record_street(folder / "log", duration_s=DURATION_S, hz=TRAINING_HZ)
        options = ReconstructOptions(training=preset("cpu-small"))
        with staged_progress() as report:
            reconstruct(
                folder / "log",
                folder / "demo_street",
                options,
                on_progress=report,
            )
        write_packed(load_scene(folder / "demo_street"), out)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    train_street(Path(sys.argv[1]))
