"""`lidarpool run --live` as a script calls it: nobody looks, and nobody is waited for."""

import re
import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

SCENARIO = "scene: seed\nsensor: {rays_per_revolution: 100, layers: 8}\n"


def test_a_run_with_a_page_ends_by_itself_where_it_is_not_to_stay(tmp_path):
    (tmp_path / "small.yaml").write_text(SCENARIO)
    options = ["small.yaml", "--live", "--exit"]
    ended = subprocess.run(
        [sys.executable, "-m", "lidarpool", "run", *options],
        cwd=tmp_path, capture_output=True, text=True, timeout=180,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    assert re.search(r"live page: http://127\.0\.0\.1:\d+/[\w-]{43}/\n", ended.stderr)
    assert "stays" not in ended.stderr
    assert (tmp_path / "lidarpool-out" / "cloud.ply").exists()
