"""Maps over items in processes on this machine."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import pytest

from lidarfiles.work.lost_workers import LostWorkersError
from lidarfiles.work.mapping import parallel_map


@pytest.fixture(scope="module")
def run():
    with parallel_map(None, 100, 1, workers=2) as function:
        yield function


@dataclass(frozen=True)
class Part:
    number: int
    folder: Path

    @property
    def label(self) -> str:
        return f"sweeps {self.number} to {self.number + 7}"


def process_of(item):
    time.sleep(0.02 * (item % 3))
    return item, os.getpid()


def test_results_come_in_order_from_two_processes(run):
    results = list(run(process_of, iter(range(30))))
    assert [item for item, _ in results] == list(range(30))
    processes = {process for _, process in results}
    assert len(processes) == 2 and os.getpid() not in processes


def test_functions_of_scripts_and_large_arrays_are_sent(run):
    factor = 3
    array = np.arange(2_000_000.0)
    doubled = list(run(lambda item: factor * item, [array, array + 1]))
    assert np.array_equal(doubled[0], 3 * array) and np.array_equal(doubled[1], 3 * array + 3)


def test_few_items_are_taken_in_advance(run):
    taken = []
    results = iter(run(abs, (taken.append(n) or n for n in range(50))))
    assert next(results) == 0
    assert len(taken) <= 5
    results.close()


def test_one_item_is_processed_here():
    with parallel_map(None, 1, 1) as function:
        assert list(function(process_of, [4])) == [(4, os.getpid())]


def refuse_two(item):
    if item == 2:
        raise ValueError("odd", item)
    return item


def test_an_error_takes_the_place_of_its_result(run):
    results = iter(run(refuse_two, range(9)))
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(ValueError, match="odd") as raised:
        next(results)
    assert raised.value.args == ("odd", 2)
    assert "in refuse_two" in str(raised.value.__cause__)
    assert list(run(abs, [-1, -2, -3])) == [1, 2, 3]


class TwoPartsError(Exception):
    def __init__(self, one, two):
        super().__init__(one)


def raise_two_parts(item):
    raise TwoPartsError("one", item)


def test_an_error_that_cannot_be_pickled_keeps_its_words(run):
    with pytest.raises(RuntimeError, match="TwoPartsError: one"):
        list(run(raise_two_parts, [1, 2]))


def die_once(part):
    """Kill the process of the fourth part when it runs first."""
    if part.number == 24:
        mark = part.folder / "died"
        if not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
    return part.number


def test_an_item_whose_process_dies_is_tried_again(run, tmp_path):
    parts = [Part(8 * n, tmp_path) for n in range(10)]
    assert list(run(die_once, parts)) == [8 * n for n in range(10)]
    assert (tmp_path / "died").exists()


def wait_for(path):
    while not path.exists():
        time.sleep(0.01)


def list_parts_in_flight(part):
    """Kill the process of part 0 when part 1 is processed and the process of part 2 is idle."""
    mine = part.folder / f"part {part.number}"
    died, one, two = (part.folder / name for name in ("died", "1", "2"))
    mine.touch()
    if part.number == 0 and not died.exists():
        wait_for(one)
        wait_for(two)
        time.sleep(0.1)
        died.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if part.number == 1:
        one.touch()
        wait_for(died)
        time.sleep(0.5)  # part 0 would be processed meanwhile
    found = sorted(path.name for path in part.folder.glob("part *"))
    mine.unlink()
    if part.number == 2:
        two.touch()
    return found


def test_an_item_is_tried_again_while_no_other_item_is_processed(tmp_path):
    parts = [Part(number, tmp_path) for number in range(3)]
    with parallel_map(None, 3, 1, workers=3) as run:
        zero, one, _ = run(list_parts_in_flight, parts)
    assert zero == ["part 0"] and one == ["part 0", "part 1"]


def die_at_24(part):
    if part.number == 24:
        (part.folder / f"{os.getpid()}").touch()
        os._exit(7)
    return part.number


def test_an_item_that_kills_two_processes_is_named(run, tmp_path):
    parts = [Part(8 * n, tmp_path) for n in range(10)]
    results = iter(run(die_at_24, parts))
    assert [next(results) for _ in range(3)] == [0, 8, 16]
    message = r"Two processes ended \(exit code 7\) while they processed sweeps 24 to 31, probably"
    with pytest.raises(LostWorkersError, match=message):
        next(results)
    assert len(list(tmp_path.iterdir())) == 2


def test_a_call_within_another_does_not_wait_for_it(run):
    outer = iter(run(abs, range(20)))
    assert next(outer) == 0
    assert list(run(abs, [-5, -6, -7])) == [5, 6, 7]
    assert list(outer) == list(range(1, 20))


def children():
    return [p for p in psutil.Process().children() if "serving_process" in " ".join(p.cmdline())]


def sleep_long(item):
    time.sleep(600 * item)


def test_no_process_is_left_when_the_map_is_abandoned():
    before = len(children())
    with pytest.raises(KeyboardInterrupt), parallel_map(None, 4, 1, workers=2) as function:
        results = iter(function(sleep_long, [0, 1, 1, 1]))
        next(results)
        assert len(children()) == before + 2
        raise KeyboardInterrupt
    assert len(children()) == before
    results.close()


SCRIPT = """
import time
from lidarfiles.work.mapping import parallel_map
print("started once", flush=True)
with parallel_map(None, 4, 1, workers=2) as run:
    for item in run(lambda item: time.sleep(600 * item) or item, [0, 1, 1]):
        print("result", item, flush=True)
"""


def test_processes_end_with_the_process_that_has_started_them(tmp_path):
    """The script has no main guard, so the processes must not run it."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    process = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True)
    assert [process.stdout.readline() for _ in range(2)] == ["started once\n", "result 0\n"]
    started = psutil.Process(process.pid).children()
    assert len(started) == 2
    process.kill()
    process.communicate()
    gone, alive = psutil.wait_procs(started, timeout=10)
    assert len(gone) == 2 and not alive
