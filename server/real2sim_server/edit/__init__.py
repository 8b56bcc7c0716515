"""Edits: typed operations on objects, and scenarios as append-only logs of operations."""

from .appearance import vacated_parking
from .apply import EditOutcome, apply_operations, replay_operations
from .compose import (
    cloud_of,
    compose,
    figure_of,
    instances_at,
    instances_at_start,
    instances_of,
    posed_instances,
)
from .scenario import LogEntry, PlannedEntry, Scenario
from .state import (
    AssetLookup,
    AssetSource,
    EditError,
    ObjectState,
    ScenarioState,
    pack_state,
    unpack_state,
)
from .tracks import PackedTracks, PlacedObjects

__all__ = [
    "AssetLookup",
    "AssetSource",
    "EditError",
    "EditOutcome",
    "LogEntry",
    "ObjectState",
    "PackedTracks",
    "PlacedObjects",
    "PlannedEntry",
    "Scenario",
    "ScenarioState",
    "apply_operations",
    "cloud_of",
    "compose",
    "figure_of",
    "instances_at",
    "instances_at_start",
    "instances_of",
    "pack_state",
    "posed_instances",
    "replay_operations",
    "unpack_state",
    "vacated_parking",
]
