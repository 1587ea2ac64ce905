"""benchmarks/trees.py at toy size: our trees are about as good as the best there are."""

from __future__ import annotations

import json
import shutil

import pytest
from benchmarks import trees

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    if shutil.which("g++") is None:
        pytest.skip("g++ is not here to compile the kernels")
    out = tmp_path_factory.mktemp("trees") / "out.json"
    assert trees.main(["--quick", "--json", str(out)]) == 0
    return json.loads(out.read_text())


def test_few_more_nodes_than_with_a_full_sweep(rows):
    assert [row["scene"] for row in rows] == ["default survey", "city 2e3", "terrain 2e3"]
    for row in rows:
        assert 1 < row["ours"]["nodes"] < 1.06 * row["sweep"]["nodes"]
        assert row["ours"]["triangles"] < 1.1 * row["sweep"]["triangles"]
        assert row["ours"]["nodes"] < 0.9 * row["clustered"]["nodes"]


def test_every_tree_gives_the_same_hits(rows):
    for row in rows:
        assert 0 < row["ours"]["hit_share"] < 1
        assert len({row[name]["hit_share"] for name in trees.TREES}) == 1
