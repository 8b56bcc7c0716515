"""Images of many worlds as members of one message: those of one form side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..rendering.frames import EncodedFrame, Part, bytes_member

FORM = ("sensor", "modality", "codec", "dtype", "shape", "K")
"""Members of a frame that images side by side share."""


def pack_images(frames: Mapping[int, Sequence[EncodedFrame]]) -> list[list[Part]]:
    """The wire's BatchImages, each in parts; nothing is copied.

    Args:
        frames: by number of the world, in the order of its sensors and modalities.
    """
    alike: dict[tuple[Any, ...], list[tuple[int, EncodedFrame]]] = {}
    for world, found in frames.items():
        for frame in found:
            alike.setdefault(_form(frame.header.fields), []).append((world, frame))
    return [_side_by_side(images) for images in alike.values()]


def _form(fields: Mapping[str, Any]) -> tuple[Any, ...]:
    *named, shape, K = (fields[name] for name in FORM)
    return (*named, tuple(shape), K.tobytes())


def _side_by_side(images: Sequence[tuple[int, EncodedFrame]]) -> list[Part]:
    first = images[0][1].header.fields
    places = [frame.header.fields["T_world_sensor"] for _, frame in images]
    fields = {
        **{name: first[name] for name in FORM},
        "worlds": np.array([world for world, _ in images], np.int64),
        "T_world_sensor": np.stack(places).astype(np.float64),
        "sizes": np.array([len(frame.data) for _, frame in images], np.int64),
    }
    return bytes_member(fields, [frame.data for _, frame in images])
