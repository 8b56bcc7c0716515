"""The architecture, as a test: a room imports only rooms below it."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
SERVER = REPOSITORY / "server" / "real2sim_server"

FLOORS = (
    "geometry",
    "scene",
    "render",
    "physics",
    "simulation",
    "logs",
    "synthetic",
    "reconstruct",
    "edit",
    "world",
    "service",
)
"""Rooms of the server, lowest first."""


def imported_modules(file: Path, package_root: Path) -> set[str]:
    """Absolute names of all modules a file imports, relative imports resolved."""
    package = list(file.relative_to(package_root.parent).with_suffix("").parts)
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level] if node.level else []
            names.add(".".join([*base, *([node.module] if node.module else [])]))
    return names


def python_files(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.py"))


@pytest.mark.parametrize("room", FLOORS)
def test_a_room_imports_no_room_above_it(room):
    higher = FLOORS[FLOORS.index(room) + 1 :]
    forbidden = tuple(f"real2sim_server.{name}" for name in (*higher, "cli", "settings"))
    if room == "service":
        forbidden = ("real2sim_server.cli",)
    for file in python_files(SERVER / room):
        for name in imported_modules(file, SERVER):
            assert not name.startswith(forbidden), f"{file.relative_to(SERVER)} imports {name}"


@pytest.mark.parametrize(
    ("package", "forbidden"),
    [
        ("proto/real2sim_proto", ("real2sim.", "real2sim_server", "torch", "fastapi", "numba")),
        ("client/real2sim", ("real2sim_server", "torch", "fastapi", "numba", "cv2")),
        ("server/real2sim_server", ("real2sim.",)),
    ],
)
def test_packages_meet_only_in_the_contract(package, forbidden):
    root = REPOSITORY / package
    allowed_bridges = {"cli", "demo", "benchmarks", "policies"}
    for file in python_files(root):
        if root.name == "real2sim_server" and allowed_bridges & set(file.relative_to(root).parts):
            continue
        for name in imported_modules(file, root):
            assert not f"{name}.".startswith(forbidden), f"{file.relative_to(root)} imports {name}"


def test_every_room_is_a_package_with_a_docstring():
    for room in FLOORS:
        init = SERVER / room / "__init__.py"
        if init.parent.is_dir():
            assert ast.get_docstring(ast.parse(init.read_text(encoding="utf-8"))), room
