"""The scene folder: which bundles there are, and what is wrong with the others."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from real2sim_proto.base import ID_PATTERN

from ...scene import SceneError
from ...scene.io import SceneSummary, read_scene_summary

BUNDLE_SUFFIX = ".r2s"
SCENE_DOCUMENT = "scene.json"
_IDENTIFIER = re.compile(ID_PATTERN)


@dataclass(frozen=True)
class Listing:
    """One bundle folder.

    Attributes:
        name: of the scene in paths.
        path: its folder.
        summary: what it holds; None when it is broken.
        reason: why it is broken; None when it is not.
    """

    name: str
    path: Path
    summary: SceneSummary | None
    reason: str | None


Fingerprint = tuple[tuple[str, int, int], ...]


class SceneCatalog:
    """Looks into the scene folder; what did not change since the last look is not read again.

    Args:
        folder: of bundles; it need not exist.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._known: dict[Path, tuple[Fingerprint, Listing]] = {}
        self._lock = threading.Lock()

    def scan(self) -> dict[str, Listing]:
        """All bundles by scene name, in the order of their names."""
        with self._lock:
            return self._scan()

    def _scan(self) -> dict[str, Listing]:
        listings: dict[str, Listing] = {}
        seen: dict[Path, tuple[Fingerprint, Listing]] = {}
        for path in self._candidates():
            entry = self._look(path)
            seen[path] = entry
            listing = entry[1]
            if listing.name in listings:
                other = listings[listing.name].path.name
                reason = f"{path.name!r} and {other!r} are the same scene name; rename one"
                listing = Listing(path.name, path, None, reason)
            listings[listing.name] = listing
        self._known = seen
        return dict(sorted(listings.items()))

    def mark_broken(self, listing: Listing, reason: str) -> None:
        """Remember what only loading could find out, until the bundle changes."""
        broken = Listing(listing.name, listing.path, None, reason)
        with self._lock:
            self._known[listing.path] = (_fingerprint(listing.path), broken)

    def public(self, error: Exception) -> str:
        """The error's message without the place of the folder on this machine."""
        return str(error).replace(f"{self.folder}/", "")

    def _candidates(self) -> Iterator[Path]:
        if not self.folder.is_dir():
            return
        for path in sorted(self.folder.iterdir()):
            # Hidden folders are bundles that are just being written.
            if path.name.startswith(".") or not path.is_dir():
                continue
            if path.suffix == BUNDLE_SUFFIX or (path / SCENE_DOCUMENT).exists():
                yield path

    def _look(self, path: Path) -> tuple[Fingerprint, Listing]:
        fingerprint = _fingerprint(path)
        known = self._known.get(path)
        if known is not None and known[0] == fingerprint:
            return known
        return fingerprint, self._read(path)

    def _read(self, path: Path) -> Listing:
        name = path.name.removesuffix(BUNDLE_SUFFIX)
        try:
            if not _IDENTIFIER.match(name):
                raise SceneError(f"{name!r} cannot be a scene name; rename it to {ID_PATTERN}")
            summary = read_scene_summary(path)
            _check_sizes(path, summary)
        except (SceneError, OSError) as error:
            return Listing(name, path, None, self.public(error))
        return Listing(name, path, summary, None)


def bundle_folder(folder: Path, name: str) -> Path:
    """Where a new bundle of that name belongs."""
    return folder / f"{name}{BUNDLE_SUFFIX}"


def _fingerprint(path: Path) -> Fingerprint:
    """Names, sizes and times of the files: any change of the bundle changes it. What is hidden is
    no part of it."""
    try:
        entries = sorted(p for p in path.iterdir() if not p.name.startswith("."))
        stats = [(p.name, p.stat()) for p in entries]
    except OSError:
        return ()
    return tuple((name, s.st_size, s.st_mtime_ns) for name, s in stats)


def _check_sizes(path: Path, summary: SceneSummary) -> None:
    found = sum(p.stat().st_size for p in path.glob("*.safetensors"))
    if found < summary.nbytes:
        raise SceneError(
            f"{path}: cut short: scene.json lists {summary.nbytes} bytes of tensors, the folder "
            f"has {found}; copy the bundle again"
        )
