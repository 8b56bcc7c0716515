"""Steps of several sessions on one scene, whose images are drawn in one go."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from ...scene import Camera
from .gathered_calls import attempt
from .observation import Described, EncodedObservation, RenderedObservation, describe
from .phases import Moved, StepPhases
from .transition import Transition, record_together
from .world_images import Images, WorldImages, deform

TOGETHER_PIXELS = 16_000_000
"""Of images that are drawn in one go: the first session waits for the last, some milliseconds."""
MOST_TOGETHER = 8
"""Steps with images that are made in one go."""


class JointDrawing:
    """Passes the phases of several steps together; on the engine's thread.

    Args:
        phases: of each.
        images: of their worlds.
    """

    def __init__(self, phases: StepPhases, images: WorldImages) -> None:
        self._phases = phases
        self._images = images

    def draw(
        self, transitions: Sequence[Transition]
    ) -> list[RenderedObservation | EncodedObservation | Exception]:
        """All phases of steps with images, drawn in one go; where one fails, the others go on."""
        if len(transitions) == 1:
            return [attempt(self._phases.compute, transitions[0])]
        for transition in transitions:
            transition.timer.stage("queue")
        begun = [attempt(self._phases.begin, transition) for transition in transitions]
        present = [moved for moved in begun if isinstance(moved, Moved)]
        for moved in present:
            moved.transition.timer.stage("world")
        evaluation = self._phases.evaluators.submit(self._evaluate_together, present)
        try:
            images = self._render_together(present)
        finally:
            evaluation.exception()  # waits
        finished = iter(map(self._completed, present, images, evaluation.result()))
        return [moved if isinstance(moved, Exception) else next(finished) for moved in begun]

    def _render_together(self, present: Sequence[Moved]) -> list[Images | Exception]:
        """Images of each world, its objects deformed first, or what was raised instead."""
        deformed = [attempt(deform, moved.world, moved.transition.timer) for moved in present]
        ready = [m for m, error in zip(present, deformed, strict=True) if error is None]
        found = iter(self._images.of_each([(m.world, m.sensors, m.cameras) for m in ready]))
        for moved in present:
            moved.transition.timer.stage("render")
        return [next(found) if error is None else error for error in deformed]

    def _evaluate_together(self, present: Sequence[Moved]) -> list[Described | Exception]:
        """As :meth:`evaluate` for each, their log entries put on record together."""
        failed: dict[Transition, Exception] = {}
        for moved in present:
            if isinstance(error := attempt(moved.world.evaluate), Exception):
                failed[moved.transition] = error
        failed |= record_together([m.transition for m in present if m.transition not in failed])
        return [
            failed[m.transition]
            if m.transition in failed
            else attempt(describe, m.world, m.sensors, m.cameras)
            for m in present
        ]

    def _completed(
        self,
        moved: Moved,
        images: Images | Exception,
        described: Described | Exception,
    ) -> RenderedObservation | EncodedObservation | Exception:
        for outcome in (described, images):
            if isinstance(outcome, Exception):
                return outcome
        assert not isinstance(images, Exception)
        assert not isinstance(described, Exception)
        return attempt(self._phases.observation, moved.transition, moved.world, images, described)


def share_of(cameras: Iterable[Camera]) -> float:
    """How much of what is drawn in one go is for a session with these cameras."""
    pixels = sum(camera.width * camera.height for camera in cameras)
    return max(pixels / TOGETHER_PIXELS, 1 / MOST_TOGETHER)
