"""JSON files of maps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from .errors import MapError

MAX_BYTES = 512 << 20


def read_json(path: Path) -> dict[str, Any]:
    """The object in a file.

    Raises:
        MapError: no such file, too large, no JSON, no object.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise MapError(f"{path}: is larger than {MAX_BYTES >> 20} MiB, the most that is read")
        content = json.loads(path.read_bytes())
    except OSError as error:
        raise MapError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise MapError(f"{path}: is no JSON file ({error})") from error
    if not isinstance(content, dict):
        raise MapError(f"{path}: holds no JSON object")
    return content
