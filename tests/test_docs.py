"""The pages of docs, the changelog, and the generated site."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
import typer

from real2sim.cli import build_app
from real2sim_proto import HTTP_STATUS, RETRYABLE, ErrorCode
from tests.pages import BLOCK

REPOSITORY = Path(__file__).resolve().parents[1]
FOLDERS = (REPOSITORY, *(REPOSITORY / name for name in ("docs", "docs/extending", "docs/site")))
PAGES = sorted(page for folder in FOLDERS for page in folder.glob("*.md"))
LINK = re.compile(r"\[[^\]]*\]\(([^)\s#]+)(?:#[^)\s]*)?\)")
CALL = re.compile(r"(?:[A-Z_0-9]+=\S+ )*(?:\S*/bin/)?real2sim (.*)")
WITH_BLOCKS = [
    REPOSITORY / "README.md",
    *sorted(p for p in (REPOSITORY / "docs").rglob("*.md") if p.stem != "index"),
]
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
def test_links_between_pages_are_valid(page: Path) -> None:
    targets = [t for t in LINK.findall(page.read_text("utf-8")) if ":" not in t]
    missing = [t for t in targets if not (page.parent / t).exists()]
    assert missing == []


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(REPOSITORY)))
def test_every_page_is_on_the_site(page: Path) -> None:
    contents = (REPOSITORY / "docs/index.md").read_text("utf-8").split()
    name = page.relative_to(REPOSITORY).with_suffix("").as_posix().removeprefix("docs/")
    shown_as = name if page.parent != REPOSITORY else f"site/{name.lower()}"
    assert shown_as in contents or name in {"README", "index"}


def test_the_latest_changelog_entry_matches_the_version() -> None:
    texts = [(REPOSITORY / f / "pyproject.toml").read_text("utf-8") for f in ("client", ".")]
    sdk, server = (tomllib.loads(text)["project"] for text in texts)
    version = sdk["version"]
    assert server["version"] == version
    assert f"real2sim=={version}" in server["dependencies"]
    assert f"real2sim-server=={version}" in sdk["optional-dependencies"]["server"]
    heads = re.findall(r"^## (\S+)", (REPOSITORY / "CHANGELOG.md").read_text("utf-8"), re.M)
    assert heads[0] == version


def test_the_rest_page_lists_every_error_code_with_its_status() -> None:
    page = (REPOSITORY / "docs/rest.md").read_text("utf-8")
    rows = re.findall(r"^\| `([A-Z_]+)` \| (\d+) \| .+ \| (yes)? ?\|$", page, re.M)
    told = [(code, int(status), bool(again)) for code, status, again in rows]
    assert told == [(c.value, HTTP_STATUS[c], c in RETRYABLE) for c in ErrorCode]


@pytest.mark.slow
def test_the_site_builds_without_warnings_and_shows_no_internals(tmp_path: Path) -> None:
    folders = ["-d", tmp_path / "doctrees", REPOSITORY / "docs", tmp_path / "site"]
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", *folders]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    pages = {page: page.read_text("utf-8") for page in (tmp_path / "site").rglob("*.html")}
    assert tmp_path / "site" / "api" / "pages" / "real2sim.Scenario.html" in pages
    shown = {word for text in pages.values() for word in INTERNALS if word in text}
    assert shown == set()


def commands() -> Iterator[tuple[str, str]]:
    """All calls of ``real2sim`` in the blocks of a page."""
    for path in WITH_BLOCKS:
        for _, text in BLOCK.findall(path.read_text("utf-8")):
            for line in text.replace("\\\n", " ").splitlines():
                if (call := CALL.match(line)) is not None:
                    yield str(path.relative_to(REPOSITORY)), call.group(1)


@pytest.mark.parametrize(("where", "call"), list(commands()))
def test_every_command_in_the_docs_is_valid(where: str, call: str) -> None:
    """Command names and options exist."""
    context = click.Context(typer.main.get_command(build_app()), info_name="real2sim")
    arguments = [word for word in shlex.split(call, comments=True) if word != "&"]
    while isinstance(context.command, click.Group):
        name, command, arguments = context.command.resolve_command(context, arguments)
        context = click.Context(command, info_name=name, parent=context)
    context.command.make_parser(context).parse_args(arguments)


@pytest.mark.parametrize("path", WITH_BLOCKS, ids=lambda p: p.name)
def test_every_page_with_blocks_has_a_test(path: Path) -> None:
    opened = f'page("{path.relative_to(REPOSITORY)}")'
    tests = ("test_guides.py", "test_formats.py")
    told = any(opened in (REPOSITORY / "tests/server" / t).read_text("utf-8") for t in tests)
    assert told or not BLOCK.search(path.read_text("utf-8"))
