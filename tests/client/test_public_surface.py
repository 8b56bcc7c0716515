from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import real2sim
from real2sim import errors

PACKAGE = Path(real2sim.__file__).parent
PUBLIC = [
    "Assets",
    "AsyncClient",
    "AsyncDriveSession",
    "BadStepError",
    "CapacityError",
    "Client",
    "ConflictError",
    "ConnectionLostError",
    "Control",
    "ControllerTakenError",
    "DriveSession",
    "EpisodeOverError",
    "Frame",
    "GatewayError",
    "Image",
    "ImageDecodeError",
    "InvalidActionError",
    "InvalidOperationError",
    "InvalidRequestError",
    "Job",
    "Jobs",
    "LidarCloud",
    "LidarSpec",
    "MalformedReplyError",
    "NotFoundError",
    "NotOpenError",
    "NotResetError",
    "Observation",
    "PointCloud",
    "PoseCommand",
    "ProtocolMismatchError",
    "RadarCloud",
    "RadarSpec",
    "Real2SimError",
    "ReplyTimeoutError",
    "Scenario",
    "Scenarios",
    "SceneObject",
    "Scenes",
    "SensorSpec",
    "SessionClosedError",
    "SessionElsewhereError",
    "Sessions",
    "StaleRevisionError",
    "StaleStepError",
    "StatusError",
    "StepConflictError",
    "Sweeps",
    "TrajectoryPlan",
    "UnauthorizedError",
    "UnreachableError",
    "View",
    "WorkerFailedError",
    "__version__",
    "connect",
    "connect_async",
    "make_env",
]
HEAVY = ("torch", "numba", "cv2", "fastapi", "matplotlib", "scipy", "real2sim_server.render")


def test_the_public_names_are_the_expected_ones_and_sorted():
    assert real2sim.__all__ == sorted(PUBLIC) == dir(real2sim)


def test_every_public_name_exists():
    for name in real2sim.__all__:
        assert getattr(real2sim, name) is not None


def test_unknown_names_raise_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'Cleint'"):
        _ = real2sim.Cleint


def test_every_error_is_public_and_in_the_documented_tree():
    classes = {
        name
        for name, value in vars(errors).items()
        if isinstance(value, type) and issubclass(value, errors.Real2SimError)
    }
    assert classes <= set(real2sim.__all__)
    for name in classes:
        assert f"{name} " in errors.__doc__, name


def test_the_documented_error_tree_matches_the_classes():
    lines = [line for line in errors.__doc__.splitlines() if "Error " in f"{line} "]
    path: list[str] = []
    for line in lines:
        name = line.lstrip(" │├└─").split()[0]
        if not name.endswith("Error"):
            continue
        depth = (len(line) - len(line.lstrip(" │├└─")) - 4) // 4
        path[depth:] = [name]
        if depth > 0:
            assert issubclass(getattr(errors, name), getattr(errors, path[depth - 1])), name


def imported_after(code: str) -> set[str]:
    script = f"import sys\n{code}\nprint('\\n'.join(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    return set(done.stdout.split())


def test_importing_the_sdk_loads_no_dependencies():
    loaded = imported_after("import real2sim")
    assert not loaded & {"numpy", "pydantic", "httpx2", "websockets", *HEAVY}


def test_using_the_sdk_loads_no_libraries_of_the_worker():
    code = "import real2sim, real2sim.planners\nreal2sim.connect().close()"
    assert not imported_after(code) & {*HEAVY, "real2sim_server"}


def test_building_the_command_line_loads_no_dependencies():
    loaded = imported_after("import real2sim.cli\nreal2sim.cli.build_app()")
    assert not loaded & {"numpy", "pydantic", "httpx2", "websockets", *HEAVY}


ALLOWED = {
    "real2sim",
    "real2sim_proto",
    "numpy",
    "pydantic",
    "msgpack",
    "httpx2",
    "websockets",
    "simplejpeg",
    "typer",
    "rich",
} | set(sys.stdlib_module_names)


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda p: p.stem)
def test_the_client_imports_only_base_dependencies(path):
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names = [str(node.module)]
        else:
            continue
        extra = {"gymnasium"} if path.stem == "env" else set()
        assert {name.partition(".")[0] for name in names} <= ALLOWED | extra
