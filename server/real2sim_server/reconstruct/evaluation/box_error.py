"""How far a scene's objects are from the boxes of its log."""

from __future__ import annotations

import numpy as np

from ...logs import DrivingLog
from ...scene import Scene
from ..logged_view import moving_tracks


def box_error(scene: Scene, log: DrivingLog) -> float:
    """Median distance between the centres of moving objects and of their boxes in ``log`` [m].

    On a synthetic log, whose boxes are exact, this is the error of the scene's trajectories. Nan
    where no moving object of the log is in the scene.
    """
    distances = []
    for track in moving_tracks(log):
        item = scene.objects.get(track.object_id)
        if item is None:
            continue
        times = [t for t in track.trajectory.times_us if item.trajectory.covers(int(t))]
        distances += [
            np.linalg.norm(
                item.trajectory.transform(int(t))[:3, 3] - track.trajectory.transform(int(t))[:3, 3]
            )
            for t in times
        ]
    return float(np.median(distances)) if distances else float("nan")
