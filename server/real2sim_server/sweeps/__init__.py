"""Many variants of a case, driven without a network: sweeps over a space, and searches in it.

Episodes without images run on a ``World`` in the process that asked for them, with the SDK's
planners, which see the observations that a worker would send: the same bits as over the network.
"""

from .spec import Space, SweepSpec, load_space, load_sweep
from .sweep import run_sweep

__all__ = ["Space", "SweepSpec", "load_space", "load_sweep", "run_sweep"]
