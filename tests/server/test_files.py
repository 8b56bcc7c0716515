"""Folders that appear whole or not at all."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from real2sim_server._files import atomic_folder


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
