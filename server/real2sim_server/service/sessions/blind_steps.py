"""Steps without images, made in one go on the thread of worlds."""

from __future__ import annotations

from collections.abc import Sequence

from ...world import World
from .gathered_calls import attempt
from .observation import EncodedObservation, RenderedObservation
from .phases import StepPhases
from .transition import Transition, record_together
from .wire import pack_members


class BlindSteps:
    """Passes the phases of several steps one after the other, their log entries in one transaction.

    Args:
        phases: of each.
    """

    def __init__(self, phases: StepPhases) -> None:
        self._phases = phases

    def compute(self, transitions: Sequence[Transition]) -> list[EncodedObservation | Exception]:
        """All phases of steps without images; where one fails, the others go on."""
        if len(transitions) == 1:
            return [attempt(self._compute_alone, transitions[0])]
        worlds = self._worlds_of(transitions)
        return [
            attempt(self._encode, transition, world) if isinstance(world, World) else world
            for transition, world in zip(transitions, worlds, strict=True)
        ]

    def _worlds_of(self, transitions: Sequence[Transition]) -> list[World | Exception]:
        worlds = [attempt(self._advance_and_evaluate, transition) for transition in transitions]
        moved = [t for t, w in zip(transitions, worlds, strict=True) if isinstance(w, World)]
        unrecorded = record_together(moved)
        return [unrecorded.get(t, w) for t, w in zip(transitions, worlds, strict=True)]

    def _compute_alone(self, transition: Transition) -> EncodedObservation:
        observation = self._phases.compute(transition)
        assert isinstance(observation, EncodedObservation)
        return observation

    def _advance_and_evaluate(self, transition: Transition) -> World:
        timer = transition.timer
        timer.stage("queue")
        world = self._phases.advance(transition)
        timer.stage("world")
        timer.stage("render")
        world.evaluate()
        return world

    def _encode(self, transition: Transition, world: World) -> EncodedObservation:
        members = pack_members(world.observe().obs_fields())
        transition.timer.stage("settle")
        rendered = RenderedObservation(world, (), (), "obs", members, transition.timer)
        return self._phases.encode(rendered, ())
