"""Files of ``torch.save``, read in a process of their own: only tensors and numbers come back.

``torch.load(weights_only=True)`` builds few kinds of things, but it interprets a pickle and its
tensors' strides as the file has them. The process that does it hands over a safetensors file
and JSON.
"""

from __future__ import annotations

import pickle
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from ..._confined import Limits, run_confined

GIB = 1024**3
SECONDS = 600.0
MAX_DEPTH = 64
TENSOR_FILE = "tensors.safetensors"


class TorchFileError(ValueError):
    """A file that is none of torch, is damaged, or holds other objects."""


def read_torch_file(path: Path) -> Any:
    """What ``torch.save`` wrote: containers of tensors, numbers and texts, on the CPU.

    Raises:
        TorchFileError: no file of torch, damaged, with other objects, or one whose reading takes
            more memory or time than its size explains.
        OSError: it cannot be read.
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
        # The other process was fed by an untrusted file: what it says may be of any form.
        except Exception as error:
            raise TorchFileError(f"cannot be read: {error}") from error


def unpack_torch_file(path: str, folder: str) -> Any:
    """Write the tensors of a file below ``folder``; the containers around them as JSON values.

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
    # Damage shows as almost any error, depending on where it is.
    except Exception as error:
        raise TorchFileError(f"no checkpoint of torch, or damaged: {error}") from error
    tensors: dict[str, Tensor] = {}
    tree = _tree(state, tensors, depth=0)
    save_file(tensors, Path(folder) / TENSOR_FILE)
    return tree


def _tree(value: Any, tensors: dict[str, Tensor], *, depth: int) -> list[Any]:
    """A value as JSON: its kind, then what it is made of."""
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
    """What the numbers in checkpoints that are not final are made of; harmless to build."""
    scalar = np._core.multiarray.scalar  # type: ignore[attr-defined]
    numbers = [np.dtype, *(type(np.dtype(kind)) for kind in ("f8", "f4", "i8", "i4", "?"))]
    old_name = (scalar, "numpy.core.multiarray.scalar")
    return [scalar, old_name, *numbers]


def _unsafe_objects(path: str) -> list[str]:
    try:
        return sorted(torch.serialization.get_unsafe_globals_in_checkpoint(path))
    except Exception:  # the file may be of an old kind, or no checkpoint at all
        return []
