"""``real2sim serve``: start a worker and stay in front."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from ..console import CommandError
from ..service import serve as worker
from ..settings import Settings


def run(*, overrides: Mapping[str, Any]) -> None:
    """Serve until stopped; ``overrides`` that are not None win over the environment."""
    given = {name: value for name, value in overrides.items() if value is not None}
    try:
        settings = Settings(**given)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        raise CommandError(f"setting {name}: {first['msg']} (given: {first['input']!r})") from error
    worker.run(settings)
