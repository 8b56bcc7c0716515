"""A folder of a job as one file."""

from __future__ import annotations

import tarfile
from pathlib import Path

from .jobs import JobContext


def pack(folder: Path, archive: Path, context: JobContext) -> None:
    """Pack all files below a folder; the same bytes for the same files: without the day, the user
    or the rights. A file that is packed goes, so that the disk holds each once.

    Raises:
        JobCancelled: the job was cancelled.
    """
    with tarfile.open(archive, "w", format=tarfile.PAX_FORMAT) as tar:
        for path in sorted(p for p in folder.rglob("*") if p.is_file()):
            context.check()
            member = tarfile.TarInfo(str(path.relative_to(folder)))
            member.size, member.mtime, member.mode = path.stat().st_size, 0, 0o644
            with path.open("rb") as file:
                tar.addfile(member, file)
            path.unlink()
