"""Identity of a result: runs with the same identity give the same bytes."""

from __future__ import annotations

from collections.abc import Mapping

from ..base.errors import LidarpoolError
from ..base.fingerprint import fingerprint
from ..pipeline import JobError
from ..scenario.job import Job

CONTENT = ("scene", "survey", "planning")  # the fields of a job that its result depends on


def identity_of(job: Job) -> dict[str, str]:
    """Fingerprints of the inputs of a job.

    JobError if a sensor, column or trajectory has a field without a fingerprint.
    """
    try:
        return {name: fingerprint(getattr(job, name)) for name in CONTENT}
    except LidarpoolError as error:
        raise JobError(str(error)) from error


def difference(here: Mapping[str, str], there: Mapping[str, str]) -> str:
    """Describe the difference of an earlier run in a clause; empty if there is none."""
    for name, value in here.items():
        if there.get(name) != value:
            if name in CONTENT:
                return f"it is of another {name}"
            if name != "lidarpool":
                return f"it is of another campaign: its {name} differs"
            return f"it was written with {name} {there.get(name, 'none')}, here it is {value}"
    return ""
