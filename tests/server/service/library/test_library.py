from __future__ import annotations

import json
import shutil

import pytest

from real2sim_server.service.library.scene_catalog import SceneCatalog


@pytest.fixture
def library(scenes_dir) -> SceneCatalog:
    return SceneCatalog(scenes_dir)


def edit_document(bundle, **changes) -> None:
    path = bundle / "scene.json"
    document = json.loads(path.read_text()) | changes
    path.write_text(json.dumps(document))


def test_bundles_are_listed_by_name_without_their_suffix(library):
    listing = library.scan()["tiny"]
    assert listing.reason is None
    assert set(library.scan()) == {"tiny"}
    assert [o.object_id for o in listing.summary.objects] == ["car_red", "car_blue", "post"]


def test_a_missing_folder_holds_no_scenes(tmp_path):
    assert SceneCatalog(tmp_path / "nowhere").scan() == {}


def test_hidden_folders_and_other_files_are_passed_over(library, scenes_dir):
    (scenes_dir / ".half.r2s").mkdir()
    (scenes_dir / "notes.txt").write_text("hello")
    (scenes_dir / "pictures").mkdir()
    assert set(library.scan()) == {"tiny"}


def test_a_bundle_without_document_is_broken_and_the_others_are_not(library, scenes_dir):
    (scenes_dir / "empty.r2s").mkdir()
    listings = library.scan()
    assert "no scene.json" in listings["empty"].reason
    assert listings["tiny"].reason is None


def test_a_newer_bundle_is_broken_and_says_which_versions(library, scenes_dir):
    shutil.copytree(scenes_dir / "tiny.r2s", scenes_dir / "newer.r2s")
    edit_document(scenes_dir / "newer.r2s", version=99)
    assert "version 99" in library.scan()["newer"].reason


def test_a_truncated_tensor_file_is_noticed_without_loading(library, scenes_dir):
    tensors = scenes_dir / "tiny.r2s" / "background.safetensors"
    tensors.write_bytes(tensors.read_bytes()[:-100])
    assert "cut short" in library.scan()["tiny"].reason


def test_a_mended_bundle_is_noticed(library, scenes_dir):
    document = scenes_dir / "tiny.r2s" / "scene.json"
    whole = document.read_bytes()
    document.write_bytes(whole[:-50])
    assert library.scan()["tiny"].reason is not None
    document.write_bytes(whole)
    assert library.scan()["tiny"].reason is None


def test_a_removed_bundle_is_no_longer_listed(library, scenes_dir):
    library.scan()
    shutil.rmtree(scenes_dir / "tiny.r2s")
    assert library.scan() == {}


def test_an_unchanged_bundle_is_not_read_again(library):
    assert library.scan()["tiny"] is library.scan()["tiny"]


def test_what_loading_found_is_remembered_until_the_bundle_changes(library, scenes_dir):
    library.mark_broken(library.scan()["tiny"], "hash differs")
    assert library.scan()["tiny"].reason == "hash differs"
    document = scenes_dir / "tiny.r2s" / "scene.json"
    document.write_bytes(document.read_bytes() + b"\n")
    assert library.scan()["tiny"].reason is None


def test_two_folders_of_one_name_are_told_apart(library, scenes_dir):
    shutil.copytree(scenes_dir / "tiny.r2s", scenes_dir / "tiny")
    listings = library.scan()
    assert sum(listing.reason is None for listing in listings.values()) == 1
    assert any("same scene name" in (listing.reason or "") for listing in listings.values())


def test_a_folder_that_cannot_be_a_name_is_broken(library, scenes_dir):
    shutil.copytree(scenes_dir / "tiny.r2s", scenes_dir / "my street.r2s")
    assert "cannot be a scene name" in library.scan()["my street"].reason


def test_reasons_do_not_tell_where_the_folder_is(library, scenes_dir):
    (scenes_dir / "empty.r2s").mkdir()
    assert str(scenes_dir) not in library.scan()["empty"].reason
