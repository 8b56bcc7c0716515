"""Checkpoint and dataset files, read without trusting them, and helpers shared by all importers."""

from __future__ import annotations

import hashlib
import json
import pickle
import struct
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import simplejpeg
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from torch import Tensor

from ..._confined import Limits, run_confined
from ..._files import read_text
from ...geometry import Float, is_rigid
from ...scene import GaussianCloud, Scene, Sky
from ...scene.cloud import SH_DEGREES, rotate_sh
from ...scene.errors import SceneError
from ...scene.io.splat_format import build_cloud
from ...scene.scene import face_directions
from ..options import ReconstructError

# --- Files of torch.save --------------------------------------------------------------------------

# ``torch.load(weights_only=True)`` builds few types, but it still interprets a pickle and the
# strides in the file. It runs in a confined process, which returns a safetensors file and JSON.

GIB = 1024**3
SECONDS = 600.0
MAX_DEPTH = 64
TENSOR_FILE = "tensors.safetensors"


class TorchFileError(ValueError):
    """Not a torch file, a damaged one, or one with other objects."""


def read_torch_file(path: Path) -> Any:
    """Contents of a ``torch.save`` file: containers of tensors, numbers and strings, on the CPU.

    Raises:
        TorchFileError: not a torch file, damaged, with other objects, or reading it takes more
            memory or time than its size justifies.
            OSError: the file cannot be read.
    """
    size = path.stat().st_size
    with tempfile.TemporaryDirectory(prefix="real2sim-") as folder:
        try:
            tree = run_confined(
                f"{__name__}:unpack_torch_file",
                {"path": str(path.absolute()), "folder": folder},
                limits=Limits(
                    memory_bytes=4 * size + 2 * GIB, seconds=SECONDS, written_bytes=2 * size + GIB
                ),
                errors=(TorchFileError,),
            )
            # Mapped into memory, so that the tensors outlive the file.
            tensors = load_file(Path(folder) / TENSOR_FILE)
            return _built(tree, tensors)
        except TorchFileError:
            raise
        # The other process read an untrusted file, so its output can have any form.
        except Exception as error:
            raise TorchFileError(f"cannot be read: {error}") from error


def unpack_torch_file(path: str, folder: str) -> Any:
    """Write the tensors of a file below ``folder``; return the containers around them as JSON
    values.

    Raises:
        TorchFileError: as :func:`read_torch_file`.
    """
    try:
        with torch.serialization.safe_globals(_numpy_scalars()):
            state = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        found = _unsafe_objects(path)
        if not found:
            raise TorchFileError("no checkpoint of torch, or damaged") from error
        raise TorchFileError(
            f"holds objects besides tensors and numbers ({', '.join(found[:5])}); "
            "reading them would run code from the file. Save it again with tensors only, in the "
            "program it comes from"
        ) from error
    # A damaged file can raise almost any error.
    except Exception as error:
        raise TorchFileError(f"no checkpoint of torch, or damaged: {error}") from error
    tensors: dict[str, Tensor] = {}
    tree = _tree(state, tensors, depth=0)
    save_file(tensors, Path(folder) / TENSOR_FILE)
    return tree


def _tree(value: Any, tensors: dict[str, Tensor], *, depth: int) -> list[Any]:
    """A value as JSON: its kind, then its contents."""
    if depth > MAX_DEPTH:
        raise TorchFileError(f"no checkpoint of torch: its containers are {depth} deep")
    if isinstance(value, Tensor):
        name = str(len(tensors))
        tensors[name] = value.detach().to_dense().resolve_conj().resolve_neg().contiguous().clone()
        return ["tensor", name]
    if isinstance(value, dict):
        pairs = [[_tree(part, tensors, depth=depth + 1) for part in pair] for pair in value.items()]
        return ["dict", pairs]
    for kind in (list, tuple, set):
        if isinstance(value, kind):
            return [kind.__name__, [_tree(part, tensors, depth=depth + 1) for part in value]]
    if isinstance(value, np.generic):
        value = value.item()
    plain = value is None or isinstance(value, bool | int | float | str)
    return ["value", value if plain else str(value)]


