"""What really was there: known for synthetic logs, as their street can be built again."""

from __future__ import annotations

from dataclasses import dataclass

from ...logs import DrivingLog
from ...synthetic import SyntheticConfig, SyntheticLog, generate_log
from .image_metrics import psnr

SAME_DB = 30.0
"""A street built again must show the logged image at least this closely; jpg keeps more [dB]."""


@dataclass(frozen=True, eq=False)
class Truth:
    """A street that can be seen from anywhere, or why there is none.

    Attributes:
        log: the street; None where there is none.
        missing: why; empty where there is one.
    """

    log: SyntheticLog | None
    missing: str = ""


def find_truth(log: DrivingLog) -> Truth:
    """The street of a synthetic log, built again from the config in its provenance.

    Its first image is compared with the logged one, so that logs of another version of the
    generator, or altered ones, are not measured against a street that they do not show.

    Raises:
        LogError: the first image cannot be read.
    """
    if isinstance(log, SyntheticLog):
        return Truth(log)
    values = log.provenance.get("config")
    if log.provenance.get("dataset") != "synthetic street" or not isinstance(values, dict):
        return Truth(None, f"log {log.name!r} is no synthetic one, only its own images are known")
    try:
        street = generate_log(SyntheticConfig.from_values(values))
    except (TypeError, ValueError, KeyError) as error:
        return Truth(None, f"the config of log {log.name!r} is of no known street ({error})")
    camera, t_us = log.rig.cameras[0], log.image_time_us(log.rig.names[0], 0)
    pose = camera.pose(street.ego.transform(t_us))
    image, _, _ = street.render(pose, camera.K, camera.width, camera.height, t_us)
    if psnr(image, log.image(camera.name, 0)) < SAME_DB:
        return Truth(None, f"log {log.name!r} shows another street than its config gives today")
    return Truth(street)
