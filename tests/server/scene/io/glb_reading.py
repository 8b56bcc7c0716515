"""A binary glTF reader for tests, written from the specification and independent of the writer."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

DTYPES = {5126: "<f4", 5121: "u1"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


class Glb:
    """A parsed file with a validated layout."""

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        magic, version, length = struct.unpack_from("<4sII", data)
        assert (magic, version, length) == (b"glTF", 2, len(data))
        chunks = {}
        offset = 12
        while offset < len(data):
            size, kind = struct.unpack_from("<I4s", data, offset)
            assert size % 4 == 0
            chunks[kind] = data[offset + 8 : offset + 8 + size]
            offset += 8 + size
        assert offset == len(data)
        assert list(chunks) in ([b"JSON"], [b"JSON", b"BIN\0"])
        self.json: dict[str, Any] = json.loads(chunks[b"JSON"])
        self.binary = chunks.get(b"BIN\0", b"")
        if self.binary:
            assert self.json["buffers"] == [{"byteLength": len(self.binary)}]
        self.arrays = [self._read(a) for a in self.json.get("accessors", [])]

    def _read(self, accessor: dict[str, Any]) -> np.ndarray:
        view = self.json["bufferViews"][accessor["bufferView"]]
        dtype = np.dtype(DTYPES[accessor["componentType"]])
        width = WIDTHS[accessor["type"]]
        assert accessor["count"] >= 1
        assert view["byteOffset"] % 4 == 0
        assert view["byteLength"] == accessor["count"] * width * dtype.itemsize
        assert view["byteOffset"] + view["byteLength"] <= len(self.binary)
        array = np.frombuffer(
            self.binary, dtype, accessor["count"] * width, view["byteOffset"]
        ).reshape(-1, width)
        if "min" in accessor:
            assert array.min(axis=0).tolist() == accessor["min"]
            assert array.max(axis=0).tolist() == accessor["max"]
        return array

    def node(self, name: str) -> dict[str, Any]:
        (found,) = [n for n in self.json["nodes"] if n.get("name") == name]
        return found

    def attributes(self, name: str) -> dict[str, np.ndarray]:
        """Attributes of the only primitive of a node's mesh."""
        (primitive,) = self.json["meshes"][self.node(name)["mesh"]]["primitives"]
        return {k: self.arrays[i] for k, i in primitive["attributes"].items()}

    def channels(self, name: str) -> dict[str, tuple[np.ndarray, np.ndarray, str]]:
        """Key times [s], values and interpolation of a node's animation by path."""
        index = self.json["nodes"].index(self.node(name))
        found = {}
        for animation in self.json.get("animations", []):
            for channel in animation["channels"]:
                if channel["target"]["node"] == index:
                    sampler = animation["samplers"][channel["sampler"]]
                    found[channel["target"]["path"]] = (
                        self.arrays[sampler["input"]][:, 0],
                        self.arrays[sampler["output"]],
                        sampler["interpolation"],
                    )
        return found

    def local(self, name: str, seconds: float) -> np.ndarray:
        """``T_parent_node`` [4, 4] without scale at a time of the animation."""
        node, channels = self.node(name), self.channels(name)
        position = np.array(node.get("translation", [0, 0, 0]), dtype=float)
        rotation = np.array(node.get("rotation", [0, 0, 0, 1]), dtype=float)
        if "translation" in channels:
            position = sample(*channels["translation"][:2], seconds, spherical=False)
        if "rotation" in channels:
            rotation = sample(*channels["rotation"][:2], seconds, spherical=True)
        matrix = np.eye(4)
        matrix[:3, :3] = rotation_matrix(rotation)
        matrix[:3, 3] = position
        return matrix

    def shown(self, name: str, seconds: float) -> bool:
        """Whether the scale of a node is nonzero. STEP holds a value until the next key."""
        if "scale" not in self.channels(name):
            return True
        times, values, interpolation = self.channels(name)["scale"]
        assert interpolation == "STEP"
        index = max(0, int(np.searchsorted(times, np.float32(seconds), side="right")) - 1)
        assert values[index].tolist() in ([0, 0, 0], [1, 1, 1])
        return bool(values[index][0])


def sample(times: np.ndarray, values: np.ndarray, seconds: float, *, spherical: bool) -> np.ndarray:
    """LINEAR interpolation as in appendix C of the specification; clamped outside the keys."""
    seconds = min(max(seconds, float(times[0])), float(times[-1]))
    after = min(max(int(np.searchsorted(times, seconds)), 1), len(times) - 1)
    a, b = values[after - 1].astype(float), values[after].astype(float)
    t = (seconds - float(times[after - 1])) / (float(times[after]) - float(times[after - 1]))
    if not spherical:
        return a * (1 - t) + b * t
    dot = float(a @ b)
    angle = np.arccos(min(1.0, abs(dot)))
    if angle < 1e-7:
        return a
    sign = -1.0 if dot < 0 else 1.0
    return (np.sin(angle * (1 - t)) * a + sign * np.sin(angle * t) * b) / np.sin(angle)


def rotation_matrix(xyzw: np.ndarray) -> np.ndarray:
    """Rotation [3, 3] of a quaternion in glTF order, as given in the extension."""
    x, y, z, w = xyzw / np.linalg.norm(xyzw)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
