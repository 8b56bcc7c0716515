"""Mutations of bytes, JSON values, XML elements and msgpack values."""

from __future__ import annotations

import json
import random
import re
import struct
import xml.etree.ElementTree as ET
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np

from real2sim_proto import decode, encode

EXTREMES = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 62, (1 << 64) - 1)
VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2**31, 2**53, -(2**63), 2**64 - 1, 1e308, -1e-308, "", "x",
    "\x00", "../../x", "9" * 400, [], {}, [[]], [None], {"a": None}, [[0.0] * 3], "NaN",
)  # fmt: skip
TEXTS = ("nan", "inf", "-1", "0", "1e308", "99999999999", "x", "", "1.5")
FLOATS = (float("nan"), float("inf"), -float("inf"), 0.0, -0.0, 3.4e38, 1e-45, -1.0)


def damaged_bytes(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    """``data`` after one to four small mutations. ``others`` provides material to splice in."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        injury = rng.choice((_flip, _byte, _number, _float, _cut, _drop, _double, _splice, _text))
        data = injury(data, others, rng)
    return data


def _place(data: bytes, rng: random.Random) -> int:
    # Headers are at the beginning, directories at the end.
    n = len(data)
    kind = rng.random()
    if kind < 0.25:
        return rng.randrange(min(n, 256) + 1)
    return max(0, n - rng.randrange(min(n, 256) + 1)) if kind < 0.35 else rng.randrange(n + 1)


def _flip(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    at = _place(data, rng)
    flipped = bytes(byte ^ (1 << rng.randrange(8)) for byte in data[at : at + 1])
    return data[:at] + flipped + data[at + 1 :]


def _byte(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    at = _place(data, rng)
    return data[:at] + bytes([rng.randrange(256)]) + data[at + 1 :]


def _number(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    at, width, order = _place(data, rng), rng.choice((1, 2, 4, 8)), rng.choice("<>")
    value = rng.choice(EXTREMES) & ((1 << 8 * width) - 1)
    packed = value.to_bytes(width, "little" if order == "<" else "big")
    return data[:at] + packed + data[at + width :]


def _float(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    at, kind = _place(data, rng), rng.choice(("<f", ">f", "<d"))
    packed = struct.pack(kind, rng.choice(FLOATS))
    return data[:at] + packed + data[at + len(packed) :]


def _cut(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    return data[: _place(data, rng)]


def _drop(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    at = _place(data, rng)
    return data[:at] + data[at + rng.choice((1, 2, 4, 16, 256)) :]


def _double(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    at, length = _place(data, rng), rng.choice((1, 4, 16, 256))
    return data[:at] + data[at : at + length] * rng.choice((2, 2, 50)) + data[at + length :]


def _splice(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    other = rng.choice(others) if others else data
    at, start = _place(data, rng), _place(other, rng)
    return data[:at] + other[start : start + rng.choice((4, 64, 1024))] + data[at:]


def _text(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    """Replace a decimal digit with another number."""
    digits = [k for k, b in enumerate(data[:4096]) if 48 <= b <= 57]
    if not digits:
        return data
    at = rng.choice(digits)
    number = rng.choice((b"0", b"-1", b"99999999999", b"1e999", b"nan", b"4294967296", b"x", b""))
    return data[:at] + number + data[at + 1 :]


def damaged_json(data: bytes, rng: random.Random) -> bytes:
    """A JSON text with one to three changed values. Returns the input if it is not JSON."""
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError):
        return data
    for _ in range(rng.choice((1, 1, 3))):
        tree = _damaged_tree(tree, rng, lambda: rng.choice((*VALUES, *FLOATS)))
    return json.dumps(tree).encode()


def damaged_xml(data: bytes, rng: random.Random) -> bytes:
    """An XML text with one to three elements or attributes removed, doubled or changed. Returns the
    input if it is not XML.
    """
    try:
        root = ET.fromstring(data)
    except (ET.ParseError, ValueError, LookupError):
        return data
    for _ in range(rng.choice((1, 1, 3))):
        parents = [element for element in root.iter() if len(element)]
        named = [element for element in root.iter() if element.attrib]
        injury = rng.random()
        if injury < 0.3 and parents:
            parent = rng.choice(parents)
            parent.remove(rng.choice(list(parent)))
        elif injury < 0.4 and parents:
            parent = rng.choice(parents)
            parent.append(rng.choice(list(parent)))
        elif named:
            element = rng.choice(named)
            name = rng.choice(sorted(element.attrib))
            if injury < 0.6:
                del element.attrib[name]
            else:
                element.set(name, rng.choice(TEXTS))
    return ET.tostring(root)


def damaged_msgpack(data: bytes, rng: random.Random) -> bytes:
    """A message with one to three changed values, including arrays."""

    def other() -> Any:
        if rng.random() < 0.3:
            shape = rng.choice(((0,), (0, 3), (1,), (2, 2), (3, 1, 2)))
            return np.full(shape, rng.choice(FLOATS))
        value = rng.choice((*VALUES, *FLOATS, b"", b"\xc1"))
        return value if not isinstance(value, int) or value < 2**64 else 0

    try:
        tree = decode(data)
        for _ in range(rng.choice((1, 1, 3))):
            tree = _damaged_tree(tree, rng, other)
        return encode(tree) if isinstance(tree, dict) else msgpack.packb(tree)
    except (ValueError, TypeError, OverflowError):
        return data


def _damaged_tree(tree: Any, rng: random.Random, other: Callable[[], Any]) -> Any:
    """A copy of nested containers with one changed value at the end of a random path."""
    if isinstance(tree, dict) and tree and rng.random() < 0.95:
        key = rng.choice(list(tree))
        kind = rng.random()
        if kind < 0.08:
            return {k: v for k, v in tree.items() if k != key}
        if kind < 0.11:
            return tree | {rng.choice(("x", "")): other()}
        return tree | {key: _damaged_tree(tree[key], rng, other)}
    if isinstance(tree, list) and tree and rng.random() < 0.95:
        at = rng.randrange(len(tree))
        kind = rng.random()
        if kind < 0.08:
            return tree[:at] + tree[at + 1 :]
        if kind < 0.16:
            return tree[:at] + [tree[at]] * rng.choice((2, 20)) + tree[at + 1 :]
        return [*tree[:at], _damaged_tree(tree[at], rng, other), *tree[at + 1 :]]
    if isinstance(tree, int | float) and not isinstance(tree, bool) and rng.random() < 0.5:
        return rng.choice((-tree, tree + 1, tree * 1000, tree / 3, tree * 1e30))
    return other()


def shape_of(text: str) -> str:
    """An error message without its numbers and names."""
    return re.sub(r"[0-9]+|'[^']*'|\"[^\"]*\"", "#", text)[:120]
