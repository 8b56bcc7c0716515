"""Catalogs: entries of other files that a scenario refers to."""

from __future__ import annotations

from pathlib import Path

from ..errors import ScenarioError
from .elements import Part, RawElement, Scope, read_elements
from .parameters import declared

KINDS = {
    "VehicleCatalog": "Vehicle",
    "PedestrianCatalog": "Pedestrian",
    "MiscObjectCatalog": "MiscObject",
    "ControllerCatalog": "Controller",
    "EnvironmentCatalog": "Environment",
    "ManeuverCatalog": "Maneuver",
    "TrajectoryCatalog": "Trajectory",
    "RouteCatalog": "Route",
}
MAX_FILES = 1000


class Catalogs:
    """Entries by catalog and name, of the folders that a scenario names.

    Args:
        folder: of the scenario; nothing outside of the folders that it names is read.
        leave_out: see :func:`.elements.read_elements`.
    """

    def __init__(self, folder: Path | None, leave_out: frozenset[str]) -> None:
        self._folder, self._leave_out = folder, leave_out
        self._entries: dict[tuple[str, str, str], tuple[RawElement, str]] = {}
        self.used: list[tuple[RawElement, str]] = []

    def read(self, part: Part) -> None:
        """The files of ``CatalogLocations``. Raises ScenarioError."""
        for location in part.children():
            if location.tag not in KINDS:
                raise location.refused(KINDS)
            path = location.child("Directory").text("path")
            for file in self._files(location, path):
                self._read_file(file)

    def entry(self, part: Part, kind: str) -> Part:
        """The entry that a ``CatalogReference`` names, with its parameters assigned."""
        catalog, name = part.text("catalogName"), part.text("entryName")
        found = self._entries.get((kind, catalog, name))
        if found is None:
            # Some files name the catalog's kind or file instead.
            by_name = [v for (k, _, n), v in self._entries.items() if (k, n) == (kind, name)]
            found = by_name[0] if len(by_name) == 1 else None
        if found is None:
            known = sorted(f"{c}/{n}" for k, c, n in self._entries if k == kind)
            there = ", ".join(known) or "none"
            raise part.error(f"no catalog has the {kind} {catalog}/{name}; there are: {there}")
        raw, file = found
        self.used.append(found)
        raw.is_read = True
        assigned = part.find("ParameterAssignments")
        given = {
            a.text("parameterRef"): a.raw.attributes["value"]
            for a in (assigned.children("ParameterAssignment") if assigned is not None else [])
            if a.text("value") is not None
        }
        texts = {name: part.scope.expression(text) for name, text in given.items()}
        values = {name: part.scope.value(text) for name, text in given.items()}
        entry = Part(raw, file, Scope({}, {}))
        return entry.within(declared(entry.find("ParameterDeclarations"), texts, values))

    def _files(self, part: Part, path: str) -> list[Path]:
        if self._folder is None:
            raise part.error(f"catalogs in {path!r} cannot be read: the file came alone")
        folder = (self._folder / path).resolve()
        if not folder.is_dir():
            raise part.error(f"there is no folder {path!r} of catalogs beside the scenario")
        files = sorted(folder.glob("*.xosc"))
        if len(files) > MAX_FILES:
            raise part.error(f"folder {path!r} holds more than {MAX_FILES} catalogs")
        return files

    def _read_file(self, file: Path) -> None:
        try:
            root = read_elements(file.read_bytes(), file.name, self._leave_out)
        except OSError as error:
            raise ScenarioError(f"{file.name}: cannot be read ({error.strerror})") from error
        for catalog in (c for c in root.children if c.tag == "Catalog"):
            name = catalog.attributes.get("name", "")
            for raw in catalog.children:
                entry = raw.attributes.get("name", "")
                self._entries.setdefault((raw.tag, name, entry), (raw, file.name))
