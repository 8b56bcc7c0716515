"""Reading checkpoint files without trusting them, and what all importers fraction."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from torch import Tensor

from ...geometry.transform import Float
from ...scene import GaussianCloud, Scene
from ...scene.cloud import SH_DEGREES, rotate_sh
from ...scene.errors import SceneError
from ...scene.io.splat_format import build_cloud
from ..options import ReconstructError
from .torch_file import TorchFileError, read_torch_file


class CheckpointError(ReconstructError):
    """A checkpoint or its dataset folder that cannot be imported; names the file and the reason."""


@dataclass(frozen=True)
class CheckpointOptions:
    """What a checkpoint was trained on, as its configuration says.

    Attributes:
        dataset: preprocessed dataset folder it was trained on. Street Gaussians needs it: its
            checkpoints hold corrections of tracks, not tracks. For drivestudio it gives cameras
            and the path of the ego, which else stands still.
        first_frame, last_frame: frames it was trained on, both inclusive (``selected_frames`` of
            Street Gaussians; ``start_timestep`` of drivestudio is the first). The last one
            defaults to the end.
        cameras: cameras it was trained on. Default: 0, 1, 2 for Street Gaussians, as there;
            those the folder has for drivestudio.
        tracker: whether Street Gaussians took its tracks from a tracker (``use_tracker``).
        fourier_scale: of Street Gaussians' time-varying colours.
        frame_rate: of a drivestudio log [Hz]; its checkpoints know no times.
        world: of a drivestudio checkpoint: axes of its world. ``vehicle`` (x forward, z up) for
            Waymo, Argoverse and KITTI, ``front_camera`` (x right, y down) for nuScenes.
        name: of the scene; default: that of the dataset folder, else of the file.
    """

    dataset: Path | None = None
    first_frame: int = 0
    last_frame: int | None = None
    cameras: tuple[int, ...] | None = None
    tracker: bool = False
    fourier_scale: float = 1.0
    frame_rate: float = 10.0
    world: Literal["vehicle", "front_camera"] = "vehicle"
    name: str | None = None

    def __post_init__(self) -> None:
        last = self.first_frame if self.last_frame is None else self.last_frame
        if not 0 <= self.first_frame <= last:
            raise CheckpointError(
                f"frames {self.first_frame} to {self.last_frame}: the first must be 0 or more and "
                "not after the last"
            )
        if self.cameras is not None and not self.cameras:
            raise CheckpointError("cameras is empty; name at least one, or leave it out")
        if not (np.isfinite(self.frame_rate) and self.frame_rate > 0):
            raise CheckpointError(f"frame_rate must be positive, not {self.frame_rate!r}")
        if self.world not in ("vehicle", "front_camera"):
            raise CheckpointError(f"world {self.world!r}; allowed are 'vehicle' and 'front_camera'")


@dataclass(frozen=True, eq=False)
class ImportedScene:
    """A scene, and what of the checkpoint is not in it.

    Attributes:
        scene: ready to be saved and rendered.
        warnings: what was left out or is only approximately the same, one sentence each.
    """

    scene: Scene
    warnings: tuple[str, ...]


def load_checkpoint(path: Path) -> dict[str, Any]:
    """The tensors and numbers of a ``torch.save`` file, on the CPU.

    Only tensors, containers, numbers and NumPy scalars are built; any other object in the file is
    refused, since reading it would run code from the file. It is read in a process of its own, see
    :mod:`.torch_file`.

    Raises:
        CheckpointError: not there, no checkpoint, damaged, or with other objects inside.
    """
    try:
        state = read_torch_file(path)
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error.strerror or error}") from error
    except TorchFileError as error:
        raise CheckpointError(f"{path}: {error}") from error
    if not isinstance(state, dict):
        raise CheckpointError(f"{path}: holds a {type(state).__name__}, a checkpoint is a dict")
    return state


def table(path: Path, state: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """The table under ``key``. Raises CheckpointError where it is missing or none."""
    value = state.get(key)
    if not isinstance(value, Mapping):
        found = ", ".join(sorted(map(str, state))[:12]) or "nothing"
        what = "is missing" if value is None else f"is a {type(value).__name__}, not a table"
        raise CheckpointError(f"{path}: {key!r} {what}; found: {found}")
    return value


def array(
    path: Path, what: str, part: Mapping[str, Any], key: str, shape: tuple[int | None, ...]
) -> Float:
    """A tensor of ``part`` as float64.

    Args:
        path, what: for messages.
        part: table that holds it.
        key: its name.
        shape: expected shape, None where anything goes.

    Raises:
        CheckpointError: missing, no tensor, of another shape, or with NaN or infinite values.
    """
    value = part.get(key)
    if not isinstance(value, Tensor):
        found = "is missing" if value is None else f"is a {type(value).__name__}, not a tensor"
        raise CheckpointError(f"{path}: {what}: {key!r} {found}")
    wanted = [("any" if n is None else n) for n in shape]
    fits = value.ndim == len(shape) and all(
        n is None or n == m for n, m in zip(shape, value.shape, strict=True)
    )
    if not fits:
        raise CheckpointError(f"{path}: {what}: {key!r} is {list(value.shape)}, not {wanted}")
    values: Float = value.detach().cpu().double().numpy()
    bad = int((~np.isfinite(values)).sum())
    if bad:
        raise CheckpointError(
            f"{path}: {what}: {bad} of {values.size} values of {key!r} are NaN or infinite"
        )
    return values


def cloud_of(
    path: Path,
    *,
    means: Float,
    quats: Float,
    log_scales: Float,
    logits: Float,
    sh: Float,
) -> GaussianCloud:
    """Gaussians of parameters before activation; logits [N, 1], sh [N, K, 3].

    The importers give the harmonics as they are in the file, in world directions.

    Raises:
        CheckpointError: rotations of length zero, values beyond float32, or a number of
            harmonics that is of no degree.
    """
    if sh.shape[1] not in SH_DEGREES:
        raise CheckpointError(
            f"{path}: {sh.shape[1]} harmonics; allowed are {', '.join(map(str, SH_DEGREES))}"
        )
    try:
        return build_cloud(
            path,
            means=means,
            quats=quats,
            log_scales=log_scales,
            opacities=1 / (1 + np.exp(-np.clip(logits[:, 0], -80, 80))),
            sh=sh,
        )
    except SceneError as error:
        raise CheckpointError(str(error)) from error


DIRECTIONS_WARNING = (
    "colours of objects depend on world directions in this checkpoint; they were tied to the "
    "objects at the middle of their lives, so those that turn look slightly different"
)


def tied_to_object(cloud: GaussianCloud, R_world_object: Float) -> GaussianCloud:
    """The same Gaussians with harmonics of world directions turned to the object's own.

    Both give the same colours while the object stands at ``R_world_object`` [3, 3].
    """
    return replace(cloud, sh=rotate_sh(cloud.sh, R_world_object.T))


def file_hash(path: Path) -> str:
    """SHA-256 of a file, for provenance."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
