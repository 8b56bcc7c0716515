"""Reading a damaged file either works or raises BundleError."""

import contextlib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from real2sim_server.scene import BundleError
from real2sim_server.scene.io import load_scene, read_splats

edits = st.lists(
    st.tuples(st.sampled_from(["set", "cut", "insert"]), st.floats(0, 1), st.binary(max_size=6)),
    min_size=1,
    max_size=4,
)


def damaged(data: bytes, changes: list[tuple[str, float, bytes]]) -> bytes:
    for kind, place, new in changes:
        at = int(place * len(data))
        skip = {"set": len(new), "cut": 1 + 7 * len(new), "insert": 0}[kind]
        data = data[:at] + (b"" if kind == "cut" else new) + data[at + skip :]
    return data


def compressed_ply() -> bytes:
    chunk = [f"{e}_{a}" for e in ("min", "max", "min_scale", "max_scale") for a in "xyz"]
    words = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
    header = ["ply", "format binary_little_endian 1.0", "element chunk 1"]
    header += [f"property float {name}" for name in chunk] + ["element vertex 2"]
    header += [f"property uint {name}" for name in words] + ["end_header\n"]
    return "\n".join(header).encode() + bytes(12 * 4 + 2 * 16)


def inria_ply() -> bytes:
    names = ["x", "y", "z", *(f"f_dc_{i}" for i in range(3)), "opacity"]
    names += [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    header = ["ply", "format binary_little_endian 1.0", "element vertex 2"]
    header += [f"property float {name}" for name in names] + ["end_header\n"]
    return "\n".join(header).encode() + b"\0\0\0\xbf" * (2 * len(names))


@pytest.mark.parametrize("original", [inria_ply(), compressed_ply()], ids=["inria", "playcanvas"])
def test_damaged_splat_files_raise_only_bundle_errors(original, tmp_path_factory):
    file = tmp_path_factory.mktemp("damage") / "a.ply"
    file.write_bytes(original)
    read_splats(file)

    @settings(max_examples=150)
    @given(edits)
    def check(changes):
        file.write_bytes(damaged(original, changes))
        with contextlib.suppress(BundleError):
            read_splats(file).check_values("cloud")

    check()


@pytest.mark.parametrize("verify", [True, False])
@pytest.mark.parametrize("name", ["scene.json", "background.safetensors"])
def test_damaged_bundles_raise_only_bundle_errors(bundle: Path, name, verify):
    file = bundle / name
    original = file.read_bytes()

    @settings(max_examples=150)
    @given(edits)
    def check(changes):
        file.write_bytes(damaged(original, changes))
        with contextlib.suppress(BundleError):
            load_scene(bundle, verify=verify)

    check()
