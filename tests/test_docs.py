"""The pages under docs, the changelog, and the site that is built from them."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from real2sim_proto import HTTP_STATUS, RETRYABLE, ErrorCode

REPOSITORY = Path(__file__).resolve().parents[1]
FOLDERS = (REPOSITORY, REPOSITORY / "docs", REPOSITORY / "docs/site")
PAGES = sorted(page for folder in FOLDERS for page in folder.glob("*.md"))
LINK = re.compile(r"\[[^\]]*\]\(([^)\s#]+)(?:#[^)\s]*)?\)")
INTERNALS = (
    "FieldInfo(",
    "PydanticUndefined",
    "TypeAliasForwardRef",
    "functools.",
    "model_config",
    "real2sim._async",
    "real2sim._sync",
)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(REPOSITORY)))
def test_links_of_a_page_lead_somewhere_in_the_repository(page: Path) -> None:
    targets = [t for t in LINK.findall(page.read_text("utf-8")) if ":" not in t]
    missing = [t for t in targets if not (page.parent / t).exists()]
    assert missing == []


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(REPOSITORY)))
def test_every_page_is_on_the_site(page: Path) -> None:
    contents = (REPOSITORY / "docs/index.md").read_text("utf-8").split()
    name = page.relative_to(REPOSITORY).with_suffix("").as_posix().removeprefix("docs/")
    shown_as = name if page.parent != REPOSITORY else f"site/{name.lower()}"
    assert shown_as in contents or name in {"README", "index"}


def test_the_newest_release_in_the_changelog_is_the_version() -> None:
    with (REPOSITORY / "pyproject.toml").open("rb") as file:
        version = tomllib.load(file)["project"]["version"]
    heads = re.findall(r"^## (\S+)", (REPOSITORY / "CHANGELOG.md").read_text("utf-8"), re.M)
    assert heads[:2] == ["Unreleased", version]


def test_the_rest_page_has_every_error_code_with_its_status() -> None:
    page = (REPOSITORY / "docs/rest.md").read_text("utf-8")
    rows = re.findall(r"^\| `([A-Z_]+)` \| (\d+) \| .+ \| (yes)? ?\|$", page, re.M)
    told = [(code, int(status), bool(again)) for code, status, again in rows]
    assert told == [(c.value, HTTP_STATUS[c], c in RETRYABLE) for c in ErrorCode]


def test_the_site_is_built_without_a_warning_and_shows_no_internals(tmp_path: Path) -> None:
    folders = ["-d", tmp_path / "doctrees", REPOSITORY / "docs", tmp_path / "site"]
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", *folders]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    pages = {page: page.read_text("utf-8") for page in (tmp_path / "site").rglob("*.html")}
    assert tmp_path / "site" / "api" / "pages" / "real2sim.Scenario.html" in pages
    shown = {word for text in pages.values() for word in INTERNALS if word in text}
    assert shown == set()
