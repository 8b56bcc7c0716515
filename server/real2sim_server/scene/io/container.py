"""The folder that a bundle is: scene.json and tensor files, versioned and hashed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import ValidationError
from torch import Tensor

from ..._files import atomic_folder
from ..errors import BundleError
from .document import AssetDocument, SceneDocument
from .tensors import write_tensors

FORMAT = "real2sim-scene"
VERSION = 7
"""Newest version read here; what needs no more is written in version 1."""
DOCUMENT_NAME = "scene.json"


DocumentT = TypeVar("DocumentT", SceneDocument, AssetDocument)


def write_container(
    document: DocumentT,
    path: Path,
    *,
    tensors: Mapping[str, Mapping[str, Tensor]],
    overwrite: bool,
) -> DocumentT:
    """Write a bundle to ``path``, whole or not at all; the document as written.

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
                "version": document.content.version,
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
        BundleError: no bundle, a newer version, another kind, or not as the format asks.
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
    Name, provenance and folder do not count: they change nothing of what is simulated.
    """
    canonical = json.dumps(
        {"kind": kind, "content": content}, sort_keys=True, separators=(",", ":"), allow_nan=False
    )
    return hashlib.sha256(canonical.encode("ascii")).hexdigest()


def _refuse_to_replace(path: Path, *, overwrite: bool) -> None:
    if not path.exists() and not path.is_symlink():
        return
    if not path.is_dir() or path.is_symlink():
        raise BundleError(f"{path}: is no folder; a bundle is a folder, choose another path")
    if not any(path.iterdir()):
        return
    if not (path / DOCUMENT_NAME).is_file():
        raise BundleError(
            f"{path}: is a folder with other things in it, which is never replaced; "
            "choose another path"
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
    raise ValueError(f"{constant} is no number")


def _check_head(given: Any, file: Path, kind: str) -> None:
    """Format, version and kind come first: nothing else is known of another version."""
    if not isinstance(given, dict) or given.get("format") != FORMAT:
        raise BundleError(f"{file}: not of format {FORMAT!r}")
    version = given.get("version")
    if type(version) is not int or version < 1:
        raise BundleError(f"{file}: version must be a number from 1, not {version!r}")
    if version > VERSION:
        raise BundleError(
            f"{file}: written in version {version} of {FORMAT}, this program reads up to version "
            f"{VERSION}; update real2sim, or save the bundle again with an older one"
        )
    if given.get("kind") != kind:
        raise BundleError(f"{file}: holds a bundle of kind {given.get('kind')!r}, not {kind!r}")


def _first_problem(error: ValidationError) -> str:
    problem = error.errors(include_url=False, include_input=False)[0]
    place = ".".join(str(part) for part in problem["loc"])
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    return f"{place}: {problem['msg']}{more}"
