"""Import of checkpoints of other systems as scenes. Code in a checkpoint is never executed."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from .checkpoint import CheckpointError, CheckpointOptions, ImportedScene, load_checkpoint
from .drivestudio import import_drivestudio
from .street_gaussians import import_street_gaussians

__all__ = [
    "CheckpointError",
    "CheckpointOptions",
    "ImportedScene",
    "import_checkpoint",
    "import_drivestudio",
    "import_street_gaussians",
]


def import_checkpoint(
    path: str | PathLike[str], options: CheckpointOptions | None = None
) -> ImportedScene:
    """Read a checkpoint of Street Gaussians or drivestudio; its keys identify the format.

    Raises:
        CheckpointError: another format, missing or mismatched parts, or a file that could only be
            read by executing code in it.
    """
    file = Path(path)
    state = load_checkpoint(file)
    if "models" in state:
        return import_drivestudio(file, options)
    if "background" in state or "actor_pose" in state:
        return import_street_gaussians(file, options)
    raise CheckpointError(
        f"{file}: holds {sorted(map(str, state))[:8]}; a Street Gaussians checkpoint has "
        "'background' and 'actor_pose', a drivestudio checkpoint 'models'"
    )
