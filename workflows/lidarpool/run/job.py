"""A job and how it is run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import Field

from ..base.arguments import checked_fields
from ..base.declared import declared
from ..base.vocabulary import PATIENCE_S, WAIT_S
from ..scenario import job as described
from ..scenario.build import build
from ..scenario.job import job_of
from ..scenario.scenario import Scenario
from ..scenario.sections import PoolSection, TaskOptions


@dataclass(frozen=True, eq=False)
@checked_fields
class Job(described.Job, TaskOptions):
    """A job, and how it is run.

    LidarpoolError if a number is below 1, or as for the job.
    """

    # How long to wait for partitions that are empty at the start, and that become empty later.
    wait_s: Annotated[float, Field(ge=0)] = WAIT_S
    patience_s: Annotated[float, Field(ge=0)] = PATIENCE_S


def with_options(
    job: described.Job, pool: PoolSection | None, backend: str | None = None, **waits: Any
) -> Job:
    """Return a job that is run as a scenario says; arguments override it."""
    tasks = ({} if pool is None else declared(pool, TaskOptions)) | (
        {"backend": backend} if backend else {}
    )
    return Job(**declared(job, described.Job), **tasks, **waits)


def make_job(
    scenario: Scenario, backend: str | None = None, no_plan: bool = False, **waits: Any
) -> Job:
    """Read the scene and make the job of a scenario; arguments override it."""
    job = job_of(build(scenario, plans=not no_plan))
    return with_options(job, scenario.pool, backend, **waits)