def _built(tree: Any, tensors: dict[str, Tensor]) -> Any:
    kind, content = tree
    match kind:
        case "tensor":
            return tensors[content]
        case "dict":
            return {_built(key, tensors): _built(value, tensors) for key, value in content}
        case "list":
            return [_built(part, tensors) for part in content]
        case "tuple":
            return tuple(_built(part, tensors) for part in content)
        case "set":
            return {_built(part, tensors) for part in content}
        case _:
            return content


def _numpy_scalars() -> list[Any]:
    """Types behind the numbers in intermediate checkpoints; harmless to build."""
    scalar = np._core.multiarray.scalar  # type: ignore[attr-defined]
    numbers = [np.dtype, *(type(np.dtype(kind)) for kind in ("f8", "f4", "i8", "i4", "?"))]
    old_name = (scalar, "numpy.core.multiarray.scalar")
    return [scalar, old_name, *numbers]


def _unsafe_objects(path: str) -> list[str]:
    try:
        return sorted(torch.serialization.get_unsafe_globals_in_checkpoint(path))
    except Exception:  # the file may have an old format, or not be a checkpoint at all
        return []


# --- Shared helpers -------------------------------------------------------------------------------


class CheckpointError(ReconstructError):
    """A checkpoint or its dataset folder that cannot be imported; names the file and the reason."""


@dataclass(frozen=True)
class CheckpointOptions:
    """Training data of a checkpoint, from its configuration.

    Attributes:
        dataset: preprocessed dataset folder used in training. Required for Street Gaussians,
        whose checkpoints hold only corrections of tracks. For drivestudio it provides the
        cameras and the ego path; without it the ego does not move.
        first_frame, last_frame: training frames, both inclusive (``selected_frames`` of Street
            Gaussians; ``start_timestep`` of drivestudio is the first). The last one defaults to
            the end.
        cameras: training cameras. Default: 0, 1, 2 for Street Gaussians, as in its code; all
            cameras in the folder for drivestudio.
        tracker: whether Street Gaussians used tracks from a tracker (``use_tracker``).
        fourier_scale: scale of Street Gaussians' time-varying colours.
        frame_rate: frame rate of a drivestudio log [Hz]; checkpoints contain no times.
        world: world axes of a drivestudio checkpoint. ``vehicle`` (x forward, z up) for
            Waymo, Argoverse and KITTI, ``front_camera`` (x right, y down) for nuScenes.
        name: name of the scene; by default the dataset folder's, otherwise the file's.
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
    """An imported scene, and the parts of the checkpoint that it lacks.

    Attributes:
        scene: ready to be saved and rendered.
        warnings: dropped or approximated parts, one sentence each.
    """

    scene: Scene
    warnings: tuple[str, ...]


def load_checkpoint(path: Path) -> dict[str, Any]:
    """The tensors and numbers of a ``torch.save`` file, on the CPU.

    Only tensors, containers, numbers and NumPy scalars are built. Any other object in the file is
    rejected, because reading it would execute code from the file. The file is read in a separate
    confined process.

    Raises:
        CheckpointError: missing, not a checkpoint, damaged, or with other objects inside.
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
    """The table under ``key``. Raises CheckpointError if it is missing or not a table."""
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
        path, what: file and name of the tensor, for messages.
        part: table with the tensor.
        key: its name.
        shape: expected shape, None for any size.

    Raises:
        CheckpointError: missing, not a tensor, wrong shape, or with NaN or infinite values.
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
    """Gaussians from parameters before activation; logits [N, 1], sh [N, K, 3].

    The harmonics are passed as stored in the file, in world directions.

    Raises:
        CheckpointError: rotations of length zero, values beyond float32, or a number of harmonics
            that matches no degree.
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
    """The same Gaussians with harmonics rotated from world directions to the object's frame.

    The colours are the same at the object rotation ``R_world_object`` [3, 3].
    """
    return replace(cloud, sh=rotate_sh(cloud.sh, R_world_object.T))


def file_hash(path: Path) -> str:
    """SHA-256 of a file, for provenance."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


