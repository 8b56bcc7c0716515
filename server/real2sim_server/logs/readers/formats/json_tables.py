"""JSON files of logs: objects, and tables of rows with tokens; every failure is a LogError."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ...driving_log import LogError


def read_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
        LogError: the file is missing or no JSON.
    """
    try:
        return json.loads(path.read_bytes())
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise LogError(f"{path}: is no JSON file ({error})") from error


class Tables:
    """A folder of JSON tables, whose rows refer to each other by ``token``."""

    def __init__(self, folder: Path, names: Sequence[str]) -> None:
        """Read the tables ``names``. Raises LogError naming a file that is missing or wrong."""
        self._folder = folder
        self._rows: dict[str, list[_Row]] = {}
        self._by_token: dict[str, dict[str, _Row]] = {}
        for name in names:
            content = read_json(self.path(name))
            if not isinstance(content, list) or not all(isinstance(r, dict) for r in content):
                raise LogError(f"{self.path(name)}: expected a list of objects")
            rows = [_Row(r, self.path(name)) for r in content]
            if not all(isinstance(r["token"], str) for r in rows):
                raise LogError(f"{self.path(name)}: a token is no text")
            self._rows[name] = rows
            self._by_token[name] = {r["token"]: r for r in rows}

    def path(self, name: str) -> Path:
        """The file of a table."""
        return self._folder / f"{name}.json"

    def rows(self, name: str) -> Sequence[Mapping[str, Any]]:
        """All rows of a table."""
        return self._rows[name]

    def row(self, name: str, token: str) -> Mapping[str, Any]:
        """The row with a token. Raises LogError where there is none."""
        try:
            return self._by_token[name][token]
        except (KeyError, TypeError):
            raise LogError(f"{self.path(name)}: has no row with token {token!r}") from None


class _Row(dict[str, Any]):
    """A row that says which file lacks which key."""

    def __init__(self, content: Mapping[str, Any], path: Path) -> None:
        super().__init__(content)
        self._path = path

    def __missing__(self, key: str) -> Any:
        raise LogError(f"{self._path}: row {self.get('token')!r} has no {key!r}")
