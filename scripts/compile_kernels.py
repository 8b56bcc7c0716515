"""Compile the kernels of the CPU, which are then loaded from disk.

``python scripts/compile_kernels.py drawing`` compiles those of images and worlds, ``physics`` those
of the Material Point Method in both precisions. Tests call the same functions where they need
compiled kernels.
"""

from __future__ import annotations

import argparse


def main() -> None:
    """Compile one part."""
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("part", choices=sorted(PARTS))
    PARTS[parser.parse_args().part]()


def compile_drawing() -> None:
    """Images, worlds and what plans in them."""
    from real2sim_server import world
    from real2sim_server.render.backends import select_backend

    select_backend("cpu").warm_up()
    world.warm_up()
    world.warm_up_planning()


def compile_physics() -> None:
    """A substep in both precisions."""
    from real2sim_server.physics.materials import FixedCorotated
    from real2sim_server.physics.validation.check import block, solve

    for precision in ("single", "double"):
        solve([block(FixedCorotated(young=2e5))], precision=precision).step(1e-4)


PARTS = {"drawing": compile_drawing, "physics": compile_physics}

if __name__ == "__main__":
    main()
