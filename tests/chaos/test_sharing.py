"""What is a defect of disturbed clients, and a short version of `tests.chaos.sharing`."""

import pytest
from tests.chaos.pipeline import append
from tests.chaos.sharing import main
from tests.chaos.sharing_client import TIMED_OUT, Span, judge, shares_of, value_of


def test_each_defect_is_found(tmp_path):
    path = tmp_path / "results-alice.txt"
    values = {k: value_of(f"alice-1-{k}") for k in range(6)}
    values[3] = 5
    values[5] = TIMED_OUT
    append(path, "begin 1 limited 7 0.0")
    for k in (0, 1, 1, 3, 4, 5):
        append(path, f"result alice-1-{k} {values[k]}")
    append(path, f"result alice-1-6 {TIMED_OUT}")
    append(path, "late alice-1-5")
    append(path, "end 1 1.0")
    for line in ("begin 2 mapped 3 1.0", "result alice-2-0 1", "begin 3 mapped 0 2.0", "end 3 3.0"):
        append(path, line)  # the client was killed in the second round
    for item, worker in (("0", "x"), ("0", "left"), ("4", "x"), ("4", "y")):
        append(tmp_path / "runs-1.txt", f"alice-1-{item} 0.0 1.0 {worker}")
    verdict = judge(tmp_path, {"left"})
    assert verdict.lost == ["limited alice-1-2"]
    assert verdict.doubled == ["limited alice-1-1"]
    assert verdict.repeated == ["limited alice-1-4 on x and y"]
    assert verdict.wrong == ["limited alice-1-3: 5", f"limited alice-1-6: {TIMED_OUT}"]
    assert (verdict.rounds, verdict.items, verdict.other) == (2, 7, [])
    assert not verdict.sound
    append(tmp_path / "errors.txt", "alice: PoolError")
    assert judge(tmp_path, set()).other == ["alice: PoolError\n"]


def test_shares_only_include_tasks_of_the_quiet_phase_and_the_time_in_the_window():
    spans = [
        Span("alice-quiet1-0", 0.0, 3.0, "x"),
        Span("bob-quiet1-0", 2.0, 9.0, "y"),
        Span("bob-quiet1-1", 9, 10, "y"),
        Span("bob-1-1", 0, 10, "z"),  # was canceled
    ]
    assert shares_of(spans, 1.0, 4.0) == {"alice": 0.5, "bob": 0.5}


@pytest.mark.slow
def test_nothing_is_lost_and_shares_are_right_after_faults(capsys):
    assert main(["--faults", "20", "--seed", "5"]) == 0
    assert "lost 0 duplicated 0 repeated 0 wrong 0" in capsys.readouterr().out
