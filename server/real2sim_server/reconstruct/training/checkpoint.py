"""State of a training run on disk, exact to the last bit."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from ..._files import atomic_folder
from ..options import ReconstructError

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
"""Version 3 is the same under other names."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Everything that a run needs to go on as if it had never stopped.

    Attributes:
        iteration: steps done.
        counts: Gaussians of the background and of each object.
        prior_counts: likewise of the priors; empty as long as there are none.
        optimizer_steps: of the optimiser.
        options: of training, JSON values.
        log_name: of the log it learns from.
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
    """Write ``checkpoint``; ``folder`` is replaced whole or not at all.

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
    """What :func:`write_checkpoint` wrote.

    Raises:
        ReconstructError: nothing there, damaged, or of another version.
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
    """JSON values of version 3 under the names of VERSION."""
    if not isinstance(values, dict):
        return values
    renamed = {KEYS_OF_VERSION_3.get(key, key): _upgraded(v) for key, v in values.items()}
    return renamed | ({"version": VERSION} if "version" in renamed else {})


def _with_tilts(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Roll and pitch of boxes that were upright, where a run of a release before had none."""
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
