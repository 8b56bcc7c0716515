"""A process that serves NVIDIA's own EgodriverService from a checkout of NVlabs/alpasim.

    python alpasim_driver_process.py CHECKOUT CAMERA,... CONTEXT FOLDER [rectify]

The service and its AlpaSim dependencies are unmodified, except for parts that need weights, Rust or
a display. The model drives straight at the reported speed once it has its context. The process
prints its port when it listens. FOLDER receives the compiled protos.
"""

from __future__ import annotations

import asyncio
import importlib.metadata
import math
import shutil
import sys
import types
from pathlib import Path

import numpy as np

HORIZON, HERTZ = 20, 10


def main(checkout: Path, cameras: list[str], context: int, folder: Path, *, rectify: bool) -> None:
    compile_protos(checkout, folder)
    for package in ("driver/src", "utils", "plugins"):
        sys.path.append(str(checkout / "src" / package))
    sys.path.insert(0, str(folder))
    leave_out()
    asyncio.run(serve(cameras, context, rectify))


def compile_protos(checkout: Path, folder: Path) -> None:
    from grpc_tools import protoc

    source = checkout / "src/grpc"
    shutil.copytree(source / "alpasim_grpc", folder / "alpasim_grpc", dirs_exist_ok=True)
    protos = [str(p) for p in sorted((source / "alpasim_grpc/v0").glob("*.proto"))]
    out = [f"--python_out={folder}", f"--grpc_python_out={folder}"]
    if protoc.main(["protoc", f"-I{source}", *out, *protos]):
        raise SystemExit("the protos do not compile")


def leave_out() -> None:
    """Replace modules that this drive does not need. Only implements the yaw of a quaternion."""
    unused = {
        "pygame": [],
        "vam.action_expert": ["VideoActionModelInference"],
        "vam.datalib.transforms": ["NeuroNCAPTransform"],
        "alpamayo_r1": ["helper"],
        "alpamayo_r1.models.alpamayo_r1": ["AlpamayoR1"],
        "alpamayo1_5": ["helper"],
        "alpamayo1_5.models.alpamayo1_5": ["Alpamayo1_5"],
        "utils_rs": ["DynamicTrajectory", "Polyline", "Trajectory"],
    }
    for dotted, names in unused.items():
        parts = dotted.split(".")
        for k in range(1, len(parts) + 1):
            sys.modules.setdefault(".".join(parts[:k]), types.ModuleType(".".join(parts[:k])))
        for name in names:
            setattr(sys.modules[dotted], name, type(name, (), {}))
    sys.modules["utils_rs"].Pose = Pose
    installed = importlib.metadata.version
    importlib.metadata.version = lambda name: (
        "0.0.0" if name.startswith("alpasim") else installed(name)
    )


class Pose:
    def __init__(self, xyzw: np.ndarray) -> None:
        self._xyzw = xyzw

    @classmethod
    def from_denormalized_quat(cls, _position: np.ndarray, xyzw: np.ndarray) -> Pose:
        return cls(xyzw / np.linalg.norm(xyzw))

    def yaw(self) -> float:
        x, y, z, w = self._xyzw.tolist()
        return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


async def serve(cameras: list[str], context: int, rectify: bool) -> None:
    import grpc.aio
    from alpasim_driver import main as theirs
    from alpasim_driver import schema
    from alpasim_driver.models.base import BaseTrajectoryModel, ModelPrediction

    class StraightOn(BaseTrajectoryModel):
        camera_ids, context_length, output_frequency_hz = cameras, context, HERTZ

        @classmethod
        def from_config(cls, *_args: object, **_options: object) -> StraightOn:
            return cls()

        def _encode_command(self, command: int) -> int:
            return command

        def predict(self, given: object) -> ModelPrediction:
            self._validate_cameras(given.camera_images)
            for frames in given.camera_images.values():
                times = [t_us for t_us, _ in frames]
                assert len(times) == context
                assert times == sorted(set(times))
                assert all(image.ndim == 3 for _, image in frames)
            ahead = given.speed * np.arange(1, HORIZON + 1) / HERTZ
            return ModelPrediction(np.stack([ahead, 0 * ahead], axis=1), np.zeros(HORIZON))

    theirs.model_registry._cache = {"straight_on": StraightOn}
    target = schema.RectificationTargetConfig((60.0, 60.0), (32.0, 16.0), (32, 64))
    config = schema.DriverConfig(
        model=schema.ModelConfig(model_type="straight_on", device="cpu"),
        inference=schema.InferenceConfig(use_cameras=cameras, max_batch_size=4),
        rectification=dict.fromkeys(cameras, target) if rectify else None,
        output_dir="",
    )
    service = theirs.EgoDriverService(cfg=config, loop=asyncio.get_running_loop())
    server = grpc.aio.server()
    theirs.add_EgodriverServiceServicer_to_server(service, server)
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    print(f"listens at {port}", flush=True)
    await server.wait_for_termination()


if __name__ == "__main__":
    given, wanted, frames, into, *options = sys.argv[1:]
    main(Path(given), wanted.split(","), int(frames), Path(into), rectify=bool(options))
