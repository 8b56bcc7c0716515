"""The folder of a bundle: scene.json and hashed safetensors files, with a format version."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Container, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar, get_args

import torch
from pydantic import ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file
from torch import Tensor

from ..._files import atomic_folder
from ..cloud import GaussianCloud
from ..errors import BundleError
from ..figure import Figure
from ..lidar_surfaces import Reflector
from .document import UNCERTAINTIES, AssetDocument, SceneDocument

# Tensor files.


def cloud_tensors(cloud: GaussianCloud) -> dict[str, Tensor]:
    """Tensors of a cloud by field name, on the CPU and contiguous."""
    return {name: tensor.detach().cpu().contiguous() for name, tensor in cloud.tensors().items()}


def cloud_shapes(
    gaussians: int, sh_degree: int, *, known: Container[str] = ()
) -> dict[str, tuple[int, ...]]:
    """Shapes of a cloud's tensors by field name; with uncertainties only if ``known``."""
    n = gaussians
    shapes: dict[str, tuple[int, ...]] = {
        "means": (n, 3),
        "quats": (n, 4),
        "scales": (n, 3),
        "opacities": (n,),
        "sh": (n, (sh_degree + 1) ** 2, 3),
    }
    if UNCERTAINTIES in known:
        shapes[UNCERTAINTIES] = (n,)
    return shapes


def figure_tensors(figure: Figure) -> dict[str, Tensor]:
    """Tensors of a figure by field name, contiguous."""
    return {"joints": figure.joints.contiguous(), "weights": figure.weights.contiguous()}


def figure_shapes(gaussians: int) -> dict[str, tuple[int, ...]]:
    """Shapes of :func:`figure_tensors`."""
    return {"joints": (gaussians, 4), "weights": (gaussians, 4)}


def reflector_tensors(reflector: Reflector) -> dict[str, Tensor]:
    """Tensors of a reflector by name, on the CPU and contiguous, without colours."""
    tensors = cloud_tensors(reflector.cloud)
    del tensors["sh"]
    return tensors | {"attributes": reflector.attributes.detach().cpu().contiguous()}


def reflector_shapes(gaussians: int, known: Container[str]) -> dict[str, tuple[int, ...]]:
    """Shapes of :func:`reflector_tensors` with the names ``known``."""
    shapes = cloud_shapes(gaussians, 0, known=known)
    del shapes["sh"]
    return shapes | {"attributes": (gaussians, 2)}


def tensor_hash(tensor: Tensor) -> str:
    """SHA-256 of the bytes of a contiguous CPU tensor, little-endian, row-major."""
    return hashlib.sha256(tensor.numpy().data).hexdigest()


def tensor_hashes(tensors: Mapping[str, Tensor]) -> dict[str, str]:
    """:func:`tensor_hash` of each tensor."""
    return {name: tensor_hash(tensor) for name, tensor in tensors.items()}


def write_tensors(tensors: Mapping[str, Tensor], path: Path) -> int:
    """Write a new safetensors file; returns its size in bytes."""
    save_file({name: tensor.numpy() for name, tensor in tensors.items()}, path)
    # The library makes the file readable only by its owner; a service often runs as another user.
    path.chmod(path.parent.stat().st_mode & 0o666)
    return path.stat().st_size


class TensorFile:
    """A safetensors file of a bundle, memory-mapped.

    Args:
        path: the file.
        nbytes: expected length of the file.
        verify: compare the hash of every tensor that is read.

    Raises:
        BundleError: the file is missing, a link, of another length, or not a safetensors file.
    """

    def __init__(self, path: Path, *, nbytes: int, verify: bool) -> None:
        self.path = path
        self.verify = verify
        check_file(path, nbytes)
        try:
            with safe_open(path, framework="pt", device="cpu") as file:
                keys = file.keys()
                self._tensors: dict[str, Tensor] = {key: file.get_tensor(key) for key in keys}
        except (SafetensorError, OSError) as error:
            raise BundleError(f"{path}: no readable safetensors file: {error}") from error

    def take(
        self,
        prefix: str,
        *,
        shapes: Mapping[str, tuple[int, ...]],
        hashes: Mapping[str, str],
        dtypes: Mapping[str, torch.dtype] = MappingProxyType({}),
    ) -> dict[str, Tensor]:
        """The tensors stored under ``prefix`` + name for each name in ``shapes``; float32 unless
        ``dtypes`` names another type.

        Raises:
            BundleError: a tensor is missing, has a wrong shape or type or, with verification, a
                hash that differs from ``hashes``.
        """
        if set(hashes) != set(shapes):
            raise BundleError(
                f"{self.path}: scene.json gives hashes of {sorted(hashes)}, not of {list(shapes)}"
            )
        return {
            name: self._one(prefix + name, shape, dtypes.get(name, torch.float32), hashes[name])
            for name, shape in shapes.items()
        }

    def _one(self, key: str, shape: tuple[int, ...], dtype: torch.dtype, expected: str) -> Tensor:
        tensor = self._tensors.get(key)
        if tensor is None:
            raise BundleError(f"{self.path}: has no tensor {key!r}")
        if tuple(tensor.shape) != shape or tensor.dtype != dtype:
            raise BundleError(
                f"{self.path}: tensor {key!r} is {tensor.dtype} {list(tensor.shape)}, "
                f"scene.json requires {dtype} {list(shape)}"
            )
        if self.verify and tensor_hash(tensor) != expected:
            raise BundleError(
                f"{self.path}: tensor {key!r} does not have the SHA-256 that scene.json gives; "
                "the bundle was changed or damaged, copy or save it again"
            )
        return tensor


