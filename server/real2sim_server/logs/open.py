"""Opening of logs in any known format."""

from __future__ import annotations

from pathlib import Path

from .check import check_log, leave_out
from .driving_log import DrivingLog, LogError, damage_named
from .readers import READERS, LogReader


def open_log(
    path: str | Path, *, format: str | None = None, sequence: str | None = None
) -> DrivingLog:
    """Open the driving log in a folder or file.

    The headers of all images and sweeps are checked. Images, sweeps and other records that cannot
    be used are left out, and ``left_out`` of the log lists them.

    Args:
        path: the log's folder, or one up to two levels above it that contains no other log, such
            as the folder of an exported data set; or the file of a log that is a single file.
        format: a reader's name; by default the first reader that recognises the path.
        sequence: name of a drive in a folder with several; a single one is the default.

    Raises:
        LogError: the path is missing, the format is unknown, or the reader finds a problem.
    """
    given = Path(path)
    if not given.exists():
        raise LogError(
            f"{given}: no such file or folder; give the folder of a log, or the file of a log "
            f"that is a single file\n{_known_formats()}"
        )
    found, reader = _reader_for(given, format)
    with damage_named(f"{found} ({reader.name})"):
        log = reader.read(found, sequence=sequence)
        return leave_out(log, check_log(log, contents=False))


def _reader_for(given: Path, format_name: str | None) -> tuple[Path, LogReader]:
    """The folder or file of the log, and its reader."""
    for reader in READERS:
        if reader.name == format_name or (format_name is None and reader.recognises(given)):
            return given, reader
    if format_name is not None:
        raise LogError(f"unknown log format {format_name!r}\n{_known_formats()}")
    found: list[tuple[Path, LogReader]] = []
    for child in _subfolders(given):
        below = _recognised(child) or [one for c in _subfolders(child) for one in _recognised(c)]
        found += below
    if len(found) == 1:
        return found[0]
    if found:
        names = ", ".join(f"{path.relative_to(given)} ({reader.name})" for path, reader in found)
        raise LogError(f"{given}: contains several logs; open one of these folders: {names}")
    raise LogError(f"{given}: not a log of any known format\n{_known_formats()}")


def _subfolders(folder: Path) -> list[Path]:
    children = folder.iterdir() if folder.is_dir() else ()
    return sorted(child for child in children if child.is_dir())


def _recognised(folder: Path) -> list[tuple[Path, LogReader]]:
    return [(folder, reader) for reader in READERS if reader.recognises(folder)][:1]


def _known_formats() -> str:
    return "known formats:\n" + "\n".join(f"  {r.name}: {r.expects}" for r in READERS)
