"""A scenario: a scene and an append-only log of edits, undos and redos."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

from real2sim_proto import ErrorCode
from real2sim_proto.operations import Operation

from .apply import EditOutcome, apply_operations, replay_operations
from .state import EditError, ScenarioState

KEPT_STATES = 32
"""Number of cached states; undo rebuilds older ones from the log."""


@dataclass(frozen=True, eq=False)
class LogEntry:
    """One revision.

    Attributes:
        revision: increases by one with each entry, from 1.
        kind: edit, undo or redo.
        operations: operations of an edit; empty for an undo or redo. Long logs may store them
            unparsed and validate each on access.
        target: revision of the edit that was undone or redone; None for an edit.
        created_at: UTC, ISO 8601.
        who: name given by the client; empty without one.
    """

    revision: int
    kind: Literal["edit", "undo", "redo"]
    operations: Sequence[Operation]
    target: int | None
    created_at: str
    who: str = ""


@dataclass(frozen=True, eq=False)
class PlannedEntry:
    """A valid entry, and its result once committed."""

    entry: LogEntry
    outcome: EditOutcome


class Scenario:
    """State of a scenario, changed only by committing planned entries of its log.

    Planning changes nothing. Store the planned entry first, then commit it: every change is then on
    record. Undo restores the exact state before the edit and uses no inverse arithmetic. Instance
    ids of undone copies may be reused.

    Attributes:
        scene: name of the scene.
        scene_hash: its content hash.
        state: state after all entries.
        entries: the log, oldest first.
    """

    def __init__(self, state: ScenarioState, *, scene: str = "", scene_hash: str = "") -> None:
        self.scene = scene
        self.scene_hash = scene_hash
        self.state = state
        self.entries: list[LogEntry] = []
        self._done: list[LogEntry] = []
        self._undone: list[LogEntry] = []
        self._states: OrderedDict[int, ScenarioState] = OrderedDict({0: state})

    @classmethod
    def replay(
        cls,
        initial_state: ScenarioState,
        entries: Iterable[LogEntry],
        *,
        scene: str = "",
        scene_hash: str = "",
        known: tuple[int, ScenarioState] | None = None,
    ) -> Scenario:
        """The scenario after ``entries``, bit-identical to its state when they were committed.

        Args:
            initial_state: state before any edit.
            entries: the log, oldest first.
            scene: name of the scene.
            scene_hash: its content hash.
            known: a revision and the state after it, to skip earlier entries.

        Raises:
            EditError: INVALID_OPERATION if the entries are not a complete log of this scene.
        """
        scenario = cls(initial_state, scene=scene, scene_hash=scene_hash)
        for entry in entries:
            scenario._append(entry)
            if known and entry.revision == known[0]:
                scenario._keep(len(scenario._done), known[1])
        scenario.state = scenario._state_after(len(scenario._done))
        return scenario

    def extended(self, entries: Iterable[LogEntry]) -> Scenario:
        """A new scenario that continues this one with entries stored by others.

        Args:
            entries: entries of the log after this scenario's revision, oldest first.

        Raises:
            EditError: the entries do not continue this scenario.
        """
        longer = Scenario(self._states[0], scene=self.scene, scene_hash=self.scene_hash)
        longer.entries, longer._states = list(self.entries), self._states.copy()
        longer._done, longer._undone = list(self._done), list(self._undone)
        for entry in entries:
            longer._append(entry)
        longer.state = longer._state_after(len(longer._done))
        return longer

    @property
    def revision(self) -> int:
        """Number of entries so far."""
        return len(self.entries)

    @property
    def can_undo(self) -> bool:
        """Whether an edit is in effect."""
        return bool(self._done)

    @property
    def can_redo(self) -> bool:
        """Whether the last entries undid an edit."""
        return bool(self._undone)

    def plan_edit(
        self,
        operations: Sequence[Operation],
        *,
        base_revision: int | None = None,
        who: str = "",
    ) -> PlannedEntry:
        """Plan ``operations`` without applying them.

        Args:
            operations: operations, applied all or none.
            base_revision: revision that they are based on; None for any.
            who: name recorded in the log.

        Raises:
            EditError: STALE_REVISION if ``base_revision`` is not the current one; also the errors
                of :func:`~.apply.apply_operations`.
        """
        self._refuse_stale(base_revision)
        outcome = apply_operations(self.state, operations)
        return PlannedEntry(self._entry("edit", tuple(operations), None, who), outcome)

    def plan_undo(self, *, base_revision: int | None = None, who: str = "") -> PlannedEntry:
        """The result of undoing the last edit in effect.

        Raises:
            EditError: NOTHING_TO_UNDO or STALE_REVISION.
        """
        self._refuse_stale(base_revision)
        if not self._done:
            raise EditError(ErrorCode.NOTHING_TO_UNDO, "no edit is in effect; nothing to undo")
        edit = self._done[-1]
        state = self._state_after(len(self._done) - 1)
        outcome = EditOutcome(state=state, created=(), inverse=tuple(edit.operations), warnings=())
        return PlannedEntry(self._entry("undo", (), edit.revision, who), outcome)

    def plan_redo(
        self,
        *,
        base_revision: int | None = None,
        who: str = "",
    ) -> PlannedEntry:
        """The result of redoing the last undone edit.

        Raises:
            EditError: NOTHING_TO_REDO or STALE_REVISION.
        """
        self._refuse_stale(base_revision)
        if not self._undone:
            raise EditError(
                ErrorCode.NOTHING_TO_REDO,
                "no edit was undone since the last edit; nothing to redo",
            )
        edit = self._undone[-1]
        outcome = apply_operations(self.state, edit.operations)
        return PlannedEntry(self._entry("redo", (), edit.revision, who), outcome)

    def commit(self, planned: PlannedEntry) -> EditOutcome:
        """Commit a planned entry; returns its outcome.

        Raises:
            EditError: STALE_REVISION if another entry was committed after it was planned.
        """
        self._append(planned.entry)
        # Undo may need the old state, but probably not soon.
        self.state.forget_tracks()
        self.state = planned.outcome.state
        self._keep(len(self._done), self.state)
        return planned.outcome

    def edit(self, operations: Sequence[Operation], *, dry_run: bool = False) -> EditOutcome:
        """Plan and, unless ``dry_run``, commit an edit. Raises like :meth:`plan_edit`."""
        planned = self.plan_edit(operations)
        return planned.outcome if dry_run else self.commit(planned)

    def undo(self) -> EditOutcome:
        """Plan and commit an undo. Raises like :meth:`plan_undo`."""
        return self.commit(self.plan_undo())

    def redo(self) -> EditOutcome:
        """Plan and commit a redo. Raises like :meth:`plan_redo`."""
        return self.commit(self.plan_redo())

    def _refuse_stale(self, base_revision: int | None) -> None:
        if base_revision is not None and base_revision != self.revision:
            raise EditError(
                ErrorCode.STALE_REVISION,
                f"the edit was made for revision {base_revision}; the scenario is at "
                f"{self.revision}",
                hint=f"read the changes after {base_revision} and send the edit again",
            )

    def _entry(
        self,
        kind: Literal["edit", "undo", "redo"],
        operations: tuple[Operation, ...],
        target: int | None,
        who: str,
    ) -> LogEntry:
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        return LogEntry(self.revision + 1, kind, operations, target, now, who)

    def _append(self, entry: LogEntry) -> None:
        """Append an entry and drop cached states of another history."""
        if entry.revision != self.revision + 1:
            raise EditError(
                ErrorCode.STALE_REVISION,
                f"entry {entry.revision} does not follow revision {self.revision}",
                hint="plan the edit again on the current revision",
            )
        match entry.kind:
            case "edit":
                self._forget_states_after(len(self._done))
                self._done.append(entry)
                self._undone.clear()
            case "undo":
                self._undone.append(self._take(self._done, entry))
            case "redo":
                self._done.append(self._take(self._undone, entry))
        self.entries.append(entry)

    def _take(self, stack: list[LogEntry], entry: LogEntry) -> LogEntry:
        if not stack or stack[-1].revision != entry.target:
            raise EditError(
                ErrorCode.INVALID_OPERATION,
                f"the log is broken: its {entry.kind} {entry.revision} names edit {entry.target}",
                hint="the scenario cannot be rebuilt; start a new one",
            )
        return stack.pop()

    def _state_after(self, count: int) -> ScenarioState:
        """State after the first ``count`` edits in effect, computed from the nearest cached one.

        Caches the last states on the path to make repeated undo fast.
        """
        nearest = max(n for n in self._states if n <= count)
        state = self._states[nearest]
        for n, edit in enumerate(self._done[nearest:count], nearest + 1):
            state = replay_operations(state, edit.operations)
            if n > count - KEPT_STATES:
                self._keep(n, state)
        return state

    def _keep(self, count: int, state: ScenarioState) -> None:
        self._states[count] = state
        self._states.move_to_end(count)
        for old in list(self._states)[: max(0, len(self._states) - KEPT_STATES)]:
            if old:
                del self._states[old]

    def _forget_states_after(self, count: int) -> None:
        for later in [n for n in self._states if n > count]:
            del self._states[later]
