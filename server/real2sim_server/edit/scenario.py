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
"""States kept in memory; older ones are rebuilt from the log when an undo needs them."""


@dataclass(frozen=True, eq=False)
class LogEntry:
    """One revision.

    Attributes:
        revision: grows by one with each entry, from 1.
        kind: what it did.
        operations: of an edit; empty for an undo or redo. A log of thousands may hold them as
            read and check each only when it is looked at.
        target: revision of the edit that was undone or redone; None for an edit.
        created_at: UTC, ISO 8601.
        who: as the client named itself; empty where it did not.
    """

    revision: int
    kind: Literal["edit", "undo", "redo"]
    operations: Sequence[Operation]
    target: int | None
    created_at: str
    who: str = ""


@dataclass(frozen=True, eq=False)
class PlannedEntry:
    """An entry that may be stored, and what it leads to once committed."""

    entry: LogEntry
    outcome: EditOutcome


class Scenario:
    """State of a scenario, moved only by committing planned entries of its log.

    Planning changes nothing: store the entry, then commit it, so that nothing takes effect that
    is not on record. Undo returns to the very state before the edit, never by inverse arithmetic.
    Instance ids of copies that an undo took back may be given to later copies.

    Attributes:
        scene: name of the scene.
        scene_hash: its content hash.
        state: after all entries.
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
        """The scenario after ``entries``, bit for bit as it was when they were committed.

        Args:
            initial_state: before any edit.
            entries: the log, oldest first.
            scene: name of the scene.
            scene_hash: its content hash.
            known: a revision and the state after it, which spares applying what is before.

        Raises:
            EditError: INVALID_OPERATION when the entries are no complete log of this scene.
        """
        scenario = cls(initial_state, scene=scene, scene_hash=scene_hash)
        for entry in entries:
            scenario._append(entry)
            if known and entry.revision == known[0]:
                scenario._keep(len(scenario._done), known[1])
        scenario.state = scenario._state_after(len(scenario._done))
        return scenario

    def extended(self, entries: Iterable[LogEntry]) -> Scenario:
        """A scenario of its own that goes on from this one by entries that others have stored.

        Args:
            entries: of the log, those behind this scenario's revision, oldest first.

        Raises:
            EditError: they do not go on from here.
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
        """What ``operations`` would lead to.

        Args:
            operations: applied all, or none.
            base_revision: the revision they were made for; None for any.
            who: goes on record.

        Raises:
            EditError: STALE_REVISION when ``base_revision`` is not the current one; also as
                :func:`~.apply.apply_operations`.
        """
        self._refuse_stale(base_revision)
        outcome = apply_operations(self.state, operations)
        return PlannedEntry(self._entry("edit", tuple(operations), None, who), outcome)

    def plan_undo(self, *, base_revision: int | None = None, who: str = "") -> PlannedEntry:
        """What taking back the last edit in effect would lead to.

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
        """What bringing back the last undone edit would lead to.

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
        """Let a planned entry take effect; the outcome.

        Raises:
            EditError: STALE_REVISION when another entry was committed since it was planned.
        """
        self._append(planned.entry)
        # Kept for undo, but unlikely to be needed soon.
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
        """Book an entry; states are not touched, but those of another past are forgotten."""
        if entry.revision != self.revision + 1:
            raise EditError(
                ErrorCode.STALE_REVISION,
                f"entry {entry.revision} does not follow revision {self.revision}",
                hint="plan it again on the present state",
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
        """State after the first ``count`` edits in effect, from the nearest one kept.

        The last states on the way there are kept, so that undoing many edits one after the other
        does not begin from afar each time.
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
