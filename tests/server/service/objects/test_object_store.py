"""Guarantees of every object store, and bundles transferred through it."""

from __future__ import annotations

import hashlib
import os
import urllib.request

import pytest

from real2sim_server.service import shared_objects
from real2sim_server.service.shared_objects import (
    MARK,
    BundleFolders,
    ObjectStoreError,
    SharedBundle,
    open_objects,
)

CONTENT = bytes(range(256)) * 40
DIGEST = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture
def objects(objects_url):
    return open_objects(objects_url)


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "content"
    path.write_bytes(CONTENT)
    return path


def test_an_object_is_found_by_digest_and_read_by_range(objects, file):
    assert objects.find(DIGEST) is None
    for _ in range(2):
        objects.put(file, DIGEST)
    found = objects.find(DIGEST)
    assert (found.digest, found.bytes, found.age_s < 100) == (DIGEST, len(CONTENT), True)
    assert objects.read(DIGEST, 0, len(CONTENT)) == CONTENT
    assert objects.read(DIGEST, 300, 310) == CONTENT[300:310]
    assert [one.digest for one in objects.list()] == [DIGEST]
    objects.remove(DIGEST)
    assert list(objects.list()) == []


def test_reading_a_missing_object_fails(objects):
    with pytest.raises((ObjectStoreError, FileNotFoundError)):
        objects.read(DIGEST, 0, 1)
    objects.remove(DIGEST)


def test_an_object_name_must_be_a_digest(objects, file):
    with pytest.raises(ValueError, match="not an SHA-256"):
        objects.put(file, "../../etc/passwd")


def test_a_signed_url_gives_access_without_credentials(objects, file, objects_url):
    objects.put(file, DIGEST)
    url = objects.signed_url(DIGEST, 60)
    if objects_url.startswith("file"):
        assert url is None
        return
    with urllib.request.urlopen(url) as answer:
        assert answer.read() == CONTENT


@pytest.mark.parametrize("url", ["http://x", "file:", "s3://", "s3://b/p?colour=red"])
def test_an_unsupported_url_is_refused(url):
    with pytest.raises(ValueError, match=r"object store|only endpoint"):
        open_objects(url)


def test_an_unreachable_store_raises_an_error(file, monkeypatch):
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "tests")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "tests")
    monkeypatch.setattr(shared_objects, "RETRIES", 0)
    objects = open_objects("s3://bucket?endpoint=http://127.0.0.1:1&region=x")
    with pytest.raises(ObjectStoreError):
        objects.put(file, DIGEST)


# --- bundles ----------------------------------------------------------------------------


class Site:
    """A worker's folders attached to an object store."""

    def __init__(self, root, objects, max_bytes=1 << 30) -> None:
        self.folders = {kind: root / kind for kind in ("scene", "asset", "job")}
        self.bundles = BundleFolders(objects, self.folders, max_bytes=max_bytes)

    def make(self, name: str, size: int = 1000) -> SharedBundle:
        folder = self.folders["scene"] / f"{name}.r2s"
        (folder / "parts").mkdir(parents=True)
        (folder / "scene.json").write_text(name)
        (folder / ".claim").write_text("hidden")
        (folder / "parts" / "cloud").write_bytes(name.encode() * size)
        return self.bundles.put("scene", name, folder)


def test_a_bundle_is_identical_after_the_transfer(objects, tmp_path):
    made = Site(tmp_path / "a", objects).make("street")
    bundle = SharedBundle.of_document("scene", "street", made.document())
    assert bundle == made
    site = Site(tmp_path / "b", objects)
    folder = site.bundles.take_out(bundle)
    found = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert found == {"scene.json", "parts/cloud", MARK}
    assert (folder / "parts" / "cloud").read_bytes() == b"street" * 1000
    assert site.bundles.own("scene") == []


def test_downloaded_bundles_are_evicted_least_recently_used_first(tmp_path):
    objects = open_objects(f"file://{tmp_path / 'objects'}")
    maker = Site(tmp_path / "a", objects)
    bundles = [maker.make(name) for name in ("one", "two", "six")]
    site = Site(tmp_path / "b", objects, max_bytes=7000)
    first, second = (site.bundles.take_out(b) for b in bundles[:2])
    os.utime(first / MARK, (1, 1))
    os.utime(second / MARK, (2, 2))
    shared_objects.mark_used(first)
    third = site.bundles.take_out(bundles[2])
    assert [p.exists() for p in (first, second, third)] == [True, False, True]


def test_local_bundles_are_never_evicted(tmp_path):
    objects = open_objects(f"file://{tmp_path / 'objects'}")
    site = Site(tmp_path / "a", objects, max_bytes=1)
    site.make("one")
    other = Site(tmp_path / "b", objects).make("two")
    site.bundles.take_out(other)
    assert [p.name for p in site.bundles.own("scene")] == ["one.r2s"]


def test_a_corrupt_object_is_refused(tmp_path):
    objects = open_objects(f"file://{tmp_path / 'objects'}")
    bundle = Site(tmp_path / "a", objects).make("street")
    digest = bundle.files[0].digest
    (tmp_path / "objects" / digest[:2] / digest).write_bytes(b"x" * bundle.files[0].bytes)
    site = Site(tmp_path / "b", objects)
    with pytest.raises(ObjectStoreError, match="damaged"):
        site.bundles.take_out(bundle)
    assert list(site.folders["scene"].glob("*")) == []


def test_a_bundle_file_outside_its_folder_is_refused(tmp_path, file):
    objects = open_objects(f"file://{tmp_path / 'objects'}")
    objects.put(file, DIGEST)
    document = f'{{"folder": "x.r2s", "files": [["../../evil", "{DIGEST}", {len(CONTENT)}]]}}'
    with pytest.raises(ObjectStoreError, match="leads out"):
        Site(tmp_path / "b", objects).bundles.take_out(
            SharedBundle.of_document("scene", "x", document)
        )


def test_unreferenced_objects_are_removed_after_a_day(tmp_path, file):
    folder = tmp_path / "objects"
    objects = open_objects(f"file://{folder}")
    site = Site(tmp_path / "a", objects)
    bundle = site.make("street")
    objects.put(file, DIGEST)
    wanted = {one.digest for one in bundle.files}
    assert site.bundles.sweep(wanted) == 0
    for path in folder.glob("??/*"):
        os.utime(path, (1, 1))
    assert site.bundles.sweep(wanted) == 1
    assert {one.digest for one in objects.list()} == wanted
