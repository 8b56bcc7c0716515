"""The Real2Sim worker: scenes of Gaussians, their editing, physics, rendering and closed loop."""

import os

# Threads of a kernel wait for each other by spinning. GNU OpenMP lets them spin for milliseconds:
# as soon as anything else wants a core, they keep it from the very thread that they wait for, and
# kernels take ten times as long. A tenth of a millisecond bridges the gap between two kernels; who
# waits longer sleeps. It is read when the library is loaded, so nothing may be imported before.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "6000")
