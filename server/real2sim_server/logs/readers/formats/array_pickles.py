"""Pickled dictionaries of arrays, read without running what a pickle may contain."""

from __future__ import annotations

import pickle
import zipfile
from pathlib import Path
from typing import IO, Any, ClassVar

import numpy as np

from ...driving_log import LogError


class _ArrayUnpickler(pickle.Unpickler):
    """Builds arrays, NumPy scalars and plain containers, and nothing else.

    A pickle is a program: it may name any function of any module and call it. This reader looks
    up names in the list below only, all of which do no more than build an array, so that a file
    with anything else is refused before it does anything.
    """

    ALLOWED: ClassVar[dict[str, tuple[str, ...]]] = {
        "numpy": ("ndarray", "dtype"),
        "numpy.core.multiarray": ("_reconstruct", "scalar"),
        "numpy._core.multiarray": ("_reconstruct", "scalar"),
        "numpy.core.numeric": ("_frombuffer",),
        "numpy._core.numeric": ("_frombuffer",),
    }

    def find_class(self, module: str, name: str) -> Any:
        if name not in self.ALLOWED.get(module, ()):
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, which is no array")
        return super().find_class(module.replace("numpy.core", "numpy._core"), name)


def read_pickled_arrays(path: Path, name: str) -> dict[Any, np.ndarray]:
    """The dictionary of arrays that ``numpy.savez`` put under ``name`` as a pickled object.

    Raises:
        LogError: the file is missing or broken, has no such entry, or its pickle holds anything
            but a dictionary of arrays.
    """
    try:
        with zipfile.ZipFile(path) as archive, archive.open(f"{name}.npy") as entry:
            value = _read_object(entry)
    except KeyError as error:
        raise LogError(f"{path}: has no entry {name!r}") from error
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error})") from error
    except (zipfile.BadZipFile, pickle.UnpicklingError, ValueError, EOFError) as error:
        raise LogError(
            f"{path}: entry {name!r} is no pickled dictionary of arrays: {error}"
        ) from error
    except (AttributeError, IndexError, TypeError, ImportError) as error:
        raise LogError(f"{path}: entry {name!r} is a broken pickle: {error}") from error
    if not isinstance(value, dict) or not all(isinstance(v, np.ndarray) for v in value.values()):
        raise LogError(f"{path}: entry {name!r} must be a dictionary of arrays")
    return value


def _read_object(entry: IO[bytes]) -> Any:
    version = np.lib.format.read_magic(entry)
    read_header = (
        np.lib.format.read_array_header_1_0
        if version == (1, 0)
        else np.lib.format.read_array_header_2_0
    )
    shape, _, dtype = read_header(entry)
    if shape != () or dtype != np.dtype(object):
        raise ValueError(f"expected one object, found {dtype} of shape {shape}")
    value = _ArrayUnpickler(entry).load()
    return value.item() if isinstance(value, np.ndarray) and value.shape == () else value
