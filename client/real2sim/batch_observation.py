"""What is seen of many worlds at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

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
from real2sim_proto.drive_batch import BatchImages as WireImages

from .errors import MalformedReplyError
from .images import Image

_COLUMN = {name: k for k, name in enumerate(EGO_COLUMNS)}


@dataclass(frozen=True, kw_only=True, eq=False)
class BatchImages:
    """Images of one camera and modality in those worlds that show it now, all of one form.

    Attributes:
        sensor: name of the camera.
        modality, codec, dtype, shape: of each, as of :class:`Image`.
        worlds: [I] int64, whose images these are.
        K: [3, 3] float64 intrinsics [px].
        T_world_sensor: [I, 4, 4] float64, camera frame to world.
        ends: where each image ends in ``data`` [bytes].
        data: encoded bytes of all, one after the other.

    Examples:
        >>> client = real2sim.connect()
        >>> with client.batch(scene="street", worlds=2) as batch:
        ...     obs = batch.reset(sensors=["front"], action="control")
        >>> obs.images[0].sensor, obs.images[0].array.shape
        ('front', (2, 64, 96, 3))
    """

    sensor: str
    modality: str
    codec: str
    dtype: str
    shape: tuple[int, ...]
    worlds: NDArray[np.int64]
    K: NDArray[np.float64] = field(repr=False)
    T_world_sensor: NDArray[np.float64] = field(repr=False)
    ends: Sequence[int] = field(repr=False)
    data: bytes = field(repr=False)

    @cached_property
    def array(self) -> NDArray[Any]:
        """All of them as one array [I, H, W, 3] or [I, H, W], decoded at the first use; of codec
        ``raw`` a read-only view of ``data``.

        Raises:
            ImageDecodeError: as of :class:`Image`.

        Examples:
            >>> obs.images[0].array.dtype
            dtype('uint8')
        """
        if self.codec == "raw":
            return self._image(self.data, (len(self.ends), *self.shape)).array
        return np.stack([self.image(k).array for k in range(len(self.ends))])

    def image(self, k: int) -> Image:
        """The k-th of them.

        Examples:
            >>> obs.images[0].image(1).array.shape
            (64, 96, 3)
        """
        begin = self.ends[k - 1] if k else 0
        return self._image(self.data[begin : self.ends[k]], self.shape)

    def _image(self, data: bytes, shape: tuple[int, ...]) -> Image:
        form = {"codec": self.codec, "modality": self.modality, "dtype": self.dtype}
        return Image(data=data, shape=shape, **form)


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
        images: of the sensors that are due, those of one form side by side.
        events: what happened in this step; ``world`` says where.
        details: why episodes ended, what was drawn, road users of privileged episodes.
        errors: worlds that stay where they are, and why; they have no row.
        timing: milliseconds by stage in the worker.

    Examples:
        >>> client = real2sim.connect()
        >>> with client.batch(scene="street", worlds=2) as batch:
        ...     obs = batch.reset(sensors=["front"], seeds=[1, 2], action="control")
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
    images: Sequence[BatchImages] = ()
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

    def image(self, camera: str, modality: str = "rgb") -> NDArray[Any]:
        """Images of a camera in all worlds, [M, H, W, 3] or [M, H, W].

        Raises:
            KeyError: some world shows no such image now, or they are not of one size.

        Examples:
            >>> obs.image("front").shape
            (2, 64, 96, 3)
        """
        found = [i for i in self.images if (i.sensor, i.modality) == (camera, modality)]
        if len(found) != 1 or not np.array_equal(found[0].worlds, self.worlds):
            shown = {f"{i.sensor}/{i.modality}": i.worlds.tolist() for i in self.images}
            raise KeyError(
                f"not every world of {self.worlds.tolist()} shows {camera}/{modality} of one size; "
                f"images there are of {shown}"
            )
        return found[0].array


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
        images=[_images_from_wire(images) for images in obs.images],
        events=obs.events,
        details=obs.details,
        errors=obs.errors,
        timing=obs.timing,
    )


def _images_from_wire(images: WireImages) -> BatchImages:
    sizes = np.asarray(images.sizes).tolist()
    places = np.shape(images.T_world_sensor)
    if sum(sizes) != len(images.data) or places != (len(sizes), 4, 4):
        raise MalformedReplyError(
            f"{len(sizes)} images of {images.sensor} have {sum(sizes)} bytes and poses "
            f"{list(places)}; {len(images.data)} bytes came"
        )
    return BatchImages(
        sensor=images.sensor,
        modality=images.modality,
        codec=images.codec,
        dtype=images.dtype,
        shape=tuple(images.shape),
        worlds=np.asarray(images.worlds, np.int64),
        K=images.K,
        T_world_sensor=images.T_world_sensor,
        ends=np.cumsum(sizes).tolist(),
        data=images.data,
    )
