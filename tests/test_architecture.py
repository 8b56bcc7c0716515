"""Import rules between packages.

``ARCHITECTURE.md`` shows the same layers.
"""

from __future__ import annotations

import ast
import re
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
SERVER = "real2sim_server"
ROOTS = {
    "real2sim_proto": REPOSITORY / "proto" / "real2sim_proto",
    "real2sim": REPOSITORY / "client" / "real2sim",
    SERVER: REPOSITORY / "server" / SERVER,
}

LAYERS = (
    "_files",
    "console",
    "_numba",
    "_nvrtc",
    "_confined",
    "_npy",
    "_records",
    "settings",
    "geometry",
    "body",
    "scene",
    "render",
    "physics",
    "simulation",
    "logs",
    "synthetic",
    "maps",
    "edit",
    "reconstruct",
    "world",
    "executors",
    "scenarios",
    "datasets",
    "service",
    "demo",
    "policies",
    "sweeps",
    "learning",
    "cli",
)
"""Packages and modules of the server, lowest first. Each imports only earlier ones."""

PLAY_THEIR_OWN_USER = {"demo", "policies", "sweeps", "cli"}
"""Only these import the client SDK, because they act as clients of a worker."""

FORBIDDEN = {
    "real2sim_proto": {"real2sim", SERVER, "torch", "fastapi", "numba", "cv2"},
    "real2sim": {SERVER, "torch", "fastapi", "numba"},
}
"""Imports forbidden in the protocol and the SDK, at any level of a file."""


@cache
def modules() -> dict[str, Path]:
    """All modules of the three packages by dotted name. A package stands for its __init__."""
    found = {}
    for name, root in ROOTS.items():
        for path in sorted(root.rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            parts = parts[:-1] if parts[-1] == "__init__" else parts
            found[".".join((name, *parts))] = path
    return found


@cache
def imports(module: str) -> frozenset[str]:
    """Imports of a module, anywhere in it: project modules, and the full names of others."""
    path = modules()[module]
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    return imported_by(path.read_text(encoding="utf-8"), package)


def imported_by(source: str, package: str) -> frozenset[str]:
    """Imports of a file of ``package`` with the text ``source``.

    ``from . import x`` and ``from package import x`` count as module ``x`` if it exists.
    """
    names: set[str] = set()
    parts = package.split(".")
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = parts[: len(parts) - node.level + 1] if node.level else []
            origin = ".".join([*base, *([node.module] if node.module else [])])
            inner = (f"{origin}.{alias.name}" for alias in node.names)
            names |= {full if full in modules() else origin for full in inner}
    return frozenset(names)


def layer(module: str) -> str:
    """The package or module directly below ``real2sim_server`` that contains a module."""
    return module.split(".")[1]


def server_modules() -> list[str]:
    return [m for m in modules() if m.startswith(f"{SERVER}.")]


def service_order() -> list[str]:
    """Parts of the service, lowest first, from its docstring."""
    source = modules()[f"{SERVER}.service"].read_text(encoding="utf-8")
    stated = re.findall(r"(?m)^- (``.*?):", ast.get_docstring(ast.parse(source)) or "")
    return [name for line in stated for name in re.findall(r"``(\w+)``", line)]


def circle(edges: dict[str, set[str]]) -> list[str]:
    """Names along one cycle of the graph, or empty if there is none."""
    try:
        TopologicalSorter(edges).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def test_the_layers_cover_all_packages():
    there = {layer(name) for name in server_modules()}
    assert there == set(LAYERS)


@pytest.mark.parametrize("name", LAYERS)
def test_a_package_imports_only_lower_packages(name):
    above = set(LAYERS[LAYERS.index(name) + 1 :])
    wrong = [
        f"{module} imports {imported}"
        for module in server_modules()
        if layer(module) == name
        for imported in imports(module)
        if imported.startswith(f"{SERVER}.") and layer(imported) in above
    ]
    assert not wrong


def test_modules_have_no_import_cycles():
    edges = {m: {i for i in imports(m) if i in modules() and i != m} for m in modules()}
    assert not circle(edges)


@pytest.mark.parametrize(
    "package", ["physics", "reconstruct", "render", "scene", "service", "world"]
)
def test_folders_of_a_package_have_no_import_cycles(package):
    prefix = f"{SERVER}.{package}."
    edges: dict[str, set[str]] = {}
    for module in server_modules():
        if not module.startswith(prefix):
            continue
        own = module.removeprefix(prefix).split(".")[0]
        others = {
            name.removeprefix(prefix).split(".")[0]
            for name in imports(module)
            if name.startswith(prefix)
        }
        edges.setdefault(own, set()).update(others - {own})
    assert not circle(edges)


def test_the_service_lists_every_part():
    parts = {name.split(".")[2] for name in modules() if name.startswith(f"{SERVER}.service.")}
    assert set(service_order()) == parts


@pytest.mark.parametrize("part", service_order())
def test_a_part_of_the_service_imports_only_lower_parts(part):
    order = service_order()
    allowed = {*order[: order.index(part) + 1]}
    prefix = f"{SERVER}.service."
    wrong = [
        f"{module} imports {imported}"
        for module in modules()
        if module.startswith(prefix) and module.split(".")[2] == part
        for imported in imports(module)
        if imported.startswith(prefix) and imported.split(".")[2] not in allowed
    ]
    assert not wrong


@pytest.mark.parametrize("package", FORBIDDEN)
def test_protocol_and_sdk_do_not_import_the_worker(package):
    wrong = [
        f"{module} imports {imported}"
        for module in modules()
        if module.split(".")[0] == package
        for imported in imports(module)
        if imported.split(".")[0] in FORBIDDEN[package]
    ]
    assert not wrong


def test_only_packages_that_act_as_clients_import_the_sdk():
    wrong = [
        f"{module} imports {imported}"
        for module in server_modules()
        if layer(module) not in PLAY_THEIR_OWN_USER
        for imported in imports(module)
        if imported.split(".")[0] == "real2sim"
    ]
    assert not wrong


def test_every_package_has_a_docstring():
    silent = [
        name
        for name, path in modules().items()
        if path.name == "__init__.py"
        and not ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
    ]
    assert not silent


@pytest.mark.parametrize(
    "statement",
    [
        "from .. import world",
        "from ..world import World",
        "import real2sim_server.world",
        "from real2sim_server import world",
        "def later():\n    from .. import world",
    ],
)
def test_every_form_of_import_is_recognised(statement):
    assert f"{SERVER}.world" in imported_by(statement, f"{SERVER}.edit")
