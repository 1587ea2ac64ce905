"""Print test durations in seconds as JSON, given a JUnit report from pytest.

The duration of a test with several parameter sets is their mean. Tests below a tenth of a second
are omitted. `tests/conftest.py` starts the longest files first, so that no process runs a long file
alone at the end.

Usage: python .ci/durations.py REPORT >tests/durations.json
"""

import json
import sys
from collections import defaultdict
from statistics import mean
from xml.etree import ElementTree

SHORTEST_S = 0.1


def main() -> None:
    """Print the durations as {file: {test: seconds}}."""
    rows: defaultdict[str, defaultdict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for case in ElementTree.parse(sys.argv[1]).iter("testcase"):
        path = f"{case.get('classname', '').replace('.', '/')}.py"
        name = case.get("name", "").partition("[")[0]
        rows[path][name].append(float(case.get("time", 0)))
    seconds = {
        path: {name: round(mean(times), 1) for name, times in sorted(tests.items())}
        for path, tests in sorted(rows.items())
    }
    long = {
        path: {name: value for name, value in tests.items() if value >= SHORTEST_S}
        for path, tests in seconds.items()
    }
    print(json.dumps({path: tests for path, tests in long.items() if tests}, indent=1))


if __name__ == "__main__":
    main()
