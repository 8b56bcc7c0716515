from __future__ import annotations

import contextlib

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from real2sim_proto import codec
from real2sim_proto.codec import ARRAY_DTYPES, ARRAY_EXT, MAX_DEPTH, CodecError, decode, encode

scalars = st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.text() | st.binary()
values = st.recursive(
    scalars | st.floats(allow_nan=False),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)
arrays = st.sampled_from(ARRAY_DTYPES).flatmap(
    lambda dtype: hnp.arrays(np.dtype(dtype), hnp.array_shapes(min_dims=0, max_dims=4, min_side=0))
)


def packed_array(*parts: object) -> bytes:
    return msgpack.packb({"a": msgpack.ExtType(ARRAY_EXT, msgpack.packb(list(parts)))})


@given(st.dictionaries(st.text(), values, max_size=5))
def test_plain_messages_round_trip(message):
    assert decode(encode(message)) == message


@given(arrays)
def test_arrays_round_trip_bit_for_bit(array):
    received = decode(encode({"a": array}))["a"]
    assert received.dtype == array.dtype
    assert received.shape == array.shape
    assert received.tobytes() == array.tobytes()


def test_big_endian_and_strided_arrays_keep_their_values():
    array = np.arange(24, dtype=">f4").reshape(4, 6)[::2, ::-3]
    np.testing.assert_array_equal(decode(encode({"a": array}))["a"], array)


@pytest.mark.parametrize("size", [0, 3, codec.SMALL_ARRAY_BYTES // 8, codec.SMALL_ARRAY_BYTES])
def test_arrays_are_encoded_as_dtype_shape_and_c_order_bytes(size):
    for array in (np.arange(size, dtype=">f8"), np.arange(2.0 * size).reshape(2, size).T):
        data = array.astype("<f8").tobytes()
        assert encode({"a": array}) == packed_array("<f8", list(array.shape), data)


def test_received_arrays_are_read_only_views():
    received = decode(encode({"a": np.zeros(3)}))["a"]
    with pytest.raises(ValueError, match="read-only"):
        received[0] = 1


def test_numpy_scalars_are_encoded_as_zero_dimensional_arrays():
    assert decode(encode({"a": np.float32(1.5)}))["a"].shape == ()


@pytest.mark.parametrize(
    "value", [object(), {1, 2}, np.array([object()]), np.array(["text"]), np.zeros(2, complex)]
)
def test_unsupported_values_are_refused(value):
    with pytest.raises(CodecError, match="cannot be encoded"):
        encode({"a": value})


def test_an_oversized_message_is_refused_with_both_sizes():
    with pytest.raises(CodecError, match=r"103 bytes is larger than the allowed 100"):
        decode(b"\x00" * 103, max_bytes=100)


@pytest.mark.parametrize("data", [b"", b"\xc1", b"\x81\xa1a", encode({"a": 1}) + b"\x00"])
def test_bytes_other_than_one_msgpack_value_are_refused(data):
    with pytest.raises(CodecError, match="not valid msgpack"):
        decode(data)


def test_a_message_must_be_a_map():
    with pytest.raises(CodecError, match="must be a map"):
        decode(msgpack.packb([1, 2]))


def test_map_keys_must_be_strings():
    with pytest.raises(CodecError):
        decode(msgpack.packb({"a": {1: 2}}))


def test_nesting_over_the_depth_limit_is_refused():
    def nested(levels: int) -> dict:
        value: object = 0
        for _ in range(levels):
            value = [value]
        return {"a": value}

    decode(msgpack.packb(nested(MAX_DEPTH - 1)))
    with pytest.raises(CodecError, match="nested deeper"):
        decode(msgpack.packb(nested(MAX_DEPTH + 1)))


def test_extreme_nesting_does_not_overflow_the_stack():
    with pytest.raises(CodecError):
        decode(b"\x81\xa1a" + b"\x91" * 100_000 + b"\x00")


@pytest.mark.parametrize(
    ("parts", "reason"),
    [
        (("|O8", [1], b"12345678"), "not allowed"),
        (("<f4", [3], b"\x00" * 8), "needs 12 bytes"),
        (("<f4", [-1], b""), "not a size"),
        (("<f4", [2**40], b""), "not a size"),
        (("<f4", [1] * 9, b"\x00" * 4), "at most 8"),
        (("<f4", [True], b"\x00" * 4), "not a size"),
        (("<f4", "1", b"\x00" * 4), "not a list"),
        (("<f4", [1]), "must be"),
        (("<f4", [1], "text"), "must be"),
    ],
)
def test_arrays_with_inconsistent_parts_are_refused(parts, reason):
    with pytest.raises(CodecError, match=reason):
        decode(packed_array(*parts))


def test_an_array_payload_that_is_not_msgpack_is_refused():
    with pytest.raises(CodecError):
        decode(msgpack.packb({"a": msgpack.ExtType(ARRAY_EXT, b"\xc1")}))


def test_unknown_ext_types_and_timestamps_are_refused():
    with pytest.raises(CodecError, match="ext type 5"):
        decode(msgpack.packb({"a": msgpack.ExtType(5, b"x")}))
    with pytest.raises(CodecError):
        decode(msgpack.packb({"a": msgpack.Timestamp(1, 0)}))


def test_every_allowed_dtype_is_little_endian_or_one_byte():
    assert all(d[0] in "<|" for d in codec.ARRAY_DTYPES)


@given(st.binary(max_size=200))
def test_random_bytes_either_decode_or_raise_codec_error(data):
    with contextlib.suppress(CodecError):
        decode(data)
