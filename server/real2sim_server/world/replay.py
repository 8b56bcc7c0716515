"""Episode logs and their bitwise replay."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pydantic import TypeAdapter

from real2sim_proto import decode, encode
from real2sim_proto.episode import ResetSpec
from real2sim_proto.operations import Operation
from real2sim_proto.plans import PLAN, Plan

from ..edit import ScenarioState
from ..scene import Scene
from .world import World

# --- Stored specs --------------------------------------------------------------------------------

# Also reads logs of earlier versions.

BEFORE: Mapping[str, Any] = {
    "ego": {
        "actuators": {"steering_lag": 0.0, "drive_lag": 0.0, "foreseen": False},
        "suspension": None,
        "max_reverse_speed": 0.0,
        "tracker_version": 1,
    },
    "contact": {
        "swept": False,
        "pulse": False,
        "residual_crush": False,
        "distributed": False,
        "progressive": False,
        "breakage": False,
        "weighed_by_height": False,
    },
}
"""Values for members that a log lacks, which reproduce the behaviour of earlier versions.

Logs store complete specs, so an absent member did not exist in the version that wrote the log. When
you add a member whose default changes an episode, add the value that preserves old episodes here.
"""


def stored_spec(fields: Mapping[str, Any]) -> ResetSpec:
    """The spec stored in a log, with the semantics of the version that wrote it.

    Raises:
        ValueError: invalid spec.
    """
    spec = ResetSpec.model_validate(_completed(fields, BEFORE))
    if fields.get("horizon") is None:
        # The replay ends with the log, even if the episode could continue.
        return spec.model_copy(update={"horizon": None})
    return spec


def _completed(fields: Mapping[str, Any], absent: Mapping[str, Any]) -> dict[str, Any]:
    """``fields``, with missing members taken from ``absent``."""
    found = dict(fields)
    for name, value in absent.items():
        if isinstance(value, Mapping):
            inner = found.get(name, {})
            if isinstance(inner, Mapping):
                found[name] = _completed(inner, value)
        else:
            found.setdefault(name, value)
    return found


KINDS = ("reset", "action", "edit", "agent", "snapshot", "restore", "stop")
_OPERATIONS: TypeAdapter[list[Operation]] = TypeAdapter(list[Operation])


@dataclass(frozen=True)
class Entry:
    """One request that took effect on a session.

    Attributes:
        kind: one of ``KINDS``.
        step: clock step at which it took effect.
        payload: msgpack, made by one of the functions below.
    """

    kind: str
    step: int
    payload: bytes


def reset_payload(spec: ResetSpec) -> bytes:
    """Payload of a reset."""
    return encode({"spec": spec.model_dump(mode="json")})


def plan_payload(plan: Plan | None) -> bytes:
    """Payload of a plan; None keeps the previous one. Equal plans have equal bytes."""
    return encode({"plan": None if plan is None else vars(plan)})


def action_payload(plan: Plan | None, *, latency_us: int = 0, missed: bool = False) -> bytes:
    """Payload of a step: plan, planning time, and whether it missed its deadline."""
    fields: dict[str, Any] = {"plan": None if plan is None else vars(plan)}
    if latency_us:
        fields["latency_us"] = latency_us
    if missed:
        fields["missed"] = True
    return encode(fields)


def edit_payload(operations: Sequence[Operation]) -> bytes:
    """Payload of an edit."""
    return encode({"operations": [o.model_dump(mode="json") for o in operations]})


def agent_payload(
    object_id: str, times_us: Sequence[int], poses: Sequence[tuple[float, float, float]]
) -> bytes:
    """Payload of a plan for an externally driven object."""
    fields = {"object_id": object_id, "times_us": list(times_us), "poses": [list(p) for p in poses]}
    return encode(fields)


def name_payload(name: str) -> bytes:
    """Payload of a snapshot or of its restore."""
    return encode({"name": name})


def stop_payload(reason: str) -> bytes:
    """Payload of a stop without a step."""
    return encode({"reason": reason})


KEPT_PLAN = action_payload(None)
"""Payload of an action that keeps the previous plan."""


@dataclass(eq=False)
class Replayer:
    """A session replayed from its entries.

    Attributes:
        begin: creates the world of an episode.
        world: world after the entries so far; None before the first reset. Never modified in place.
        snapshots: snapshots by name.
    """

    begin: Callable[[ResetSpec], World]
    world: World | None = None
    snapshots: dict[str, World] = field(default_factory=dict)

    @classmethod
    def on(cls, scene: Scene, state: ScenarioState) -> Replayer:
        """A replayer on a scene, with the objects at session creation."""
        return cls(lambda spec: World(scene, state, spec))

    def apply(self, entry: Entry) -> World:
        """The world after one more entry.

        Raises:
            ValueError: inconsistent entries, or an entry of an unknown kind.
            WorldError, EditError: the entry is rejected.
        """
        fields = decode(entry.payload)
        if entry.kind == "reset":
            self.world = self.begin(recorded_spec(entry))
            return self.world
        if self.world is None:
            raise ValueError(f"a log cannot begin with {entry.kind!r}; a reset comes first")
        if entry.kind == "restore":
            self.world = self.snapshots[fields["name"]]
            return self.world
        if entry.kind == "snapshot":
            self.snapshots[fields["name"]] = self.world
            return self.world
        self.world = self.world.fork()
        _apply_entry(self.world, entry.kind, fields)
        return self.world


def recorded_spec(reset: Entry) -> ResetSpec:
    """The spec of a recorded episode, see :func:`stored_spec`."""
    return stored_spec(decode(reset.payload)["spec"])


def _apply_entry(world: World, kind: str, fields: dict[str, Any]) -> None:
    match kind:
        case "action":
            plan = None if fields["plan"] is None else PLAN.validate_python(fields["plan"])
            world.step(
                plan,
                latency_us=fields.get("latency_us", 0),
                missed=fields.get("missed", False),
            )
        case "edit":
            world.apply(_OPERATIONS.validate_python(fields["operations"]))
        case "agent":
            poses = [(x, y, yaw) for x, y, yaw in fields["poses"]]
            world.set_agent_plan(fields["object_id"], fields["times_us"], poses)
        case "stop":
            world.stop(fields["reason"])
        case _:
            raise ValueError(f"a log entry of kind {kind!r}; known are {', '.join(KINDS)}")


def no_action_impact(replayer: Replayer, entries: Sequence[Entry]) -> float:
    """Relative speed [m/s] at the first contact if the ego follows the recorded drive.

    v_r of NeuroNCAP; 0 without contact. Edits and other agents are as in ``entries``.

    Args:
        replayer: new replayer on the same scene.
        entries: entries of the episode, its reset first.
    """
    first, *rest = entries
    spec = recorded_spec(first)
    steady = spec.model_copy(update={"on_collision": "terminate", "deadline_ms": None})
    world = replayer.begin(steady)
    requests: dict[int, list[Entry]] = {}
    for entry in rest:
        if entry.kind in {"edit", "agent"}:
            requests.setdefault(entry.step, []).append(entry)
    while not world.over:
        for entry in requests.get(world.steps, ()):
            _apply_entry(world, entry.kind, decode(entry.payload))
        for event in world.step():
            if event.type == "collision":
                return event.data["relative_speed"]
    return 0.0


def last_episode(entries: Sequence[Entry]) -> list[Entry]:
    """The entries from the last reset."""
    resets = [k for k, e in enumerate(entries) if e.kind == "reset"]
    return list(entries[resets[-1] :]) if resets else []
