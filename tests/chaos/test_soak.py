"""A thousand scans with workers killed all the while."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_a_thousand_scans_in_kills_leave_nothing_and_lose_nothing(tmp_path):
    # In a process of its own: what it holds, and what it leaves, is then the soak's alone.
    picture = tmp_path / "soak.png"
    command = [sys.executable, "-m", "tests.chaos.soak", "--scans", "1000", "--picture", picture]
    soaked = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=1200)
    said = soaked.stdout
    assert soaked.returncode == 0, said + soaked.stderr
    assert said.endswith("sound\n")
    assert re.search(r"scans: lost 0, duplicated 0, unexpected 0, recovered [1-9]", said)
    assert sum(map(int, re.findall(r"'\w+': (\d+)", said))) >= 5  # kills
    # Ten times the cloud would not be as much; what piles up by the scan or by the kill is.
    for who in ("driver", "scheduler"):
        assert float(re.search(rf"{who}: (\S+) MiB", said)[1]) < 10, said
    assert picture.stat().st_size > 0
