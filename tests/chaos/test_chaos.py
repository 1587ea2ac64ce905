"""Short versions of `python -m tests.chaos` and its soak test."""

import signal
import subprocess
import sys

import pytest
from tests.chaos.__main__ import Campaign
from tests.chaos.events import CLIENT, KINDS, Fault
from tests.chaos.nemesis import make_plan
from tests.chaos.points import DRIVER_POINTS, WORKER_POINTS
from tests.chaos.soak import draw, soak
from tests.chaos.survey import disturbed, reference

SEED = 7
FAULTS = 20
PLANNED = 24  # some may find nobody to strike
PATIENT = {"worker_timeout_s": 300.0}  # with partitions whose last worker is starting again

# One after the other in one run; somebody passes each of these points with each scan.
DEATHS = [
    ("kill", "intersect.start", 20),  # before a cast, during one, after it
    ("kill", "intersect.cast", 60),
    ("segv", "intersect.end", 100),
    ("kill", "collect.part", 140),  # a part is in memory only; then nobody knows of one in storage
    ("term", "collect.stored", 180),
    ("kill", "sort.get", 220),  # with frames buffered
    ("restart", "collect.get", 260),  # its client is closed under the stage
    ("kill", "generate.put", 300),
]


@pytest.mark.slow
def test_whoever_dies_each_scan_arrives_once(arena, what, known):
    faults = [Fault(n, kind, point, scan) for n, (kind, point, scan) in enumerate(DEATHS)]
    outcome = disturbed(arena, what, known, faults, **PATIENT)
    assert outcome.sound, outcome.error or outcome.verdict
    assert outcome.done == {(kind, point): 1 for kind, point, _ in DEATHS}
    assert outcome.verdict.recovered


@pytest.mark.slow
def test_more_deaths_than_dask_allows_a_task(arena, what, known):
    """Dask abandons a task when the fourth worker that ran it has died."""
    faults = [Fault(number, "kill", "sort.get", 50 * number) for number in range(5)]
    outcome = disturbed(arena, what, known, faults, **PATIENT)
    assert outcome.sound, outcome.error or outcome.verdict
    assert outcome.done == {("kill", "sort.get"): 5}


@pytest.mark.slow
def test_twenty_faults_are_survived(arena, what, known):
    campaign = Campaign(PLANNED, SEED, what)
    while not campaign.over:
        outcome = campaign.play(arena, known)
        assert outcome.sound, f"seed {SEED}: {outcome.error or outcome.verdict}"
    assert sum(campaign.done.values()) >= FAULTS
    assert {kind for kind, _ in campaign.done} == set(KINDS)
    assert {point for _, point in campaign.done} >= set(WORKER_POINTS)
    assert campaign.summary() == f"faults {campaign.done.total()} lost 0 duplicated 0 identical yes"


@pytest.mark.slow
def test_a_soak_leaves_nothing_and_loses_nothing(arena, what, tmp_path):
    # Memory is judged in a long one.
    soaked = soak(arena, what, reference(arena, what, None), seed=1)
    assert soaked.sound, soaked
    assert soaked.outcome.verdict.recovered
    assert soaked.outcome.done.total() >= 3
    draw(soaked, tmp_path / "soak.png")
    assert (tmp_path / "soak.png").stat().st_size > 0


def test_clients_die_where_stages_have_pipes():
    plan = make_plan(SEED, 200, WORKER_POINTS, DRIVER_POINTS, scans=360)
    faults = [fault for fault in plan if fault.kind == CLIENT]
    assert {fault.point for fault in faults} >= {"generate.put", "sort.get", "collect.get"}
    assert not any(fault.point.startswith("intersect.") for fault in faults)
    assert {fault.partition for fault in faults} == {"", "LIDAR"}


WAIT_AT_PIPE = """
import sys
from distributed import Client
from poolpart import Pipe
from tests.chaos.events import die_at_pipe
client = Client(processes=False, dashboard_address=None)
pipe = Pipe("pipe", 1, client).create()
pipe.put(1)
die_at_pipe()
pipe.put(2) if sys.argv[1] == "put" else list(pipe)
"""


@pytest.mark.extended(every=2)
@pytest.mark.parametrize("end", ["put", "get"])
def test_a_client_dies_while_it_waits_at_a_pipe(end):
    program = [sys.executable, "-c", WAIT_AT_PIPE, end]
    assert subprocess.run(program, check=False).returncode == -signal.SIGKILL
