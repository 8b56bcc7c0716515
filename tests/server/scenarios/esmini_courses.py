"""``python esmini_courses.py LIBRARY FILE OUT STEP SECONDS FOLDER...`` runs a file in esmini.

Writes x, y of the box centre of every entity every 10 ms to OUT (.npz), by name, [N, 2] float64.
"""

from __future__ import annotations

import ctypes
import math
import sys

import numpy as np

INTERVAL = 0.01


class State(ctypes.Structure):
    """State of an object, as in esmini's C interface."""

    _fields_ = [
        *((name, ctypes.c_int) for name in ("id", "model_id", "control")),
        *((name, ctypes.c_double) for name in ("time", "x", "y", "z", "h", "p", "r")),
        *((name, ctypes.c_uint32) for name in ("road", "junction")),
        ("t", ctypes.c_double),
        ("lane", ctypes.c_int),
        *((name, ctypes.c_double) for name in ("offset", "s", "speed", "cx", "cy", "cz")),
        *((name, ctypes.c_double) for name in ("width", "length", "height")),
        *((name, ctypes.c_int) for name in ("type", "category")),
        *((name, ctypes.c_double) for name in ("wheel_angle", "wheel_rotation")),
        ("visibility", ctypes.c_int),
    ]


def main() -> None:
    """Run the file and write the courses."""
    library, file, out, step, seconds, *folders = sys.argv[1:]
    esmini = ctypes.CDLL(library)
    esmini.SE_GetObjectName.restype = ctypes.c_char_p
    esmini.SE_StepDT.argtypes = [ctypes.c_double]
    words = ["esmini", "--osc", file, "--headless", "--disable_controllers", "--disable_stdout"]
    words += ["--disable_log", "--fixed_timestep", step]
    words += [word for folder in folders for word in ("--path", folder)]
    given = (ctypes.c_char_p * len(words))(*(word.encode() for word in words))
    if esmini.SE_InitWithArgs(len(words), given) != 0:
        raise SystemExit(3)
    every = round(INTERVAL / float(step))
    count = round(float(seconds) / INTERVAL) + 1
    courses: dict[str, np.ndarray] = {}
    for k in range(count * every):
        for number in range(esmini.SE_GetNumberOfObjects()) if k % every == 0 else ():
            state, id_ = State(), esmini.SE_GetId(number)
            if esmini.SE_GetObjectState(id_, ctypes.byref(state)) != 0:
                continue
            name = esmini.SE_GetObjectName(id_).decode()
            course = courses.setdefault(name, np.full((count, 2), np.nan))
            cos, sin = math.cos(state.h), math.sin(state.h)
            course[k // every] = (
                state.x + state.cx * cos - state.cy * sin,
                state.y + state.cx * sin + state.cy * cos,
            )
        if esmini.SE_GetQuitFlag() == 1 or esmini.SE_StepDT(float(step)) != 0:
            break
    np.savez(out, **courses)


if __name__ == "__main__":
    main()
