"""Many variants of a case, driven without a network: parameter sweeps and searches.

Episodes without images run on a ``World`` in the calling process, with the SDK's planners. These
get the same observations as from a worker: the same bits as over the network.
"""

from .spec import Space, SweepSpec, load_space, load_sweep
from .sweep import run_sweep

__all__ = ["Space", "SweepSpec", "load_space", "load_sweep", "run_sweep"]
