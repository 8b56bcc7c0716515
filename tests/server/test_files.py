"""Folders that appear whole or not at all."""

from __future__ import annotations

import errno
import io
import tarfile
from pathlib import Path

import pytest

from real2sim_server._files import atomic_folder, unpack_tar


def test_a_folder_that_a_lower_layer_of_a_container_holds_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = tmp_path / "kernels"
    held.mkdir()
    (held / "old").write_text("old")
    rename = Path.rename

    def renamed(path: Path, target: Path) -> Path:
        if path == held:
            # As overlayfs answers for a folder of an image.
            raise OSError(errno.EXDEV, "Invalid cross-device link")
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", renamed)
    with atomic_folder(held) as folder:
        (folder / "new").write_text("new")
    assert [path.name for path in tmp_path.rglob("*")] == ["kernels", "new"]


def archive(*members: tarfile.TarInfo) -> tarfile.TarFile:
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w") as tar:
        for member in members:
            member.size = 3 if member.isfile() else 0
            tar.addfile(member, io.BytesIO(b"abc"))
    file.seek(0)
    return tarfile.open(fileobj=file)


def test_an_archive_is_unpacked_with_its_folders_and_modes(tmp_path: Path) -> None:
    shown, held = tarfile.TarInfo("a/shown"), tarfile.TarInfo("a/held")
    shown.mode, held.mode = 0o666, 0o600
    unpack_tar(tar := archive(shown, held), tmp_path, members=tar)
    assert (tmp_path / "a/shown").read_bytes() == b"abc"
    modes = [(tmp_path / "a" / name).stat().st_mode & 0o777 for name in ("shown", "held")]
    assert modes == [0o644, 0o600]


@pytest.mark.parametrize("name", ["../out", "/out", "a/../../out"])
def test_an_archive_writes_nothing_outside_its_folder(tmp_path: Path, name: str) -> None:
    with pytest.raises(tarfile.ExtractError, match="leads out"):
        unpack_tar(tar := archive(tarfile.TarInfo(name)), tmp_path / "in", members=tar)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE])
def test_an_archive_makes_no_links_and_no_devices(tmp_path: Path, kind: bytes) -> None:
    member = tarfile.TarInfo("link")
    member.type, member.linkname = kind, "/etc/passwd"
    with pytest.raises(tarfile.ExtractError, match="neither a file"):
        unpack_tar(tar := archive(member), tmp_path, members=tar)
    assert list(tmp_path.iterdir()) == []
