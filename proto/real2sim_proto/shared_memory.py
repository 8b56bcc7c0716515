"""Layout of the memory in which a worker hands images to a controller on the same machine.

A file in :data:`FOLDER`: its first :data:`HEADER_BYTES` hold :data:`MAGIC` and the secret that a
client sends back, slots of equal size follow. Whoever may open the file and has the secret is on
the worker's machine, which no address tells.
"""

from __future__ import annotations

FOLDER = "/dev/shm"
"""Where POSIX systems keep files that are memory."""
NAME = r"^real2sim-[0-9a-f]{32}$"
"""Names are of this form; no other file is ever opened or removed."""
MAGIC = b"real2sim-frames1"
SECRET_BYTES = 32
HEADER_BYTES = 4096
ALIGNMENT = 64
"""Images begin at multiples of this."""
MAX_SLOTS = 64
