"""Run tests that failed by themselves, three times each, and say so.

Tests here kill, stop and overload processes, while two suites share the processors. One in some
thousand is then late through no fault of the code. It must pass three times of three, alone, and
is named in the last lines, so that somebody looks into it. More than three at once are no accident.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

MOST = 3  # tests
TIMES = 3  # each


def main(caches: list[str]) -> int:
    """Run what the suites that kept these caches noted as failed."""
    failed: list[str] = []
    for cache in caches:
        noted = Path(cache, "v/cache/lastfailed")
        failed += json.loads(noted.read_text()) if noted.exists() else []
    if not failed or len(failed) > MOST or not all("::" in test for test in failed):
        print(f"{len(failed)} tests to run again: none is, unless there are 1 to {MOST}")
        return 1
    print(f"failed, and run again {TIMES} times by themselves:", *failed, sep="\n  ", flush=True)
    command = [sys.executable, "-m", "pytest", "-m", "slow or not slow", "-p", "no:cacheprovider"]
    for _ in range(TIMES):
        if subprocess.run([*command, *failed], check=False).returncode:
            return 1
    print(f"failed once and passed {TIMES} times of {TIMES}; look into:", *failed, sep="\n  ")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
