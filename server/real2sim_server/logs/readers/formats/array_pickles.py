"""Pickled dictionaries of arrays, read without running what a pickle may contain."""

from __future__ import annotations

import math
import pickle
import re
import tempfile
import zipfile
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from ...._confined import ConfinedError, Limits, run_confined
from ...driving_log import LogError

MAX_ENTRY_BYTES = 4 << 30
"""Of an entry when unpacked; a drive of 200 frames has less than one."""
MAX_ARRAYS = 100_000
MAX_DIMENSIONS = 8
SECONDS = 300.0

_NUMBERS = re.compile(r"[<>=|]?(b1|[iu][1248]|f[248])")


def read_pickled_arrays(path: Path, name: str) -> dict[Any, NDArray[Any]]:
    """The dictionary of arrays that ``numpy.savez`` put under ``name`` as a pickled object.

    A pickle is a program, and what interprets it was not made for untrusted files. It is read in a
    process of its own; only plain ``.npy`` files of numbers come back.

    Raises:
        LogError: the file is missing or broken, has no such entry, or its pickle holds anything
            but a dictionary of arrays of numbers.
    """
    try:
        size = path.stat().st_size
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error})") from error
    with tempfile.TemporaryDirectory(prefix="real2sim-") as folder:
        try:
            keys = run_confined(
                f"{__name__}:unpack_arrays",
                {"path": str(path.absolute()), "name": name, "folder": folder},
                limits=Limits(
                    memory_bytes=size + 2 * MAX_ENTRY_BYTES,
                    seconds=SECONDS,
                    written_bytes=MAX_ENTRY_BYTES,
                ),
                errors=(LogError,),
            )
            files = [Path(folder) / f"{number}.npy" for number in range(len(keys))]
            return {k: np.load(f, allow_pickle=False) for k, f in zip(keys, files, strict=True)}
        except LogError:
            raise
        except (ConfinedError, OSError, ValueError, TypeError) as error:
            raise LogError(f"{path}: entry {name!r} cannot be read: {error}") from error


