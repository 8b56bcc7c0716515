"""Fault of the ego in a contact, after nuPlan."""

from __future__ import annotations

from .instant import VEHICLES, VRU, ContactRecord


def ego_at_fault(record: ContactRecord, off_lane: bool) -> bool:
    """Whether the ego is at fault (nuPlan): it ran into something, or left its lane for it."""
    if record.side in {"front", "stopped_track"}:
        return True
    return record.side == "lateral" and off_lane


def fault_class(category: str) -> str:
    """``vru``, ``vehicle`` or ``object``."""
    if category in VRU:
        return "vru"
    return "vehicle" if category in VEHICLES else "object"
