"""A change of a session's world on its way through the step pipeline, and how it gets on record."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from ...scene import Camera, Scene
from ...world import World
from .gathered_calls import attempt
from .log_write import LogWrite, write_together
from .segment import FrameSlot
from .wire import EncodedMessage, PhaseTimer


@dataclass(eq=False)
class Transition:
    """A change of a session's world on its way through the pipeline.

    Attributes:
        change: makes the new world, complete as far as images show it, and leaves the present one
            alone; runs off the event loop.
        cameras: of the world's sensors, by name, at the sizes they name.
        clouds: whether those of its LiDARs and radars are made.
        record: writes the log entry of the change; runs off the event loop, once the new world is
            evaluated. None where it is in the log already.
        write: hands a message to the socket if nothing has to be waited for; whether it did. None
            where no action waits for it. Runs on the event loop; nothing fails after it.
        slot: that raw images of the answer may be written to.
        timer: of the stages.
        recorded: whether ``record`` is done.
        sent: whether ``write`` is done.
        scene: with the steps of which other sessions this may be drawn; None for none.
        moved: the new world, kept where its images have to wait for kernels.
    """

    change: Callable[[], World]
    cameras: Mapping[str, Camera]
    clouds: bool = False
    record: Callable[[], object] | None = None
    write: Callable[[EncodedMessage], bool] | None = None
    slot: FrameSlot | None = None
    timer: PhaseTimer = field(default_factory=PhaseTimer)
    recorded: bool = False
    sent: bool = False
    scene: Scene | None = None
    moved: World | None = None


def record(transition: Transition) -> None:
    """Put a change on record."""
    if transition.record is not None:
        transition.record()
        transition.recorded = True


def record_together(transitions: Sequence[Transition]) -> dict[Transition, Exception]:
    """Put changes on record, together where that can be; those for which it failed."""
    writes = [t.record for t in transitions if t.record is not None]
    logs = [w for w in writes if isinstance(w, LogWrite) and not w.instead]
    if len(logs) == len(transitions) > 1:
        try:
            write_together(logs)
        except Exception:
            # Each then finds out for itself: the trouble of one is not that of the others.
            pass
        else:
            for transition in transitions:
                transition.recorded = True
            return {}
    failed: dict[Transition, Exception] = {}
    for transition in transitions:
        if isinstance(error := attempt(record, transition), Exception):
            failed[transition] = error
    return failed
