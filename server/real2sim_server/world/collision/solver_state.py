"""What the substeps of a step with collisions work on: bodies, contacts and what they exchanged."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from real2sim_proto.episode import ContactSpec, EgoSpec

from ..agents import Agents
from ..boxes import REAR_OVERHANG
from ..driving import Command
from ..ego.motion import Motion
from ..scoring.hazard import side_of_contact
from ..scoring.instant import Side
from .bodies import ImpactedObject
from .impact import MUTUAL_STIFFNESS, ImpactParticipant
from .manifold import Bodies, ContactImpulse, ContactManifold, contact_manifold, corners
from .obstacles import ObstacleGrid
from .pulse import Pulse
from .rigid_body import BodyProperties, BodyState

EGO = ""
"""Key of the ego among the bodies; no object has an empty id."""
BACKGROUND = "\0"


@dataclass(frozen=True, eq=False)
class CollisionStep:
    """A step of the clock before its collisions are solved.

    Attributes:
        t_us, dt_us: the step [us].
        motion, sliding: the ego, and whether physics moves it rather than its controller.
        advance: ``advance(motion, since_us, us)`` moves the ego by its controller.
        command: of the controller, in a motion so many microseconds after the start.
        spec, ego_size, contact: parameters.
        before, after: objects as their drivers move them; impacted ones among them.
        impacted: objects that physics moves, by id.
        ignored_pairs: bodies that overlapped without an impact; they do not collide.
        background: obstacles of the background; None where they are left out.
        height: ground height [m] at x, y.
        pulses: impacts under way, by the names of the two.
        ego_crush: by how much the ego's front and rear are shorter than they were [m].
    """

    t_us: int
    dt_us: int
    motion: Motion
    sliding: bool
    advance: Callable[[Motion, int, int], Motion]
    command: Callable[[Motion, int], Command]
    spec: EgoSpec
    ego_size: tuple[float, float, float]
    contact: ContactSpec
    before: Agents
    after: Agents
    impacted: Mapping[str, ImpactedObject]
    ignored_pairs: frozenset[frozenset[str]]
    background: ObstacleGrid | None
    height: Callable[[float, float], float]
    pulses: Mapping[tuple[str, str], Pulse] = field(default_factory=dict)
    ego_crush: tuple[float, float] = (0.0, 0.0)


@dataclass(eq=False)
class PairImpulse:
    """Impulse and energy that two bodies have exchanged in this step."""

    manifold: ContactManifold
    approach: float
    relative: float
    side: Side
    speeds: tuple[float, float]
    began_us: int
    participants: tuple[ImpactParticipant, ImpactParticipant | None]
    jx: float = 0.0
    jy: float = 0.0
    energy: float = 0.0
    masses: tuple[float, float] = (math.inf, math.inf)
    whole: float | None = None
    lost: float = 0.0
    stiffness: float = MUTUAL_STIFFNESS
    breadth: tuple[float, float] | None = None


class PrescribedMotion(NamedTuple):
    """How its driver moves an object through the step: places at the start and the end [m], yaw at
    the start and its change [rad], velocity [m/s] and turn rate [rad/s]."""

    start: tuple[float, float]
    end: tuple[float, float]
    yaw: float
    turn: float
    velocity: tuple[float, float]
    rate: float

    def after(self, fraction: float) -> BodyState:
        """The object after a fraction of the step."""
        (ax, ay), (bx, by), rest = self.start, self.end, 1 - fraction
        x, y = rest * ax + fraction * bx, rest * ay + fraction * by
        return BodyState(x, y, self.yaw + fraction * self.turn, *self.velocity, self.rate)


@dataclass(eq=False)
class SolverState:
    """Bodies by id while the substeps run; ``heights``: bottom and top of each box [m];
    ``earlier``: the bodies before the present substep, where what happens within it counts."""

    step: CollisionStep
    properties: dict[str, BodyProperties]
    bodies: dict[str, BodyState]
    prescribed: dict[str, PrescribedMotion]
    dynamic: set[str]
    heights: dict[str, tuple[float, float]]
    reaches: dict[str, float]
    impulses: dict[tuple[str, str], PairImpulse] = field(default_factory=dict)
    ignored_pairs: set[frozenset[str]] = field(default_factory=set)
    earlier: dict[str, BodyState] = field(default_factory=dict)
    now_us: int = 0
    pulses: dict[tuple[str, str], Pulse] = field(default_factory=dict)
    ego_crush: tuple[float, float] = (0.0, 0.0)


def bodies_of(state: SolverState, a: str, b: str) -> Bodies:
    """Two bodies as they are now; None for the background."""
    second = None if b == BACKGROUND else (state.bodies[b], state.properties[b])
    return (state.bodies[a], state.properties[a]), second


def masses_of(bodies: Bodies) -> tuple[float, float]:
    """Of both [kg]; infinite for the background."""
    first, second = bodies
    return first[1].mass, math.inf if second is None else second[1].mass


def pushed(
    bodies: Bodies, at: tuple[float, float], impulse: ContactImpulse
) -> tuple[tuple[BodyState, BodyState | None], float]:
    """Two bodies after an impulse on the first at a place, and the energy that was lost [J]."""
    (first, properties), second = bodies
    after = first.pushed(properties, *at, impulse.jx, impulse.jy)
    lost = first.energy(properties) - after.energy(properties)
    if second is None:
        return (after, None), lost
    other = second[0].pushed(second[1], *at, -impulse.jx, -impulse.jy)
    lost += second[0].energy(second[1]) - other.energy(second[1])
    return (after, other), lost


def pair_impulse(
    state: SolverState, pair: tuple[str, str], manifold: ContactManifold, *, approach: float
) -> PairImpulse:
    """What two bodies have exchanged so far; a new record where their contact begins."""
    exchanged = state.impulses.get(pair)
    if exchanged is None:
        first = (state.bodies[pair[0]], state.properties[pair[0]])
        vx, vy = first[0].vx, first[0].vy
        speeds: tuple[float, float] = (math.hypot(vx, vy), 0.0)
        side: Side = "stopped_track"
        if pair[1] != BACKGROUND:
            second = (state.bodies[pair[1]], state.properties[pair[1]])
            speeds = (speeds[0], math.hypot(second[0].vx, second[0].vy))
            vx, vy = vx - second[0].vx, vy - second[0].vy
            reversing = pair[0] == EGO and state.step.motion.reversing
            side = _side(first, second, speeds, reversing=reversing)
        participants = (
            _participant(state, pair[0]),
            None if pair[1] == BACKGROUND else _participant(state, pair[1]),
        )
        began_us = state.step.t_us + state.now_us
        relative = math.hypot(vx, vy)
        exchanged = PairImpulse(manifold, approach, relative, side, speeds, began_us, participants)
        state.impulses[pair] = exchanged
    return exchanged


def _participant(state: SolverState, i: str) -> ImpactParticipant:
    return ImpactParticipant(state.properties[i], state.bodies[i], *state.heights[i])


def _side(
    first: tuple[BodyState, BodyProperties],
    second: tuple[BodyState, BodyProperties],
    speeds: tuple[float, float],
    *,
    reversing: bool,
) -> Side:
    boxes = []
    for body, properties in (first, second):
        x = body.x + properties.box_ahead * math.cos(body.yaw)
        y = body.y + properties.box_ahead * math.sin(body.yaw)
        boxes.append((x, y, body.yaw, properties.length, properties.width))
    axle = boxes[0][3] / 2 - REAR_OVERHANG
    (ego, other), (ego_speed, speed) = boxes, speeds
    return side_of_contact(ego, ego_speed, other, speed, axle=axle, reversing=reversing)


def make_dynamic(state: SolverState, impacted_now: set[str]) -> None:
    """Let physics move bodies; those that they overlap already, other than in this contact, are
    ignored until they have parted."""
    for i in sorted(impacted_now):
        shape = corners(state.bodies[i], state.properties[i])
        for j in sorted(state.bodies.keys() - impacted_now - state.dynamic):
            reach = state.properties[i].length + state.properties[j].length
            near = math.dist(state.bodies[i][:2], state.bodies[j][:2]) < reach
            if (
                near
                and contact_manifold(shape, corners(state.bodies[j], state.properties[j]))
                is not None
            ):
                state.ignored_pairs.add(frozenset((i, j)))
    state.dynamic |= impacted_now