def unpack_arrays(path: str, name: str, folder: str) -> list[int | str]:
    """Write the arrays of a pickled dictionary as ``0.npy``, ``1.npy``, ...; their keys in order.

    Raises:
        LogError: as :func:`read_pickled_arrays`.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            arrays = _read_entry(archive, f"{name}.npy")
    except KeyError as error:
        raise LogError(f"{path}: has no entry {name!r}") from error
    except MemoryError:
        raise
    # Damage shows as almost any error, depending on where it is.
    except Exception as error:
        raise LogError(
            f"{path}: entry {name!r} is no pickled dictionary of arrays: {error}"
        ) from error
    for number, array in enumerate(arrays.values()):
        np.save(Path(folder) / f"{number}.npy", array, allow_pickle=False)
    return list(arrays)


def _read_entry(archive: zipfile.ZipFile, name: str) -> dict[int | str, NDArray[Any]]:
    size = archive.getinfo(name).file_size
    if size > MAX_ENTRY_BYTES:
        raise ValueError(f"it has {size} bytes; allowed are {MAX_ENTRY_BYTES}")
    with archive.open(name) as entry:
        value = _read_object(entry)
    if not isinstance(value, dict) or len(value) > MAX_ARRAYS:
        raise ValueError(f"it must be a dictionary of at most {MAX_ARRAYS} arrays")
    arrays = {_key(key): _numbers(array) for key, array in value.items()}
    if sum(array.nbytes for array in arrays.values()) > MAX_ENTRY_BYTES:
        raise ValueError(f"its arrays have more than {MAX_ENTRY_BYTES} bytes together")
    return arrays


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
    value = _Unpickler(entry).load()
    if isinstance(value, _Array) and value.holds_object:
        return value.data[0]
    return value


# --- the pickle -------------------------------------------------------------------------------


class _Unpickler(pickle.Unpickler):
    """Reads what an array was made of, and makes nothing.

    A pickle names functions of any module and calls them. Here the names of NumPy's own stand for
    the classes below, which keep their arguments; every other name is refused. No class and no
    function of NumPy is ever in reach of the file.
    """

    def find_class(self, module: str, name: str) -> Any:
        found = _STAND_INS.get((module.replace("numpy._core", "numpy.core"), name))
        if found is None:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, which is no array")
        return found


class _Kept:
    """What a pickle made. Nothing of it can be changed except by a state of the right form."""

    __slots__ = ()

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError(f"{type(self).__name__[1:]} takes no state")


class _ArrayClass(_Kept):
    """``numpy.ndarray``: an argument of ``_reconstruct``, and nothing that can be called."""

    __slots__ = ()


class _Type(_Kept):
    """A ``numpy.dtype``: its text, with the order of bytes that its state says."""

    __slots__ = ("text",)

    def __init__(self, text: Any) -> None:
        if not isinstance(text, str) or len(text) > 16:
            raise pickle.UnpicklingError("a type of values must be given as text")
        self.text = text

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) < 5 or state[1] not in ("<", ">", "|", "="):
            raise pickle.UnpicklingError("the state of a type of values is not understood")
        if any(part is not None for part in state[2:5]):
            raise pickle.UnpicklingError("records and arrays as values are not read")
        self.text = state[1] + self.text.lstrip("<>=|")

    def numbers(self) -> np.dtype[Any]:
        """The type, where it is one of plain numbers."""
        if not _NUMBERS.fullmatch(self.text):
            raise pickle.UnpicklingError(f"values of type {self.text!r} are not read")
        return np.dtype(self.text)


class _Array(_Kept):
    """An array: shape, type, order and bytes."""

    __slots__ = ("data", "order", "shape", "type")

    def __init__(self, shape: Any = (), kind: Any = None, data: Any = b"", order: str = "C"):
        self.shape, self.type, self.data, self.order = shape, kind, data, order

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            raise pickle.UnpicklingError("the state of an array is not understood")
        _, self.shape, self.type, is_fortran, self.data = state
        self.order = "F" if is_fortran else "C"

    @property
    def holds_object(self) -> bool:
        """Whether this is the array of one object that ``numpy.savez`` puts around a dictionary."""
        is_object = isinstance(self.type, _Type) and self.type.text.strip("<>=|") in ("O", "O8")
        return is_object and self.shape == () and isinstance(self.data, list) and bool(self.data)


def _reconstruct(kind: Any, shape: Any, code: Any) -> _Array:
    if not isinstance(kind, _ArrayClass):
        raise pickle.UnpicklingError("only arrays are made, no other class")
    return _Array()


def _scalar(kind: Any, data: Any = b"") -> _Array:
    return _Array((), kind, data)


def _from_buffer(data: Any, kind: Any, shape: Any, order: Any) -> _Array:
    return _Array(shape, kind, data, "F" if order == "F" else "C")


def _type_of(text: Any, align: Any = False, copy: Any = False) -> _Type:
    return _Type(text)


_STAND_INS: Final = {
    ("numpy", "ndarray"): _ArrayClass(),
    ("numpy", "dtype"): _type_of,
    ("numpy.core.multiarray", "_reconstruct"): _reconstruct,
    ("numpy.core.multiarray", "scalar"): _scalar,
    ("numpy.core.numeric", "_frombuffer"): _from_buffer,
}


# --- what it says -----------------------------------------------------------------------------


def _numbers(array: Any) -> NDArray[Any]:
    """The array that a pickle describes, once type, shape and bytes fit together."""
    if not isinstance(array, _Array) or not isinstance(array.type, _Type):
        raise ValueError(f"holds a {type(array).__name__}, where an array must be")
    dtype, shape, data = array.type.numbers(), array.shape, array.data
    if not isinstance(shape, tuple) or len(shape) > MAX_DIMENSIONS:
        raise ValueError("the shape of an array is not understood")
    if not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError(f"the shape {shape} of an array holds no lengths")
    if not isinstance(data, bytes | bytearray):
        raise ValueError("the values of an array are no bytes")
    if len(data) != math.prod(shape) * dtype.itemsize:
        raise ValueError(f"{len(data)} bytes do not fit {dtype} of shape {shape}")
    # The copy must not keep a file's bytes of the other order, nor be read-only.
    in_order = np.frombuffer(data, dtype)
    numbers = in_order.reshape(shape, order="F" if array.order == "F" else "C")
    return numbers.astype(dtype.newbyteorder("="))


def _key(key: Any) -> int | str:
    if isinstance(key, int | str) and not isinstance(key, bool):
        return key
    if isinstance(key, _Array) and key.shape == ():
        number = _numbers(key)
        if number.dtype.kind in "iu":
            return int(number)
    raise ValueError(f"the name of an array is a {type(key).__name__}, no number or text")
