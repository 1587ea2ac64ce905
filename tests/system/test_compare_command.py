"""The command `lidarpool compare`."""

import json

import pytest

SCENARIO = """
scene: seed
cloud: {precision_m: 0.0001, columns: [intensity]}
"""


@pytest.fixture(scope="module")
def surveys(tmp_path_factory, cluster):
    """A survey without noise and with."""
    from lidarpool.cli.commands import main

    folder = tmp_path_factory.mktemp("surveys")
    for name, more in (("clean", ""), ("noisy", "noise: {range_m: 0.02, dropout: 0.1}\n")):
        (folder / f"{name}.yaml").write_text(SCENARIO + more)
        arguments = ["run", str(folder / f"{name}.yaml"), "--out", str(folder / name)]
        with pytest.raises(SystemExit) as ended:
            main([*arguments, "--scheduler", cluster, "--cloud-only", "-q"])
        assert ended.value.code == 0
    return folder


@pytest.mark.slow
def test_the_residual_is_the_noise_that_was_put_in(surveys, lidarpool):
    out = surveys / "out"
    done = lidarpool("compare", surveys / "noisy", surveys / "clean", "--out", out)
    assert (done.code, done.err) == (0, "")
    figures = json.loads((out / "compare.json").read_text())
    image = figures["ranges"]
    told = image["residual"]
    assert told["cells"] == figures["a"]["points"]  # each return is in its cell
    assert figures["intensity"]["rank_correlation"] > 0.999
    lines = done.out.splitlines()
    assert lines[0].endswith(f"noisy: {figures['a']['points']:,} points, 3 sweeps")
    assert "RMSE" in lines[2] and "precision" in lines[3]
    assert lines[-1] == f"page     {out}/compare.html"
    rings = image["rings"]
    assert (out / "compare.html").read_text().count("data-ring=") == len(rings) == 28

    printed = lidarpool(
        *("compare", surveys / "clean", surveys / "clean", "--sweep", "2", "--json"),
        *("--distance", "0.3", "--out", out),
    )
    again = json.loads(printed.out)
    assert printed.code == 0 and again == json.loads((out / "compare.json").read_text())
    assert again["pairs"] == 1 and again["ranges"]["residual"]["rmse_m"] == 0
    assert [one["distance_m"] for one in again["distances"]["f_scores"]] == [0.3]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["clean", "nowhere"], "nowhere does not exist"),
        (["clean", "clean.yaml"], "clean.yaml is not supported. Specify the folder of a result"),
        (
            ["clean", "clean", "--sweep", "3"],
            "Sweep pair 3 does not exist. Pairs are numbered from 0",
        ),
        (
            ["clean", "clean", "--sensor-a", "roof"],
            "does not contain 'roof'. Its sensors have no names",
        ),
        (["clean", "clean", "--intensity-b", "signal"], "it has no column 'signal'"),
        (["clean", "clean", "--distance", "0"], "it must contain positive lengths in meters"),
        (["clean", "clean", "--out", "clean.yaml"], "clean.yaml' is a file"),
        (["clean"], "Missing argument 'B'"),
    ],
)
def test_what_cannot_be_done_is_told_in_a_line(surveys, lidarpool, monkeypatch, arguments, says):
    monkeypatch.chdir(surveys)
    done = lidarpool("compare", *arguments)
    assert done.code == 2 and says in done.err and done.out == ""
    assert len(done.err.splitlines()) <= 2 and not (surveys / "lidarpool-compare").exists()
