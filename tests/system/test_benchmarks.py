"""The benchmarks at toy size, so that they cannot rot; no figure is judged here."""

from __future__ import annotations

import json

import pytest
from benchmarks import live, pipeline, scale


def test_pipeline(tmp_path, capsys):
    path = tmp_path / "figures.json"
    sizes = ["--scans", "40", "--runs", "1", "--paced-scans", "5", "--pace", "20", "--sizes", "20"]
    figures = pipeline.main([*sizes, "--json", str(path)])
    assert json.loads(path.read_text()) == figures
    assert figures["scans_per_second"] > 0
    assert set(figures["stage_ms_per_scan"]) == {"generate", "intersect", "sort", "collect"}
    assert 0 < figures["latency"]["median_ms"] <= figures["latency"]["p95_ms"]
    assert figures["cpu_seconds_per_million_rays"]["20"] > 0
    assert "scans/s" in capsys.readouterr().out


def test_scale(tmp_path, capsys):
    path = tmp_path / "figures.json"
    sizes = ["--workers", "4", "8", "--tasks", "80", "--json", str(path)]
    figures = scale.main(sizes)
    assert json.loads(path.read_text())["growth"] == figures["growth"]
    assert set(figures["growth"]) == set(scale.WAYS)
    for cluster in figures["workers"].values():
        assert cluster["misplaced"] == 0
        assert all(cluster[way]["tasks_per_second"] > 0 for way in scale.WAYS)
    assert "growth from 4 to 8 workers" in capsys.readouterr().out


def test_live(tmp_path, capsys):
    path = tmp_path / "figures.json"
    figures = live.main(["--poses", "3", "--runs", "1", "--json", str(path)])
    assert json.loads(path.read_text()) == figures
    assert figures["ratio"] > 0
    assert figures["megabytes_sent"] > 0.1  # or nobody looked
    assert "times as long" in capsys.readouterr().out


@pytest.mark.slow
def test_no_task_is_misplaced_among_two_hundred_workers():
    figures = scale.measure(workers=200, tasks=14_000)  # and half as many in the other ways
    assert figures["misplaced"] == 0
    assert figures["tasks"] == 21_000 + 70_000  # the items of the small ones
