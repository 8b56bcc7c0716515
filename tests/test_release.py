"""Releases: changelog fragments, and the script that creates a version from them."""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
import tomllib
from datetime import date
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
FILES = ("pyproject.toml", "client/pyproject.toml", "CHANGELOG.md", "docs/site/release_notes.md")

spec = importlib.util.spec_from_file_location("release", REPOSITORY / "scripts/release.py")
assert spec is not None
assert spec.loader is not None
release = importlib.util.module_from_spec(spec)
spec.loader.exec_module(release)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A repository with the files that a release changes, and one fragment."""
    for name in FILES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(REPOSITORY / name, tmp_path / name)
    (tmp_path / "changelog.d").mkdir()
    (tmp_path / "changelog.d/+wheels.added.md").write_text("Cars have wheels.\n")
    for command in ("init -q", "add -A", "-c user.name=a -c user.email=a@b commit -qm first"):
        subprocess.run(["git", *command.split()], check=True, cwd=tmp_path)
    return tmp_path


def test_every_fragment_has_a_known_type() -> None:
    settings = tomllib.loads((REPOSITORY / "pyproject.toml").read_text("utf-8"))
    types = [kind["directory"] for kind in settings["tool"]["towncrier"]["type"]]
    for fragment in (REPOSITORY / "changelog.d").glob("*.md"):
        assert re.fullmatch(rf"[+\w-]+\.({'|'.join(types)})\.md", fragment.name)


def test_a_release_sets_both_versions_and_moves_the_fragments(checkout: Path) -> None:
    release.prepare(checkout, "9.0.0", date(2027, 1, 2))
    server, sdk = (
        tomllib.loads((checkout / name).read_text("utf-8"))["project"] for name in FILES[:2]
    )
    assert server["version"] == sdk["version"] == "9.0.0"
    assert "real2sim==9.0.0" in server["dependencies"]
    assert "real2sim-server==9.0.0" in sdk["optional-dependencies"]["server"]
    changes = (checkout / "CHANGELOG.md").read_text("utf-8")
    assert "## 9.0.0 - 2027-01-02\n\n### Added\n\n- Cars have wheels.\n" in changes
    assert changes.index("## 9.0.0") < changes.index("## 0.1.0")
    assert not list((checkout / "changelog.d").glob("*.md"))
    assert "## 9.0.0" in (checkout / FILES[3]).read_text("utf-8")


@pytest.mark.parametrize(
    ("version", "message"), [("0.0.1", "not newer"), ("next", "not a version")]
)
def test_an_invalid_version_is_refused_before_anything_is_written(
    checkout: Path, version: str, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        release.prepare(checkout, version, date(2027, 1, 2))
    changed = subprocess.run(
        ["git", "status", "--short"], cwd=checkout, capture_output=True, check=True
    )
    assert changed.stdout == b""
