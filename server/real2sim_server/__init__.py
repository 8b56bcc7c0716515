"""The Real2Sim worker: scenes of Gaussians, their editing, physics, rendering and closed loop."""

import os

# Threads of a kernel wait for each other by spinning. GNU OpenMP spins for milliseconds, so a
# waiting thread keeps its core from the thread that it waits for, and kernels take ten times as
# long when other programs need the cores. A tenth of a millisecond bridges the gap between two
# kernels; after that, threads sleep. The variable is read when the library is loaded, so it must be
# set before any other import.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "6000")
