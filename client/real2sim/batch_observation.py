"""What is seen of many worlds at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.drive_batch import (
    COMMANDS,
    EGO_COLUMNS,
    BatchObs,
    WorldDetail,
    WorldError,
    WorldEvent,
)

from .errors import MalformedReplyError

_COLUMN = {name: k for k, name in enumerate(EGO_COLUMNS)}


@dataclass(frozen=True, kw_only=True, eq=False)
class BatchObservation:
    """New instants of M worlds; every array has a row for each of ``worlds``.

    Attributes:
        worlds: [M] int64, their numbers.
        step, t_us, revision: [M] int64.
        ego: [M, 13] float64, columns as ``real2sim_proto.drive_batch.EGO_COLUMNS``.
        route: [M, R, 2] float64, x and y of the route ahead in the vehicle frame [m].
        command: ``straight``, ``left`` or ``right`` of each.
        metrics: [M] float64 by name; nan where a world has none.
        terminated, truncated, warming_up, reverse: [M] bool; ``reverse``: in reverse gear.
        lap: [M] int64.
        events: what happened in this step; ``world`` says where.
        details: why episodes ended, what was drawn, road users of privileged episodes.
        errors: worlds that stay where they are, and why; they have no row.
        timing: milliseconds by stage in the worker.

    Examples:
        >>> client = real2sim.connect()
        >>> with client.batch(scene="street", worlds=2) as batch:
        ...     obs = batch.reset(seeds=[1, 2], action="control")
        >>> obs.step.tolist(), obs.route.shape
        ([0, 0], (2, 20, 2))
    """

    worlds: NDArray[np.int64]
    step: NDArray[np.int64]
    t_us: NDArray[np.int64]
    revision: NDArray[np.int64]
    ego: NDArray[np.float64]
    route: NDArray[np.float64] = field(repr=False)
    command: Sequence[str]
    metrics: Mapping[str, NDArray[np.float64]] = field(repr=False)
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    warming_up: NDArray[np.bool_]
    lap: NDArray[np.int64]
    reverse: NDArray[np.bool_]
    events: Sequence[WorldEvent] = ()
    details: Sequence[WorldDetail] = ()
    errors: Sequence[WorldError] = ()
    timing: Mapping[str, float] = field(default_factory=dict, repr=False)

    @property
    def over(self) -> NDArray[np.bool_]:
        """Which episodes have ended, either way, [M].

        Examples:
            >>> obs.over.tolist()
            [False, False]
        """
        return self.terminated | self.truncated

    def of_ego(self, name: str) -> NDArray[np.float64]:
        """A column of ``ego`` by its name, [M].

        Raises:
            KeyError: no such column.

        Examples:
            >>> obs.of_ego("speed").round(2).tolist()
            [5.0, 5.0]
        """
        return self.ego[:, _COLUMN[name]]


def batch_observation_from_wire(obs: BatchObs) -> BatchObservation:
    """The observation in a message.

    Raises:
        MalformedReplyError: arrays of other shapes.
    """
    rows = len(obs.worlds)
    flat = (obs.step, obs.t_us, obs.revision, obs.command, obs.terminated, obs.truncated)
    flat += (obs.warming_up, obs.lap, obs.reverse, *obs.metrics.values())
    shapes = {np.shape(values) for values in flat} | {(rows,)}
    if len(shapes) > 1 or np.shape(obs.ego) != (rows, len(EGO_COLUMNS)):
        raise MalformedReplyError(f"arrays of a batch of {rows} worlds have shapes {shapes}")
    if np.ndim(obs.route) != 3 or np.shape(obs.route)[::2] != (rows, 2):
        raise MalformedReplyError(f"routes have shape {np.shape(obs.route)}, not [{rows}, R, 2]")
    return BatchObservation(
        worlds=obs.worlds,
        step=obs.step,
        t_us=obs.t_us,
        revision=obs.revision,
        ego=obs.ego,
        route=obs.route,
        command=[COMMANDS[k] for k in obs.command.tolist()],
        metrics=obs.metrics,
        terminated=obs.terminated,
        truncated=obs.truncated,
        warming_up=obs.warming_up,
        lap=obs.lap,
        reverse=obs.reverse,
        events=obs.events,
        details=obs.details,
        errors=obs.errors,
        timing=obs.timing,
    )
