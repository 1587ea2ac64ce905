"""Identity of a result: runs with the same identity give the same bytes."""

from __future__ import annotations

from collections.abc import Mapping

from ..base.errors import LidarpoolError
from ..base.fingerprint import fingerprint
from ..base.software import software
from ..pipeline import JobError
from ..scenario.job import Job

_OF_JOB = ("scene", "survey", "planning")  # what a result depends on, with all of its own fields
OF_CAMPAIGN = "campaign: "  # before names of the content of a campaign


def identity_of(job: Job) -> dict[str, str]:
    """Fingerprints of the inputs of a run, and of lidarpool's sources.

    The software of the workers that cast is no part of it: see `RunStore.casting`.

    JobError if a sensor, column or trajectory has a field without a fingerprint.
    """
    try:
        return software() | {name: fingerprint(getattr(job, name)) for name in _OF_JOB}
    except LidarpoolError as error:
        raise JobError(str(error)) from error


def difference(here: Mapping[str, str], there: Mapping[str, str]) -> str:
    """Describe the difference of an earlier run in a clause; empty if there is none."""
    for name, value in here.items():
        if there.get(name) != value:
            if name in _OF_JOB:
                return f"it is of another {name}"
            if name.startswith(OF_CAMPAIGN):
                return f"it is of another campaign: its {name.removeprefix(OF_CAMPAIGN)} differs"
            return f"it was written with {name} {there.get(name, 'none')}, here it is {value}"
    return ""
