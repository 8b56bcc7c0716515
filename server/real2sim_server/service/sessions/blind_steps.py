"""Steps without images, made in one go on the thread of worlds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import groupby
from typing import Any, TypeVar

from ...world import World
from ..accounts import counted_world_time
from .gathered_calls import attempt
from .observation import EncodedObservation, RenderedObservation
from .phases import StepPhases
from .transition import Transition, record_together
from .wire import pack_members

T = TypeVar("T")


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
            return _counted(self._compute_alone, [(transitions[0],)])
        worlds = self._worlds_of(transitions)
        pairs = zip(transitions, worlds, strict=True)
        encoded = iter(_counted(self._encode, [p for p in pairs if isinstance(p[1], World)]))
        return [next(encoded) if isinstance(world, World) else world for world in worlds]

    def _worlds_of(self, transitions: Sequence[Transition]) -> list[World | Exception]:
        worlds = _counted(self._advance_and_evaluate, [(transition,) for transition in transitions])
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


def _counted(fn: Callable[..., T], calls: Iterable[tuple[Any, ...]]) -> list[T | Exception]:
    """A part of several steps on the thread of worlds, its time counted for whoever asked for it;
    the transaction of several steps counts for nobody.

    ``calls`` are arguments of ``fn``, the transition first. Those of one account in a row are
    counted in one go: every look at the clock of the processor is a call of the system.
    """
    found: list[T | Exception] = []
    for account, run in groupby(calls, key=lambda call: call[0].account):
        found += counted_world_time(account, _attempts, fn, list(run))
    return found


def _attempts(fn: Callable[..., T], calls: Sequence[tuple[Any, ...]]) -> list[T | Exception]:
    return [attempt(fn, *call) for call in calls]
