"""Identity of a result: runs with the same identity give the same bytes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields

from ..base.errors import LidarpoolError
from ..base.fingerprint import fingerprint
from ..base.software import software
from ..pipeline import JobError
from ..scenario.sections import TaskOptions
from .job import Job

# Fields of a job that do not change a result: a run may go on with others. Every other field is
# part of its identity, with all of its own fields.
_OWN = {"values", "number", "name", "split", "outputs", "made_of", "notes"}
_MAY_CHANGE = {*TaskOptions.__dataclass_fields__, "wait_s", "patience_s", *_OWN}
OF_CAMPAIGN = "campaign: "  # before names of the content of a campaign


def identity_of(job: Job) -> dict[str, str]:
    """Fingerprints of the inputs of a run, and of lidarpool's sources.

    The software of the workers that cast is no part of it: see `RunStore.casting`.

    JobError if a sensor, column or trajectory has a field without a fingerprint.
    """
    names = [field.name for field in fields(job) if field.name not in _MAY_CHANGE]
    try:
        return software() | {name: fingerprint(getattr(job, name)) for name in names}
    except LidarpoolError as error:
        raise JobError(str(error)) from error


def difference(here: Mapping[str, str], there: Mapping[str, str]) -> str:
    """Describe the difference of an earlier run in a clause; empty if there is none."""
    for name, value in here.items():
        if there.get(name) != value:
            if name in Job.__dataclass_fields__:
                return f"it is of another {name}"
            if name.startswith(OF_CAMPAIGN):
                return f"it is of another campaign: its {name.removeprefix(OF_CAMPAIGN)} differs"
            return f"it was written with {name} {there.get(name, 'none')}, here it is {value}"
    return ""
