"""Who makes the clips of an export: this process, processes of its own, or a Ray cluster.

A clip is a task of its own: the same bytes whoever makes it, and made again where its maker died.
"""

from ..errors import DatasetError
from .executor import Executor, InProcess
from .maker import Recipe, ShardMaker
from .processes import Processes
from .ray_workers import RayWorkers

EXECUTORS = ("processes", "ray")


def executor_of(
    name: str, recipe: Recipe, *, workers: int, backend: str, address: str | None = None
) -> Executor:
    """The executor of that name.

    Args:
        name: of EXECUTORS.
        recipe: makes the variants in each worker; it can be sent to other processes.
        workers: that hold a scene each, at least 1.
        backend: that draws.
        address: of an existing Ray cluster, whose machines find the scene at the same path; None
            for one on this machine.

    Raises:
        DatasetError: an unknown name, no worker, or Ray is not installed.
    """
    if workers < 1:
        raise DatasetError(f"{workers} workers; at least 1 makes the data set")
    if name == "processes":
        return Processes(recipe, workers=workers, backend=backend)
    if name == "ray":
        return RayWorkers(recipe, workers=workers, backend=backend, address=address)
    raise DatasetError(f"executor {name!r}; allowed are {', '.join(EXECUTORS)}")


__all__ = [
    "EXECUTORS",
    "Executor",
    "InProcess",
    "Processes",
    "RayWorkers",
    "Recipe",
    "ShardMaker",
    "executor_of",
]
