"""What is a defect of a disturbed pipeline, and a short version of `tests.chaos.balancing`."""

import pytest
from tests.chaos.balancing import main
from tests.chaos.pipeline import DECODE, DETECT, append, judge, recorded


def test_each_defect_is_found(tmp_path):
    for line in ("0 0", "1 1", "2 4", "2 4", "3 8", "7 49"):
        append(tmp_path / "results.txt", line)
    verdict = judge(tmp_path, 5)
    assert verdict.lost == [3, 4]  # 3 has arrived with a wrong value
    assert verdict.doubled == [2]
    assert verdict.unexpected == [7]
    assert not verdict.shared
    assert not verdict.sound
    append(tmp_path / "errors.txt", "PoolError: no workers")
    assert "no workers" in judge(tmp_path, 5).errors


def test_a_process_that_works_in_two_partitions_is_found(tmp_path):
    with recorded(tmp_path, DECODE), recorded(tmp_path, DECODE):
        pass
    with recorded(tmp_path, DETECT):
        pass
    assert judge(tmp_path, 0).sound
    with recorded(tmp_path, DETECT), recorded(tmp_path, DECODE):
        pass
    [shared] = judge(tmp_path, 0).shared
    assert shared.endswith("DECODE and DETECT")


@pytest.mark.slow
def test_no_item_is_lost_or_doubled_while_workers_are_moved(capsys):
    assert main(["--faults", "20", "--seed", "5"]) == 0
    assert "lost 0 duplicated 0 in two partitions 0" in capsys.readouterr().out
