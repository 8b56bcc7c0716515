"""Who does many tasks that know nothing of each other: this process, processes, a Ray cluster.

A task gives the same result whoever does it, and is done again where its worker died. Data sets
make their clips so, and sweeps drive their episodes.
"""

from .executor import MOST_TRIES, Executor, ExecutorError, InProcess, OnResult, Recipe, Worker
from .processes import Processes
from .ray_cluster import RayCluster

EXECUTORS = ("processes", "ray")


def executor_of(name: str, *, workers: int, address: str | None = None) -> Executor:
    """The executor of that name.

    Args:
        name: of EXECUTORS; ``processes`` with one worker does all in this process.
        workers: at least 1.
        address: of an existing Ray cluster, ``auto`` for that of the environment; None for one on
            this machine.

    Raises:
        ExecutorError: an unknown name, no worker, or Ray is not installed.
    """
    if workers < 1:
        raise ExecutorError(f"{workers} workers; at least 1 does the work")
    if name == "processes":
        return InProcess() if workers == 1 else Processes(workers)
    if name == "ray":
        return RayCluster(workers, address=address)
    raise ExecutorError(f"executor {name!r}; allowed are {', '.join(EXECUTORS)}")


__all__ = [
    "EXECUTORS",
    "MOST_TRIES",
    "Executor",
    "ExecutorError",
    "InProcess",
    "OnResult",
    "Processes",
    "RayCluster",
    "Recipe",
    "Worker",
    "executor_of",
]
