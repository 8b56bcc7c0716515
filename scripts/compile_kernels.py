"""Compile the kernels of the CPU, which are then loaded from disk.

``python scripts/compile_kernels.py drawing`` compiles those of images and worlds, ``learning``
those that make logs of streets, train scenes and drive batches of worlds, ``physics`` those of the
Material Point Method in both precisions. Test fixtures call these functions, too.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path


def main() -> None:
    """Compile one part."""
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("part", choices=sorted(PARTS))
    PARTS[parser.parse_args().part]()


def compile_drawing() -> None:
    """Images, worlds and what plans in them."""
    from real2sim_server import render, world
    from real2sim_server.render.cast.call import warm_up_casting
    from real2sim_server.render.frame import warm_up_lenses

    render.warm_up("cpu")
    render.warm_up_small_images("cpu")
    world.warm_up()
    world.warm_up_planning()
    warm_up_casting()
    warm_up_lenses("cpu")


def compile_physics() -> None:
    """A substep in both precisions."""
    from real2sim_server.physics.materials import FixedCorotated
    from real2sim_server.physics.validation.check import block, solve

    for precision in ("single", "double"):
        solve([block(FixedCorotated(young=2e5))], precision=precision).step(1e-4)


def compile_learning() -> None:
    """A synthetic log, a scene trained on it, a batch of worlds."""
    import numpy as np

    from real2sim_proto.episode import ResetSpec
    from real2sim_server.demo.street import SHIPPED
    from real2sim_server.logs import write_native_log
    from real2sim_server.reconstruct import InitialiseOptions, ReconstructOptions, reconstruct
    from real2sim_server.reconstruct.training import TrainOptions
    from real2sim_server.scene.io import read_packed
    from real2sim_server.synthetic import CameraSpec, SyntheticConfig, generate_log
    from real2sim_server.world.batch import BatchWorld

    config = SyntheticConfig(
        frames=5, width=96, height=64, samples=1, cameras=(CameraSpec("front"),), lidar_columns=360
    )
    training = TrainOptions(iterations=4, sky_resolution=16, preview_every=0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_native_log(generate_log(config), folder / "log")
        few = InitialiseOptions(max_background=4_000, max_object=400, voxel=0.4, ground_spacing=0.5)
        options = ReconstructOptions(initialise=few, training=training)
        reconstruct(folder / "log", folder / "street.r2s", options)
    street = read_packed(SHIPPED)
    for driver in ("log", "idm"):
        spec = ResetSpec(action="control", agents={"default": driver})
        batch = BatchWorld(street, spec, 2)
        batch.step(np.zeros((2, 2)))
        batch.routes()


PARTS = {"drawing": compile_drawing, "learning": compile_learning, "physics": compile_physics}

if __name__ == "__main__":
    main()