# Small files of preprocessed dataset folders: poses, intrinsics, JSON, image sizes.

PNG_MAGIC = b"\x89PNG"


def read_numbers(path: Path) -> Float:
    """All numbers of a text file, in order. Raises CheckpointError naming it."""
    try:
        return np.array(read_text(path).split(), dtype=np.float64)
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise CheckpointError(f"{path}: must hold numbers only: {error}") from error


def read_pose(path: Path) -> Float:
    """A rigid transform [4, 4] of a text file. Raises CheckpointError naming it."""
    numbers = read_numbers(path)
    if numbers.size != 16 or not is_rigid(numbers.reshape(4, 4)):
        raise CheckpointError(f"{path}: must hold a rigid 4x4 transform")
    return numbers.reshape(4, 4)


def read_intrinsics(path: Path) -> Float:
    """Matrix K [3, 3] of a file of fx, fy, cx, cy and distortion; the distortion is ignored."""
    numbers = read_numbers(path)
    if numbers.size < 4:
        raise CheckpointError(f"{path}: must hold fx, fy, cx, cy, not {numbers.size} numbers")
    fx, fy, cx, cy = numbers[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def read_json(path: Path) -> Mapping[str, Any]:
    """A JSON object. Raises CheckpointError naming the file."""
    try:
        value = json.loads(path.read_bytes())
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise CheckpointError(f"{path}: is not JSON: {error}") from error
    if not isinstance(value, dict):
        raise CheckpointError(f"{path}: must hold a JSON object")
    return value


def image_size(folder: Path, camera: int) -> tuple[int, int] | None:
    """Width and height [px] of a camera's images, None without images.

    Raises:
        CheckpointError: for an image that is neither PNG nor JPEG.
    """
    for image in sorted((folder / "images").glob(f"*_{camera}.*"))[:1]:
        data = image.read_bytes()
        if data.startswith(PNG_MAGIC) and len(data) >= 24:
            width, height = struct.unpack_from(">II", data, 16)
            return width, height
        try:
            height, width = simplejpeg.decode_jpeg_header(data)[:2]
        except ValueError as error:
            raise CheckpointError(f"{image}: is neither PNG nor JPEG, or is damaged") from error
        return width, height
    return None


# Cube maps in OpenGL order and orientation (as nvdiffrast samples them), converted to a Sky.


def sky_from_opengl_cube(faces: Float, R_cube_world: Float) -> Sky:
    """The same sky in our face layout, clamped to [0, 1].

    Args:
        faces: [6, R, R, 3] RGB, faces +x -x +y -y +z -z of OpenGL.
        R_cube_world: [3, 3] rotation of world directions to those of the cube. A rotation that
        only exchanges axes moves pixels without interpolation.
    """
    directions = face_directions(faces.shape[1]).astype(np.float64) @ R_cube_world.T
    face, row, column = _nearest_pixel(directions, faces.shape[1])
    moved = np.clip(faces[face, row, column], 0, 1).astype(np.float32)
    return Sky(torch.from_numpy(np.ascontiguousarray(moved)))


def _nearest_pixel(
    directions: Float, resolution: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Face, row and column [...] of an OpenGL cube map along ``directions`` [..., 3].

    OpenGL 4.6 specification, table 8.19: s to the right (columns), t down (rows).
    """
    x, y, z = np.moveaxis(directions, -1, 0)
    axis = np.abs(directions).argmax(axis=-1)
    positive = np.take_along_axis(directions, axis[..., None], axis=-1)[..., 0] > 0
    face = 2 * axis + ~positive
    right = [-z, z, x, x, x, -x]
    down = [-y, -y, z, -z, -y, -y]
    major = np.abs(directions).max(axis=-1)
    column, row = (
        np.clip(
            np.rint((np.choose(face, of) / major + 1) / 2 * resolution - 0.5).astype(np.int64),
            0,
            resolution - 1,
        )
        for of in (right, down)
    )
    return face, row, column
