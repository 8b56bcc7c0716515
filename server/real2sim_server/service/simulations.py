"""Physics rollouts of scenarios, as jobs."""

from __future__ import annotations

from real2sim_proto import ErrorCode

from .exports import Film
from .jobs import Jobs
from .problems import ServiceError
from .residency import Residency
from .scenarios import Scenarios


class Simulations:
    """Finished rollouts, ready to be looked at."""

    def __init__(self, jobs: Jobs, scenarios: Scenarios, residency: Residency) -> None:
        self._jobs = jobs
        self._scenarios = scenarios
        self._residency = residency

    async def film(self, job_id: str) -> Film:
        """What a finished rollout shows."""
        await self._jobs.get(job_id)
        raise ServiceError(ErrorCode.UNSUPPORTED, "this worker simulates no physics")
