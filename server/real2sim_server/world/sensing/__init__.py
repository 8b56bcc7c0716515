"""What LiDARs and radars measure in a world: what their rays meet (:mod:`.met`), and the clouds
that are made of it (:mod:`.sweeps`, :mod:`.scans`, all together :mod:`.measure`)."""

from .measure import clouds_of
from .sweeps import recorded_cloud

__all__ = ["clouds_of", "recorded_cloud"]
