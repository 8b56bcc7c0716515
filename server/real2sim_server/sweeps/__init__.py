"""Many variants of a case, driven without a network: parameter sweeps and searches.

Episodes without images run on a ``World`` in the calling process, with the SDK's planners. Planners
receive observations that are bit-identical to those of a worker.
"""

from .spec import Space, SweepSpec, load_space, load_sweep
from .sweep import run_sweep

__all__ = ["Space", "SweepSpec", "load_space", "load_sweep", "run_sweep"]
