import json
import struct
from pathlib import Path

import pytest

from real2sim_server.scene import BundleError
from real2sim_server.scene.io import load_scene, read_scene_summary
from real2sim_server.scene.io.container import content_hash


def edit_json(bundle: Path, **changes: object) -> None:
    file = bundle / "scene.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(BundleError, match=r"nothing.r2s: no such folder"):
        load_scene(tmp_path / "nothing.r2s")


def test_a_folder_without_json_is_refused(tmp_path):
    with pytest.raises(BundleError, match=r"no bundle, it has no scene.json"):
        load_scene(tmp_path)


@pytest.mark.parametrize("read", [load_scene, read_scene_summary])
def test_an_unsupported_version_is_refused_with_a_remedy(bundle, read):
    edit_json(bundle, version=8, content={"unheard": "of"})
    with pytest.raises(BundleError, match=r"version 8 .* reads version 1\. Update real2sim"):
        read(bundle)


@pytest.mark.parametrize("version", [0, 2, "1", 1.0, None, True])
def test_invalid_versions_are_refused(bundle, version):
    edit_json(bundle, version=version)
    with pytest.raises(BundleError, match=r"version .* reads version 1"):
        load_scene(bundle)


def test_another_format_is_refused(bundle):
    edit_json(bundle, format="gltf")
    with pytest.raises(BundleError, match="not of format 'real2sim-scene'"):
        load_scene(bundle)


@pytest.mark.parametrize("keep", [0, 1, 100, 2000])
def test_a_truncated_json_is_refused(bundle, keep):
    file = bundle / "scene.json"
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(BundleError, match=r"scene.json: no valid JSON"):
        load_scene(bundle)


@pytest.mark.parametrize(
    "text",
    ["[]", "3", '"x"', "[" * 100_000, '{"format": NaN}', "\ud800".encode("utf-8", "replace")],
)
def test_unrelated_json_is_refused(bundle, text):
    data = text if isinstance(text, bytes) else text.encode()
    (bundle / "scene.json").write_bytes(data)
    with pytest.raises(BundleError, match=r"scene.json"):
        load_scene(bundle)


@pytest.mark.parametrize("name", ["background", "objects", "sky"])
def test_a_truncated_tensor_file_is_refused(bundle, name):
    file = bundle / f"{name}.safetensors"
    file.write_bytes(file.read_bytes()[:-8])
    with pytest.raises(BundleError, match=rf"{name}.safetensors: has \d+ bytes where scene.json"):
        load_scene(bundle, verify=False)


@pytest.mark.parametrize("name", ["background", "objects", "sky"])
def test_a_missing_tensor_file_is_refused(bundle, name):
    (bundle / f"{name}.safetensors").unlink()
    with pytest.raises(BundleError, match=rf"{name}.safetensors: missing"):
        load_scene(bundle)


def test_a_symlink_to_a_tensor_file_is_refused(bundle, tmp_path):
    file = bundle / "background.safetensors"
    file.rename(tmp_path / "outside")
    file.symlink_to(tmp_path / "outside")
    with pytest.raises(BundleError, match="no plain file"):
        load_scene(bundle)


@pytest.mark.parametrize("name", ["background", "objects", "sky"])
def test_a_flipped_bit_in_a_tensor_is_detected(bundle, name):
    file = bundle / f"{name}.safetensors"
    data = bytearray(file.read_bytes())
    data[-3] ^= 1
    file.write_bytes(data)
    with pytest.raises(BundleError, match=r"tensor .* does not have the SHA-256"):
        load_scene(bundle)
    load_scene(bundle, verify=False)


def test_a_damaged_safetensors_header_is_refused(bundle):
    file = bundle / "background.safetensors"
    data = bytearray(file.read_bytes())
    data[:8] = struct.pack("<Q", 1 << 60)
    file.write_bytes(data)
    with pytest.raises(BundleError, match="no readable safetensors"):
        load_scene(bundle)


def test_a_changed_track_is_detected(bundle):
    content = json.loads((bundle / "scene.json").read_text())["content"]
    content["ego"]["trajectory"]["positions"][0][0] += 1.0
    edit_json(bundle, content=content)
    with pytest.raises(BundleError, match=r"content does not have the SHA-256"):
        load_scene(bundle)


def rehash(bundle: Path, content: dict) -> None:
    edit_json(bundle, content=content, content_hash=content_hash("scene", content))


def content_of(bundle: Path) -> dict:
    return json.loads((bundle / "scene.json").read_text())["content"]


def test_counts_that_do_not_match_the_tensors_are_refused(bundle):
    content = content_of(bundle)
    content["background"]["gaussians"] = 10**15
    rehash(bundle, content)
    with pytest.raises(BundleError, match=r"scene.json requires torch.float32 \[1000000000000000"):
        load_scene(bundle)


def test_duplicate_object_ids_are_refused(bundle):
    content = content_of(bundle)
    content["objects"][1]["object_id"] = content["objects"][0]["object_id"]
    rehash(bundle, content)
    with pytest.raises(BundleError, match="listed twice"):
        load_scene(bundle)


@pytest.mark.parametrize(
    ("place", "value", "reason"),
    [
        (("ego", "trajectory", "times_us"), [0, 1], "needs positions"),
        (("ego", "trajectory", "times_us", 0), 10**30, "too large|too big|overflow|int64|int"),
        (("ego", "size"), [1.0, 2.0], "ego.size"),
        (("ego", "size", 0), -1.0, "positive lengths"),
        (("cameras", 0, "K"), [[1, 0, 0]], "cameras.0.K"),
        (("cameras", 0, "name"), "rear", "unique"),
        (("background", "sh_degree"), 9, "background.sh_degree"),
        (("background", "tensors"), {}, "gives hashes of"),
        (("frame_times_us",), [3, 2], "increase strictly"),
        (("surprise",), 1, "surprise"),
    ],
)
def test_invalid_content_with_a_valid_hash_is_refused(bundle, place, value, reason):
    content = content_of(bundle)
    part = content
    for key in place[:-1]:
        part = part[key]
    part[place[-1]] = value
    rehash(bundle, content)
    with pytest.raises(BundleError, match=reason):
        load_scene(bundle)


def test_file_names_in_the_json_are_not_followed(bundle, tmp_path):
    outside = tmp_path / "outside.safetensors"
    (bundle / "background.safetensors").rename(outside)
    size = outside.stat().st_size
    files = json.loads((bundle / "scene.json").read_text())["files"]
    for name in ("../outside.safetensors", str(outside)):
        edit_json(bundle, files=files | {name: size})
        with pytest.raises(BundleError, match=r"background.safetensors: missing"):
            load_scene(bundle)
    del files["background.safetensors"]
    edit_json(bundle, files=files | {"../outside.safetensors": size})
    with pytest.raises(BundleError, match=r"does not list 'background.safetensors'"):
        load_scene(bundle)


def test_object_ids_never_become_paths(bundle, tmp_path):
    assert "../../etc/passwd" in load_scene(bundle).objects
    assert {f.name for f in bundle.iterdir()} == {
        "scene.json",
        "background.safetensors",
        "ground.safetensors",
        "objects.safetensors",
        "sky.safetensors",
    }
    assert [f.name for f in tmp_path.iterdir()] == ["street.r2s"]
