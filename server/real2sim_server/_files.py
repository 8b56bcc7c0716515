"""Files and folders that appear whole or not at all, and text files as people have them."""

from __future__ import annotations

import codecs
import errno
import os
import re
import secrets
import shutil
import tarfile
import time
import xml.etree.ElementTree as ET
import xml.parsers.expat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

_TEMPORARY = re.compile(r"\.(?P<name>.+)\.(?P<purpose>tmp|old)-[0-9a-f]{12}")
"""Names made by :func:`_sibling`."""


def read_text(path: Path) -> str:
    """The text of a file, with ``\\n`` at the ends of lines.

    Accepts UTF-8 with or without a byte order mark, UTF-16 with one, and any line ends.

    Raises:
        OSError: it cannot be read.
        UnicodeDecodeError: it is not text.
    """
    data = path.read_bytes()
    utf16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    text = data.decode("utf-16" if utf16 else "utf-8-sig")
    return text.replace("\r\n", "\n").replace("\r", "\n")


MAX_XML_BYTES = 512 << 20
_DECLARATION = re.compile(r"<\?xml\s.*?\?>", re.DOTALL)
_BEFORE_DECLARATION = re.compile(
    rb"(?:\xef\xbb\xbf)?((?>\s+|<!--.*?-->)++)(<\?xml\s.*?\?>)", re.DOTALL
)


def read_xml(path: Path) -> ET.Element:
    """The root element of an XML file; names of its namespace are plain names.

    Accepts what :func:`xml_data` accepts. Elements of other namespaces keep theirs.

    Raises:
        OSError: it cannot be read.
        ValueError: it is larger than 512 MiB, not XML, or declares a document type.
    """
    if path.stat().st_size > MAX_XML_BYTES:
        raise ValueError(f"is larger than {MAX_XML_BYTES >> 20} MiB, the most that is read")
    try:
        root = ET.fromstring(xml_data(path.read_bytes()))
    except (ET.ParseError, xml.parsers.expat.ExpatError, LookupError) as error:
        # A LookupError comes from an encoding that Python does not have.
        raise ValueError(f"is not an XML file ({error})") from error
    namespace, brace, _ = root.tag.rpartition("}")
    if brace:
        for element in root.iter():
            element.tag = element.tag.removeprefix(namespace + brace)
    return root


def xml_data(data: bytes) -> bytes:
    """The content of an XML file as parsers accept it; lines keep their numbers.

    Accepts a byte order mark, UTF-16 with any declared encoding, and white space or comments before
    the declaration.

    Raises:
        ValueError: it declares a document type. Its entities could expand a small file until it
            fills the memory.
        xml.parsers.expat.ExpatError, LookupError: its beginning is not XML.
    """
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        data = _DECLARATION.sub("", data.decode("utf-16", "replace"), count=1).encode()
    if before := _BEFORE_DECLARATION.match(data):
        data = before[2] + before[1] + data[before.end() :]
    _check_prolog(data)
    return data


class _RootReached(Exception):
    """The first element begins, so that no document type follows."""


def _check_prolog(data: bytes) -> None:
    def refuse(*_: Any) -> None:
        raise ValueError("declares a document type or entities, which are not read")

    def end(*_: Any) -> None:
        raise _RootReached

    parser = xml.parsers.expat.ParserCreate()
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    parser.StartElementHandler = end
    with suppress(_RootReached):
        parser.Parse(data, True)


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """A binary file to write that takes the place of ``path`` when the block ends without error.

    Raises:
        OSError: when the folder cannot be written to.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _sibling(path, "tmp")
    try:
        with temporary.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """A new folder to fill that takes the place of ``path`` when the block ends without error.

    Where ``path`` exists, it is moved aside first and moved back should the new one not get in.

    Raises:
        OSError: when the parent folder cannot be written to.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _sibling(path, "tmp")
    temporary.mkdir()
    try:
        yield temporary
        _flush_folder(temporary)
        _exchange(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def sweep_leftovers(folder: Path, *, unused_s: float, prefix: str | None = None) -> list[Path]:
    """Remove unfinished files of killed programs from a folder; returns the removed paths.

    A folder that was moved aside is moved back if its original path is free.

    Args:
        folder: to scan; it need not exist.
        unused_s: only entries without writes for this many seconds are removed.
        prefix: of hidden names to remove, instead of the names made by this module.
    """
    removed = []
    for path in sorted(folder.glob(".*")):
        made = None if prefix else _TEMPORARY.fullmatch(path.name)
        if made is None and not (prefix and path.name.startswith(prefix)):
            continue
        try:
            if time.time() - _last_written(path) < unused_s:
                continue
            if made and made["purpose"] == "old" and not (folder / made["name"]).exists():
                path.rename(folder / made["name"])
                continue
            shutil.rmtree(path) if path.is_dir() else path.unlink()
            removed.append(path)
        except OSError:
            # Gone meanwhile, or not ours to remove.
            continue
    return removed


def _last_written(path: Path) -> float:
    """Last modification of a file, or of anything in a folder [s since 1970]."""
    below = path.rglob("*") if path.is_dir() else ()
    times: list[float] = [entry.lstat().st_mtime for entry in (path, *below)]
    return max(times)


def _exchange(new: Path, path: Path) -> None:
    if not path.exists():
        new.rename(path)
        return
    aside = _sibling(path, "old")
    _move(path, aside)
    try:
        new.rename(path)
    except BaseException:
        aside.rename(path)
        raise
    shutil.rmtree(aside, ignore_errors=True)


def _move(folder: Path, target: Path) -> None:
    try:
        folder.rename(target)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
        # In a container, folders of an image layer can be copied and removed, but not renamed.
        shutil.copytree(folder, target, symlinks=True)
        shutil.rmtree(folder)


def _flush_folder(folder: Path) -> None:
    for file in folder.iterdir():
        descriptor = os.open(file, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _sibling(path: Path, purpose: str) -> Path:
    """A hidden name next to ``path``: on the same file system, so that renaming is atomic."""
    return path.parent / f".{path.name}.{purpose}-{secrets.token_hex(6)}"


def unpack_tar(tar: tarfile.TarFile, folder: Path, *, members: Iterable[tarfile.TarInfo]) -> None:
    """Write files and folders of an archive below ``folder``; other users cannot write them.

    Like ``extractall(filter="data")``, which Python has from 3.11.4 on.

    Raises:
        tarfile.ExtractError: a link, a device, or a name outside ``folder``.
        OSError: the folder cannot be written.
    """
    for member in members:
        path = PurePosixPath(member.name)
        if path.is_absolute() or ".." in path.parts:
            raise tarfile.ExtractError(f"{member.name!r} leads out of the folder")
        target = folder / path
        if member.isdir():
            target.mkdir(parents=True, exist_ok=True)
            continue
        content = tar.extractfile(member) if member.isfile() else None
        if content is None:
            raise tarfile.ExtractError(f"{member.name!r} is neither a file nor a folder")
        target.parent.mkdir(parents=True, exist_ok=True)
        with content, target.open("xb") as file:
            os.fchmod(file.fileno(), member.mode & 0o755)
            shutil.copyfileobj(content, file)
