"""Fail if `make test` takes much more processor time than it should.

Machines differ, so the time is compared with that of `make demo` in the same run. On a busy
machine, a run takes longer, but hardly more processor time.

Usage: python .ci/suite_time.py TEST_SECONDS DEMO_SECONDS    (files that .ci/timed has written)
"""

import sys
from pathlib import Path

MEASURED_RATIO = 5.87  # 789 s to 135 s, fresh clone, beside lint on a quiet machine, 2026-11-27
ALLOWED = 1.4 * MEASURED_RATIO


def main() -> None:
    """Print both times and their ratio.

    The exit status is 1 if the ratio is above the limit.
    """
    test_s, demo_s = (float(Path(name).read_text()) for name in sys.argv[1:])
    ratio = test_s / demo_s
    print(
        f"processor time: make test {test_s:.0f} s, make demo {demo_s:.0f} s, ratio {ratio:.2f} "
        f"(measured before {MEASURED_RATIO:.2f}, at most {ALLOWED:.2f})"
    )
    if ratio > ALLOWED:
        sys.exit("make test takes too long: see the slowest tests above; leave some to test-all")


if __name__ == "__main__":
    main()
