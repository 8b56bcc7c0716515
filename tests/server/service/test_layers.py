"""The parts of the service import only those before them."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import real2sim_server.service

FOLDER = Path(real2sim_server.service.__file__).parent
ORDER = [
    name
    for line in re.findall(r"(?m)^- (``.*?):", real2sim_server.service.__doc__ or "")
    for name in re.findall(r"``(\w+)``", line)
]
"""As the package's docstring states it."""

APART = {"logging_setup", "write_openapi"}
"""Modules for whoever starts a program; nothing of the service imports them but ``serve``."""


def imports_of(path: Path) -> Iterator[str]:
    """Parts of the service that a file imports."""
    package = path.relative_to(FOLDER).parts[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.ImportFrom) or not node.level:
            continue
        if node.level > len(package) + 1:
            continue
        base = package[: len(package) - node.level + 1]
        target = [*base, *(node.module.split(".") if node.module else ())]
        yield from [target[0]] if target else [alias.name for alias in node.names]


def test_the_docstring_lists_every_part():
    parts = {p.name for p in FOLDER.iterdir() if p.is_dir() and p.name not in {"ui", "__pycache__"}}
    modules = {p.stem for p in FOLDER.glob("*.py")} - {"__init__"}
    assert set(ORDER) == parts | modules - APART


@pytest.mark.parametrize("part", ORDER)
def test_a_part_imports_only_those_before_it(part):
    files = [*(FOLDER / part).rglob("*.py")] or [FOLDER / f"{part}.py"]
    allowed = {*ORDER[: ORDER.index(part) + 1]} | ({"logging_setup"} if part == "serve" else set())
    for path in files:
        assert set(imports_of(path)) <= allowed, path
