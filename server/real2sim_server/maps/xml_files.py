"""XML files that may promise anything."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path

from .errors import MapError

MAX_BYTES = 512 << 20


def read_xml(path: Path, root: str) -> ET.Element:
    """The root element of an XML file.

    Args:
        path: of the file.
        root: name that the element must have.

    Raises:
        MapError: no such file, too large, no XML, declares a document type, another root.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise MapError(f"{path}: is larger than {MAX_BYTES >> 20} MiB, the most that is read")
        data = path.read_bytes()
    except OSError as error:
        raise MapError(f"{path}: cannot be read ({error.strerror})") from error
    # Entities could blow a small file up to fill the memory, and no map needs any.
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise MapError(f"{path}: declares a document type or entities; maps have none")
    try:
        found = ET.fromstring(data)
    except (ET.ParseError, ValueError, LookupError) as error:
        raise MapError(f"{path}: is no XML file ({error})") from error
    if found.tag != root:
        raise MapError(f"{path}: its root is <{found.tag}>, expected <{root}>")
    return found


def head_of(path: Path, size: int = 4096) -> bytes:
    """First bytes of a file; empty where it cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(size)
    except OSError:
        return b""


def number(element: ET.Element, name: str, where: str, default: float | None = None) -> float:
    """A finite attribute; ``default`` where it is absent.

    Raises:
        MapError: absent without a default, no number, not finite.
    """
    text = element.get(name)
    if text is None and default is not None:
        return default
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not abs(value) < 1e12:
        given = "nothing" if text is None else repr(text[:80])
        raise MapError(f"{where}: {name} of <{element.tag}> must be a number, found {given}")
    return value


def integer(element: ET.Element, name: str, where: str) -> int:
    """A whole attribute. Raises MapError."""
    value = number(element, name, where)
    if value != int(value):
        raise MapError(f"{where}: {name} of <{element.tag}> must be whole, not {value}")
    return int(value)