def check_file(path: Path, nbytes: int) -> None:
    """Raise BundleError unless ``path`` is a plain file of ``nbytes`` bytes."""
    if path.is_symlink() or not path.is_file():
        raise BundleError(f"{path}: missing or no plain file; the bundle is incomplete")
    actual = path.stat().st_size
    if actual != nbytes:
        raise BundleError(
            f"{path}: has {actual} bytes where scene.json says {nbytes}; "
            "the bundle is cut short or damaged, copy or save it again"
        )


FORMAT = "real2sim-scene"
VERSION = 1
DOCUMENT_NAME = "scene.json"


DocumentT = TypeVar("DocumentT", SceneDocument, AssetDocument)


def write_container(
    document: DocumentT,
    path: Path,
    *,
    tensors: Mapping[str, Mapping[str, Tensor]],
    overwrite: bool,
) -> DocumentT:
    """Write a bundle to ``path`` atomically; return the document as written.

    Args:
        document: its ``format``, ``version``, ``content_hash`` and ``files`` are filled in here.
        path: the folder.
        tensors: by file name and key.
        overwrite: replace an existing bundle.

    Raises:
        BundleError: ``path`` exists and may not be replaced.
        OSError: the folder cannot be written.
    """
    path = path.absolute()
    _refuse_to_replace(path, overwrite=overwrite)
    content = document.content.model_dump(mode="json")
    with atomic_folder(path) as folder:
        document = document.model_copy(
            update={
                "format": FORMAT,
                "version": VERSION,
                "content_hash": content_hash(document.kind, content),
                "files": {name: write_tensors(t, folder / name) for name, t in tensors.items()},
            }
        )
        text = json.dumps(document.model_dump(mode="json"), allow_nan=False)
        (folder / DOCUMENT_NAME).write_text(text + "\n", encoding="ascii")
    return document


def read_container(path: Path, model: type[DocumentT], *, verify: bool) -> DocumentT:
    """The document of the bundle at ``path``; with ``verify`` its hash is compared.

    Raises:
        BundleError: not a bundle, another version, another kind, or not a valid document.
    """
    file = path / DOCUMENT_NAME
    given = _load_json(path, file)
    _check_head(given, file, get_args(model.model_fields["kind"].annotation)[0])
    try:
        document = model.model_validate(given)
    except ValidationError as error:
        raise BundleError(f"{file}: {_first_problem(error)}") from error
    if verify and content_hash(document.kind, given["content"]) != document.content_hash:
        raise BundleError(
            f"{file}: its content does not have the SHA-256 it gives; "
            "the bundle was changed or damaged, copy or save it again"
        )
    return document


def content_hash(kind: str, content: Mapping[str, Any]) -> str:
    """SHA-256 over kind and content as canonical JSON; content holds the hashes of all tensors.

    Canonical: keys sorted, no spaces, ASCII, floats as the shortest text that reads back exactly.
    Name, provenance and folder are excluded: they do not affect the simulation.
    """
    canonical = json.dumps(
        {"kind": kind, "content": content}, sort_keys=True, separators=(",", ":"), allow_nan=False
    )
    return hashlib.sha256(canonical.encode("ascii")).hexdigest()


def _refuse_to_replace(path: Path, *, overwrite: bool) -> None:
    if not path.exists() and not path.is_symlink():
        return
    if not path.is_dir() or path.is_symlink():
        raise BundleError(f"{path}: is not a folder; a bundle is a folder, choose another path")
    if not any(path.iterdir()):
        return
    if not (path / DOCUMENT_NAME).is_file():
        raise BundleError(
            f"{path}: is a folder with other files, which is never replaced; choose another path"
        )
    if not overwrite:
        raise BundleError(f"{path}: exists; pass overwrite=True or choose another path")


def _load_json(path: Path, file: Path) -> Any:
    if not path.is_dir():
        raise BundleError(f"{path}: no such folder; a bundle is a folder with {DOCUMENT_NAME}")
    try:
        return json.loads(file.read_bytes(), parse_constant=_refuse_constant)
    except FileNotFoundError:
        raise BundleError(f"{path}: no bundle, it has no {DOCUMENT_NAME}") from None
    except OSError as error:
        raise BundleError(f"{file}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise BundleError(f"{file}: no valid JSON, cut short or damaged: {error}") from error


def _refuse_constant(constant: str) -> float:
    raise ValueError(f"{constant} is not a number")


def _check_head(given: Any, file: Path, kind: str) -> None:
    """Check format, version and kind before anything else, which may differ between versions."""
    if not isinstance(given, dict) or given.get("format") != FORMAT:
        raise BundleError(f"{file}: not of format {FORMAT!r}")
    version = given.get("version")
    if type(version) is not int or version != VERSION:
        raise BundleError(
            f"{file}: version {version!r} of {FORMAT}; this program reads version {VERSION}. "
            "Update real2sim, or make the bundle again from its log"
        )
    if given.get("kind") != kind:
        raise BundleError(f"{file}: holds a bundle of kind {given.get('kind')!r}, not {kind!r}")


def _first_problem(error: ValidationError) -> str:
    problem = error.errors(include_url=False, include_input=False)[0]
    place = ".".join(str(part) for part in problem["loc"])
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    return f"{place}: {problem['msg']}{more}"
