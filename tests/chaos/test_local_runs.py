"""Short versions of `python -m tests.chaos.local_runs`."""

import pytest
from tests.chaos.local_runs import REFERENCES, Tally, commands_of, files_of, judge, main


def test_results_that_differ_are_named(tmp_path):
    undisturbed = tmp_path / "survey"
    (undisturbed / "jobs").mkdir(parents=True)
    (undisturbed / "report.json").write_text("5 s")
    (undisturbed / "cloud.ply").write_text("points")
    (undisturbed / "jobs" / "0.ply").write_text("points")
    reference = files_of(undisturbed)
    same, other = tmp_path / "same", tmp_path / "other"
    for folder in (same, other):
        (folder / "jobs").mkdir(parents=True)
        (folder / "report.json").write_text("7 s")
        (folder / "cloud.ply").write_text("points")
        (folder / "jobs" / "0.ply").write_text("points")
    tally = Tally()
    judge(same, reference, tally)
    assert tally.sound and tally.results == 1
    (other / "cloud.ply").write_text("point")
    (other / "jobs" / "0.ply").unlink()
    (other / "run").mkdir()
    (other / "run" / "run.db").touch()
    judge(other, reference, tally)
    assert tally.differing == ["other/cloud.ply", "other/jobs/0.ply", "other/run/run.db"]
    assert str(tally) == "faults 0 () results 2 identical no errors 0"


def test_shards_are_merged_into_what_is_compared_with_one_run():
    *shards, merge = commands_of("shards", "out")
    assert [command[command.index("--shard") + 1] for command in shards] == ["1/3", "2/3", "3/3"]
    parts = [command[command.index("--out") + 1] for command in shards]
    assert merge == ["merge", *parts, "--out", "out", "-q"]
    assert REFERENCES["shards"] == "survey"


@pytest.mark.slow
@pytest.mark.parametrize("case", REFERENCES)
def test_killed_commands_change_no_byte(capsys, case):
    assert main(["--faults", "3", "--seed", "5", "--cases", case]) == 0
    assert "identical yes errors 0" in capsys.readouterr().out
