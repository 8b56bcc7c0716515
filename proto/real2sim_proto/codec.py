"""msgpack with arrays, with strict decoding.

Maps have string keys. Allowed values are None, bool, int, float, str, bytes, lists, maps and
NumPy arrays. An array is ext type 1; its payload is the msgpack array ``[dtype, shape, bytes]``:
dtype is one of :data:`ARRAY_DTYPES` (little-endian), bytes are in C order. Pickle is never used.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import msgpack
import numpy as np

ARRAY_EXT = 1
ARRAY_DTYPES = ("|b1", "|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<i8", "<u8", "<f2", "<f4", "<f8")
MAX_DEPTH = 48
MAX_ARRAY_NDIM = 8
MAX_SERVER_MESSAGE_BYTES = 256 * 1024 * 1024
"""Maximum size of a worker's message; raw rgb, depth and instance of five cameras of 1920x1280 take
106 MiB."""
DEFAULT_MAX_BYTES = MAX_SERVER_MESSAGE_BYTES
MAX_CLIENT_MESSAGE_BYTES = 1024 * 1024
"""Maximum size of a client's message; plans and edits are small."""


SMALL_ARRAY_BYTES = 4096
"""Smaller arrays are copied, which is faster than referring to them."""

_LITTLE = {np.dtype(name): name for name in ARRAY_DTYPES}
_SENT_AS = _LITTLE | {dtype.newbyteorder(">"): name for dtype, name in _LITTLE.items()}
"""All are little-endian on the wire."""


class CodecError(ValueError):
    """Bytes that are not a valid message; the error states what was found and what is allowed."""


def encode(message: dict[str, Any]) -> bytes:
    """Encode a message.

    Raises:
        CodecError: a value of an unsupported type.

    Examples:
        >>> encode({"v": 1, "type": "bye", "id": 3}).hex()
        '83a17601a474797065a3627965a2696403'
    """
    try:
        packed: bytes = msgpack.packb(message, default=_pack_array, use_bin_type=True)
    except (TypeError, ValueError, OverflowError) as error:
        raise CodecError(f"message cannot be encoded: {error}") from error
    return packed


def decode(data: bytes, *, max_bytes: int = DEFAULT_MAX_BYTES) -> dict[str, Any]:
    """Decode a message; arrays are read-only views into ``data``.

    Raises:
        CodecError: too large, not msgpack, trailing bytes, not a map with string keys, nested
            deeper than MAX_DEPTH, an unknown ext type, or an array whose parts disagree.

    Examples:
        >>> decode(encode({"route": np.zeros((2, 2))}))["route"].shape
        (2, 2)
    """
    if len(data) > max_bytes:
        raise CodecError(f"message of {len(data)} bytes is larger than the allowed {max_bytes}")
    try:
        message = unpack(data)
    except CodecError:
        raise
    except (
        ValueError,
        TypeError,
        RecursionError,
    ) as error:
        reason = str(error) or type(error).__name__
        raise CodecError(f"message is not valid msgpack: {reason}") from error
    if not isinstance(message, dict):
        raise CodecError(f"a message must be a map, not {type(message).__name__}")
    _check_values(message, MAX_DEPTH)
    return message


def unpack(data: bytes) -> Any:
    """Decode ``data`` for a reader that checks every value itself; see :func:`decode`.

    Raises:
        CodecError: an unknown ext type, or an array whose parts disagree.
        ValueError, TypeError, RecursionError: not msgpack.
    """
    return msgpack.unpackb(data, raw=False, strict_map_key=True, ext_hook=_unpack_array)


def _pack_array(value: object) -> msgpack.ExtType:
    if isinstance(value, np.generic):
        value = np.asarray(value)
    if not isinstance(value, np.ndarray):
        raise TypeError(f"values of type {type(value).__name__} have no place on the wire")
    dtype = _SENT_AS.get(value.dtype)
    if dtype is None:
        raise TypeError(f"arrays of dtype {value.dtype} have no place on the wire")
    if value.nbytes <= SMALL_ARRAY_BYTES:
        # In C order, regardless of the array's own order.
        data = value.astype(dtype, copy=False).tobytes()
        return msgpack.ExtType(ARRAY_EXT, _array_head(dtype, value.shape, len(data)) + data)
    array = np.ascontiguousarray(value, dtype=dtype)
    payload = msgpack.packb([dtype, list(value.shape), array.data.cast("B")])
    return msgpack.ExtType(ARRAY_EXT, payload)


@functools.lru_cache(maxsize=256)
def _array_head(dtype: str, shape: tuple[int, ...], size: int) -> bytes:
    """Header of an array with ``size`` bytes; cached because few shapes occur."""
    payload: bytes = msgpack.packb([dtype, shape, bytes(size)])
    return payload[: len(payload) - size]


def _unpack_array(code: int, payload: bytes) -> np.ndarray:
    if code != ARRAY_EXT:
        raise CodecError(f"ext type {code} is unknown; arrays are ext type {ARRAY_EXT}")
    parts = msgpack.unpackb(payload, raw=False)
    if not (isinstance(parts, list) and len(parts) == 3 and isinstance(parts[2], bytes)):
        raise CodecError("an array must be [dtype, shape, bytes]")
    dtype, shape, data = parts
    if dtype not in ARRAY_DTYPES:
        raise CodecError(
            f"array dtype {dtype!r} is not allowed; allowed are {', '.join(ARRAY_DTYPES)}"
        )
    if not isinstance(shape, list) or len(shape) > MAX_ARRAY_NDIM:
        raise CodecError(f"array shape {shape!r} is not a list of at most {MAX_ARRAY_NDIM} sizes")
    if not all(type(n) is int and 0 <= n < 2**31 for n in shape):
        raise CodecError(f"array shape {shape!r} holds something that is not a size")
    expected = math.prod(shape) * np.dtype(dtype).itemsize
    if expected != len(data):
        raise CodecError(f"array {dtype} {shape} needs {expected} bytes, {len(data)} were sent")
    return np.frombuffer(data, dtype=dtype).reshape(shape)


_LEAVES = frozenset({str, bytes, int, float, bool, np.ndarray, type(None)})


def _check_values(value: Any, depth: int) -> None:
    if depth < 0:
        raise CodecError(f"message is nested deeper than {MAX_DEPTH} levels")
    kind = type(value)
    if kind is dict:
        for key, item in value.items():
            if type(key) is not str:
                raise CodecError(f"map keys must be strings, not {key!r}")
            if type(item) not in _LEAVES:
                _check_values(item, depth - 1)
    elif kind is list:
        for item in value:
            # Rows of numbers are the most frequent lists.
            if type(item) not in _LEAVES and not (
                depth and type(item) is list and _LEAVES.issuperset(map(type, item))
            ):
                _check_values(item, depth - 1)
    else:
        raise CodecError(f"values of type {kind.__name__} are not allowed")
