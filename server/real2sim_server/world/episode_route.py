"""The route of an episode, and what becomes of ego and objects beyond the log's end."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from real2sim_proto.episode import ResetSpec

from ..edit import ObjectState, ScenarioState
from ..edit.tracks import PackedTracks
from ..scene import Scene
from .beyond_log import Prolonged, at_start_again, driven_route, tracks_beyond_log
from .ego.motion import Motion
from .episode import EpisodeClock
from .path import LoggedPath, LoopTransform, PathPoint


class PutBack(NamedTuple):
    """An ego back at the start of a loop.

    Attributes:
        laps: that it has driven.
        way: length of them [m].
        motion, point: of the ego there, and along the route.
        seam: from where it was to where it is.
    """

    laps: int
    way: float
    motion: Motion
    point: PathPoint
    seam: LoopTransform


@dataclass(frozen=True, eq=False)
class EpisodeRoute:
    """Where an episode leads.

    Attributes:
        route: that everything is measured along.
        lap_length: way after which a loop begins anew; infinite where there is none [m].
        until_us: end of the episode where objects are there beyond the log; None where they are
            not [us].
    """

    route: LoggedPath
    lap_length: float
    until_us: int | None
    _prolonged: Prolonged = field(default_factory=dict)

    @classmethod
    def of(cls, scene: Scene, spec: ResetSpec, clock: EpisodeClock) -> EpisodeRoute:
        """The one of an episode on ``scene``.

        Raises:
            WorldError: INVALID_REQUEST for a loop on a recorded drive that is none.
        """
        loops = spec.beyond_log == "loop"
        return cls(
            route=driven_route(scene, spec, clock.horizon),
            lap_length=LoggedPath(scene.ego).length if loops else math.inf,
            until_us=None if spec.beyond_log == "end" else clock.at(clock.horizon),
        )

    def tracks(
        self, state: ScenarioState, *, left: Iterable[str] = ()
    ) -> PackedTracks[ObjectState]:
        """Where the recording and edits have the objects, without those that have ``left``."""
        if self.until_us is None:
            return state.tracks
        return tracks_beyond_log(state, self.until_us, self._prolonged, left=left)

    def put_back(self, motion: Motion, point: PathPoint) -> PutBack | None:
        """The ego of a loop, back at its start once it is at its end; None before."""
        laps = max(math.floor(point.s / self.lap_length), 0)
        if laps == 0:
            return None
        way = laps * self.lap_length
        again = at_start_again(motion, point, self.route, point.s - way)
        near = self.route.nearest(again.x, again.y, near_s=point.s - way)
        return PutBack(laps, way, again, near, LoopTransform.between(motion[:3], again[:3]))
