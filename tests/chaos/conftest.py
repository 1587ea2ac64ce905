"""The cluster and the survey shared by all tests with faults."""

from __future__ import annotations

import pytest
from tests.chaos.arena import Arena
from tests.chaos.survey import PAUSES, reference, survey

TIME_TO_LIVE_S = 300  # a worker that is not heard of is only slow, but where a test says otherwise


@pytest.fixture(scope="package")
def arena():
    with Arena(pauses=PAUSES, time_to_live_s=TIME_TO_LIVE_S) as arena:
        yield arena


@pytest.fixture(scope="package")
def what():
    return survey(poses=1)


@pytest.fixture(scope="package")
def known(arena, what):
    return reference(arena, what)
