"""The benchmarks at toy size, so that they cannot rot; no figure is judged here."""

from __future__ import annotations

import json

from benchmarks import pipeline


def test_pipeline(tmp_path, capsys):
    path = tmp_path / "figures.json"
    figures = pipeline.main(["--scans", "40", "--runs", "1", "--json", str(path)])
    assert json.loads(path.read_text()) == figures
    assert figures["scans_per_second"] > 0
    assert set(figures["stage_ms_per_scan"]) == {"generate", "intersect", "sort", "collect"}
    assert "scans/s" in capsys.readouterr().out
