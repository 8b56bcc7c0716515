"""Records of a training run: checkpoints, metrics and progress."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from ..._files import atomic_folder
from ..options import ReconstructError
from .losses import psnr_of

# Checkpoints, bit-exact.

FORMAT = "real2sim-training"
VERSION = 4
STATE_FILE, TENSOR_FILE = "state.json", "state.safetensors"
KEYS_OF_VERSION_3 = {
    "guess_counts": "prior_counts",
    "guess_round": "prior_round",
    "rates": "learning_rates",
    "share": "fraction",
    "buried_share": "occluded_fraction",
    "buried_depth": "occluded_depth",
}
PRIORS_OF_VERSION_3 = "guesses."
"""Prefix of the tensors of priors in checkpoints of version 3."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Complete state of a run. Resuming from it does not change the result.

    Attributes:
        iteration: completed steps.
        counts: Gaussians of the background and of each object.
        prior_counts: the same for priors; empty before they are inserted.
        optimizer_steps: steps of the optimiser.
        options: options of training, JSON values.
        log_name: name of the training log.
        running: smoothed figures for progress.
        tensors: parameters and moments by name.
    """

    iteration: int
    counts: tuple[int, ...]
    prior_counts: tuple[int, ...]
    optimizer_steps: int
    options: dict[str, Any]
    log_name: str
    running: dict[str, float]
    tensors: dict[str, Tensor]


def write_checkpoint(checkpoint: Checkpoint, folder: Path) -> None:
    """Write ``checkpoint`` to ``folder``, which is replaced atomically.

    Raises:
        OSError: it cannot be written.
    """
    state = {k: v for k, v in vars(checkpoint).items() if k != "tensors"}
    state |= {"format": FORMAT, "version": VERSION}
    with atomic_folder(folder) as new:
        tensors = {k: t.detach().cpu().contiguous() for k, t in checkpoint.tensors.items()}
        save_file(tensors, new / TENSOR_FILE)
        (new / STATE_FILE).write_text(json.dumps(state) + "\n", encoding="ascii")


def read_checkpoint(folder: Path) -> Checkpoint:
    """Read a checkpoint of :func:`write_checkpoint`.

    Raises:
        ReconstructError: the checkpoint is missing, damaged, or of another version.
    """
    path = folder / STATE_FILE
    try:
        state = json.loads(path.read_bytes())
        tensors = load_file(folder / TENSOR_FILE)
    except FileNotFoundError as error:
        raise ReconstructError(f"{folder}: no checkpoint of a training run") from error
    except (ValueError, OSError, SafetensorError) as error:
        raise ReconstructError(f"{folder}: damaged checkpoint: {error}") from error
    if state.get("format") == FORMAT and state.get("version") == 3:
        state, tensors = _upgraded(state), {_upgraded_name(k): t for k, t in tensors.items()}
    if state.pop("format", None) != FORMAT or state.pop("version", None) != VERSION:
        raise ReconstructError(
            f"{path}: not a checkpoint of version {VERSION} of {FORMAT}; train from the start"
        )
    for name in ("counts", "prior_counts"):
        state[name] = tuple(state[name])
    return Checkpoint(**state, tensors=_with_tilts(tensors))


def _upgraded(values: Any) -> Any:
    """Rename JSON values of version 3 to the names of VERSION."""
    if not isinstance(values, dict):
        return values
    renamed = {KEYS_OF_VERSION_3.get(key, key): _upgraded(v) for key, v in values.items()}
    return renamed | ({"version": VERSION} if "version" in renamed else {})


def _with_tilts(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Zero roll and pitch, for checkpoints of older releases without them."""
    added = {}
    for name, yaws in tensors.items():
        group, _, key = name.rpartition(".")
        if key == "pose_yaw" and f"{group}.pose_tilt" not in tensors:
            added[f"{group}.pose_tilt"] = yaws.new_zeros(len(yaws), 2)
    return tensors | added


def _upgraded_name(tensor: str) -> str:
    if tensor.startswith(PRIORS_OF_VERSION_3):
        return "priors." + tensor.removeprefix(PRIORS_OF_VERSION_3)
    return tensor


# Metrics, one JSON object per line.


class MetricsFile:
    """Appends whole lines to ``path``, so that other programs can read it at any time.

    Raises:
        OSError: the file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)

    def write(self, figures: Mapping[str, Any]) -> None:
        """Append one line."""
        with self.path.open("a", encoding="ascii") as file:
            file.write(json.dumps(figures) + "\n")

    def read(self) -> list[dict[str, Any]]:
        """All complete lines; a line truncated by a kill is dropped."""
        if not self.path.exists():
            return []
        lines = self.path.read_text(encoding="ascii").split("\n")[:-1]
        return [json.loads(line) for line in lines]

    def cut(self, iteration: int) -> None:
        """Drop lines after ``iteration``; a resumed run writes them again."""
        kept = [line for line in self.read() if line["iteration"] <= iteration]
        temporary = self.path.with_name(f".{self.path.name}.tmp")
        temporary.write_text("".join(json.dumps(line) + "\n" for line in kept), encoding="ascii")
        temporary.replace(self.path)


# Progress and rate.

SMOOTHING = 0.98
"""Fraction of the past in the running loss and PSNR."""


@dataclass(frozen=True)
class TrainingProgress:
    """Progress of a training run.

    Attributes:
        iteration, iterations: completed and total steps.
        rate: recent steps per second.
        loss, psnr: smoothed over training images; PSNR in [dB].
        gaussians: current number.
        eta_s: remaining seconds at this rate.
    """

    iteration: int
    iterations: int
    rate: float
    loss: float
    psnr: float
    gaussians: int
    eta_s: float


OnTraining = Callable[[TrainingProgress], None]


@dataclass
class RunningMeans:
    """Smoothed metrics and time by stage [s]."""

    loss: float = 0.0
    squared: float = 0.0
    weight: float = 0.0
    stages: dict[str, float] = field(default_factory=dict)

    def add(self, loss: float, squared: float) -> None:
        """Add one step."""
        self.loss = SMOOTHING * self.loss + (1 - SMOOTHING) * loss
        self.squared = SMOOTHING * self.squared + (1 - SMOOTHING) * squared
        self.weight = SMOOTHING * self.weight + (1 - SMOOTHING)

    @property
    def mean_loss(self) -> float:
        """Smoothed loss."""
        return self.loss / max(self.weight, 1e-9)

    @property
    def psnr(self) -> float:
        """PSNR of the smoothed squared error [dB]."""
        return psnr_of(self.squared / max(self.weight, 1e-9))


class RateMeter:
    """Steps per second since the last call."""

    def __init__(self, iteration: int) -> None:
        self._iteration, self._time = iteration, time.perf_counter()

    def rate(self, iteration: int) -> float:
        """Recent steps per second, up to ``iteration``."""
        now = time.perf_counter()
        rate = max(iteration - self._iteration, 1) / max(now - self._time, 1e-6)
        self._iteration, self._time = iteration, now
        return rate


class StepTimer:
    """Adds the seconds of a block to a stage."""

    def __init__(self, stages: dict[str, float]) -> None:
        self._stages = stages

    def __call__(self, name: str) -> StepTimer:
        """Context manager that adds the time of its block to ``name``."""
        self._name = name
        return self

    def __enter__(self) -> None:
        self._start = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        spent = time.perf_counter() - self._start
        self._stages[self._name] = self._stages.get(self._name, 0.0) + spent
