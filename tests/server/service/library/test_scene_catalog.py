from __future__ import annotations

import json
import shutil

import pytest

from real2sim_server.service.library.scenes import SceneCatalog


@pytest.fixture
def catalog(scenes_dir) -> SceneCatalog:
    return SceneCatalog(scenes_dir)


def edit_document(bundle, **changes) -> None:
    path = bundle / "scene.json"
    document = json.loads(path.read_text()) | changes
    path.write_text(json.dumps(document))


def test_bundles_are_listed_by_name_without_their_suffix(catalog):
    listing = catalog.scan()["tiny"]
    assert listing.reason is None
    assert set(catalog.scan()) == {"tiny"}
    assert [o.object_id for o in listing.summary.objects] == ["car_red", "car_blue", "post"]


def test_a_missing_folder_holds_no_scenes(tmp_path):
    assert SceneCatalog(tmp_path / "nowhere").scan() == {}


def test_hidden_folders_and_other_files_are_ignored(catalog, scenes_dir):
    (scenes_dir / ".half.r2s").mkdir()
    (scenes_dir / "notes.txt").write_text("hello")
    (scenes_dir / "pictures").mkdir()
    assert set(catalog.scan()) == {"tiny"}


def test_only_a_bundle_without_a_document_is_broken(catalog, scenes_dir):
    (scenes_dir / "empty.r2s").mkdir()
    listings = catalog.scan()
    assert "no scene.json" in listings["empty"].reason
    assert listings["tiny"].reason is None


def test_a_bundle_of_a_newer_version_is_broken(catalog, scenes_dir):
    shutil.copytree(scenes_dir / "tiny.r2s", scenes_dir / "newer.r2s")
    edit_document(scenes_dir / "newer.r2s", version=99)
    assert "version 99" in catalog.scan()["newer"].reason


def test_a_truncated_tensor_file_is_detected_without_loading(catalog, scenes_dir):
    tensors = scenes_dir / "tiny.r2s" / "background.safetensors"
    tensors.write_bytes(tensors.read_bytes()[:-100])
    assert "cut short" in catalog.scan()["tiny"].reason


def test_a_repaired_bundle_is_no_longer_broken(catalog, scenes_dir):
    document = scenes_dir / "tiny.r2s" / "scene.json"
    whole = document.read_bytes()
    document.write_bytes(whole[:-50])
    assert catalog.scan()["tiny"].reason is not None
    document.write_bytes(whole)
    assert catalog.scan()["tiny"].reason is None


def test_a_removed_bundle_is_no_longer_listed(catalog, scenes_dir):
    catalog.scan()
    shutil.rmtree(scenes_dir / "tiny.r2s")
    assert catalog.scan() == {}


def test_an_unchanged_bundle_is_not_read_again(catalog):
    assert catalog.scan()["tiny"] is catalog.scan()["tiny"]


def test_a_load_error_is_kept_until_the_bundle_changes(catalog, scenes_dir):
    catalog.mark_broken(catalog.scan()["tiny"], "hash differs")
    assert catalog.scan()["tiny"].reason == "hash differs"
    document = scenes_dir / "tiny.r2s" / "scene.json"
    document.write_bytes(document.read_bytes() + b"\n")
    assert catalog.scan()["tiny"].reason is None


def test_two_bundles_with_the_same_scene_name_conflict(catalog, scenes_dir):
    shutil.copytree(scenes_dir / "tiny.r2s", scenes_dir / "tiny")
    listings = catalog.scan()
    assert sum(listing.reason is None for listing in listings.values()) == 1
    assert any("same scene name" in (listing.reason or "") for listing in listings.values())


def test_a_folder_with_an_invalid_scene_name_is_broken(catalog, scenes_dir):
    shutil.copytree(scenes_dir / "tiny.r2s", scenes_dir / "my street.r2s")
    assert "cannot be a scene name" in catalog.scan()["my street"].reason


def test_reasons_do_not_reveal_the_folder_path(catalog, scenes_dir):
    (scenes_dir / "empty.r2s").mkdir()
    assert str(scenes_dir) not in catalog.scan()["empty"].reason
