"""Lane graphs as documents: the same JSON in ``lanes.json``, over REST and to clients."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from real2sim_proto.lanes import SceneLanes

from ..errors import BundleError, SceneError
from ..lane import Area, Lane, Signal, StopLine
from ..lane_graph import LaneGraph
from ..road import Road, RoadLane

_TABLES = {
    "lanes": Lane,
    "areas": Area,
    "stop_lines": StopLine,
    "signals": Signal,
    "roads": Road,
}
_HEAD = ("source", "accuracy", "geo_reference")
_ARRAYS = {
    **dict.fromkeys(("centre", "outline", "points"), "points"),
    **dict.fromkeys(("widths", "s", "headings", "rolls", "inner", "outer"), "values"),
}
MAX_BYTES = 512 << 20


def lane_document(graph: LaneGraph, *, with_roads: bool = True) -> SceneLanes:
    """The document of a graph.

    Args:
        graph: of a scene.
        with_roads: also tell the reference lines of roads.
    """
    tables = [name for name in _TABLES if with_roads or name != "roads"]
    parts = {name: [_values(p) for p in getattr(graph, name).values()] for name in tables}
    # Values come out of a checked graph; what they are for is known to the models alone.
    return SceneLanes.model_validate({key: getattr(graph, key) for key in _HEAD} | parts)


def graph_of(document: SceneLanes) -> LaneGraph:
    """The graph of a document.

    Raises:
        SceneError: it is well-formed but makes no graph; the message names the part.
    """
    tables = {
        name: [_part(kind, entry.model_dump()) for entry in getattr(document, name)]
        for name, kind in _TABLES.items()
    }
    return LaneGraph.of(**tables, **{key: getattr(document, key) for key in _HEAD})


def _values(part: Any) -> dict[str, Any]:
    found = {}
    for name in part.__dataclass_fields__:
        value = getattr(part, name)
        if isinstance(value, np.ndarray):
            value = value.tolist()
        elif isinstance(value, tuple):
            value = [_values(v) if isinstance(v, RoadLane) else v for v in value]
        found[name] = value
    return found


def _part(kind: type[Any], values: dict[str, Any]) -> Any:
    if kind is Road:
        values["lanes"] = tuple(RoadLane(**entry) for entry in values["lanes"])
    return kind(**values)


def read_lanes(path: Path) -> LaneGraph:
    """The graph in a file ``lanes.json``.

    Raises:
        BundleError: naming the file: missing, too large, no such document, or no graph.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise BundleError(f"{path}: is larger than {MAX_BYTES >> 20} MiB")
        return graph_of(SceneLanes.model_validate_json(path.read_bytes()))
    except OSError as error:
        raise BundleError(f"{path}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ".".join(str(part) for part in first["loc"])
        raise BundleError(f"{path}: no document of lanes: {place}: {first['msg']}") from error
    except SceneError as error:
        raise BundleError(f"{path}: {error}") from error


def pack(graph: LaneGraph) -> tuple[dict[str, Any], dict[str, NDArray[np.float64]]]:
    """A graph as its document with lengths in the place of arrays, and the arrays: ``points``
    [P, 3] and ``values`` [V], in the order of the document."""
    arrays: dict[str, list[Any]] = {"points": [], "values": []}

    def outline(value: Any, name: str = "") -> Any:
        if name in _ARRAYS:
            arrays[_ARRAYS[name]].extend(value)
            return len(value)
        if isinstance(value, dict):
            return {key: outline(entry, key) for key, entry in value.items()}
        return [outline(entry) for entry in value] if isinstance(value, list) else value

    document: dict[str, Any] = outline(lane_document(graph).model_dump(mode="json"))
    points = np.array(arrays["points"], dtype=np.float64).reshape(-1, 3)
    return document, {"points": points, "values": np.array(arrays["values"], np.float64)}


def unpack(document: Mapping[str, Any], arrays: Mapping[str, NDArray[np.float64]]) -> LaneGraph:
    """What :func:`pack` has packed.

    Raises:
        SceneError: lengths do not fit the arrays, or it is no graph.
    """
    taken = dict.fromkeys(arrays, 0)

    def filled(value: Any, name: str = "") -> Any:
        if name in _ARRAYS:
            source = _ARRAYS[name]
            first = taken[source]
            if type(value) is not int or not 0 <= value <= len(arrays[source]) - first:
                raise SceneError(f"lanes: {name} of {value!r} entries goes beyond their file")
            taken[source] += value
            return arrays[source][first : first + value].tolist()
        if isinstance(value, dict):
            return {key: filled(entry, key) for key, entry in value.items()}
        return [filled(entry) for entry in value] if isinstance(value, list) else value

    whole = filled(dict(document))
    if any(taken[name] != len(array) for name, array in arrays.items()):
        raise SceneError("lanes: their file holds more than scene.json tells of")
    try:
        return graph_of(SceneLanes.model_validate(whole))
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        raise SceneError(f"lanes: {first['loc']}: {first['msg']}") from error
