"""Edits: typed operations onto objects, and scenarios as append-only logs of them."""

from .apply import EditOutcome, apply_operations, replay_operations
from .compose import cloud_of, compose, figure_of, instances_at, things_at_start, things_of
from .errors import EditError
from .ground_inpainting import vacated_parking
from .posed import posed_instances
from .scenario import LogEntry, PlannedEntry, Scenario
from .snapshot import pack_state, unpack_state
from .state import AssetLookup, AssetSource, ObjectState, ScenarioState
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
    "pack_state",
    "posed_instances",
    "replay_operations",
    "things_at_start",
    "things_of",
    "unpack_state",
    "vacated_parking",
]
