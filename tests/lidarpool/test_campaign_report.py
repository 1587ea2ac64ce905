"""The card of a data set: README, page, figures, pictures, splits."""

import html
import json
import re
import tracemalloc
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from lidarfiles.datasets.figures import DataSetStatistics
from lidarfiles.datasets.job_seconds import read_seconds
from lidarfiles.datasets.job_table import JobRow
from lidarpool.report.campaign_report import write_card
from lidarsim import LidarError
from lidarsim.io.storage import Storage
from lidarview.render.picture_page import Page

NAMES = ("visibility", "model", "night")
EVIL = '<script>alert(1)</script> | `x` $\\frac{1 [a](b) \u202e "'


def row(number, **given):
    models = ("vlp16", "os1-64")
    values = {"visibility": 0.1 * 1.2**number, "model": models[number % 2], "night": number % 3 > 0}
    split = ("train", "train", "val")[number % 3]
    counts = {"scans": 20, "sweeps": 2, "rays": 2000, "hits": 1000 + number, "points": 500 + number}
    more = {
        "seconds": 0.1 * number,
        "sha256": f"{number:064x}",
        "classes": {0: 100, 6: 400 + number},
    }
    known = {"name": f"{number:02d}", "split": split, "values": values} | counts | more
    return JobRow(number, **(known | given))


ROWS = [row(k) for k in range(30)]
ROWS[3] = JobRow(3, "03", "train", ROWS[3].values, "no <b>surface</b> | in range\nmove the sensor")


def write(place, rows, picture=None, versions=None, **given):
    """Write the card of a campaign and its run, of which some may be given."""
    of = SimpleNamespace(**{
        "title": "Drives", "count": 31, "seed": 7, "names": NAMES, "license": "CC-BY-4.0",
        "command": "campaign.yaml", "description": "", "keep": {"format": "kitti"},
        "sensors": {"roof": "velodyne/vlp16, 10 Hz"}, "seconds": 0.0, "resumed": 0, "replayed": 0,
        "notes": (), "stages": (), "classes": {},
    } | given)  # fmt: skip
    versions = versions or {"lidarpool": "1.2 (sources 01234567)"}
    return write_card(place, vars(of), of, rows, versions, picture)


@pytest.fixture(scope="module")
def card(tmp_path_factory):
    folder = tmp_path_factory.mktemp("set")
    place = Storage.at(folder, durable=False)
    return folder, write(place, iter(ROWS), Page((80, 40)))


@pytest.mark.extended
def test_figures_are_those_of_done_jobs(card):
    folder, report = card
    assert json.loads((folder / "report.json").read_text()) == report
    done = [one for one in ROWS if one.done]
    assert report["jobs"] == {"described": 31, "done": 29, "failed": 1, "resumed": 0}
    assert report["totals"]["points"] == sum(one.points for one in done)
    assert report["classes"]["6"] == {
        "points": sum(one.classes[6] for one in done), "jobs": 29,
    }  # fmt: skip
    assert report["of_a_job"]["points"]["median"] == np.median([one.points for one in done])
    visibility, model, night = report["varied"]
    assert visibility["rank_correlation_with_points"] == 1.0
    assert visibility["lowest"] == 0.1 and visibility["jobs"] == 30
    assert model["values"] == {"os1-64": 15, "vlp16": 15}
    assert night["values"] == {"false": 10, "true": 20}
    [failed] = report["failed"]
    assert failed["number"] == 3 and failed["error"] == ROWS[3].error
    assert [one["number"] for one in report["slowest"]] == list(range(29, 19, -1))


@pytest.mark.extended
def test_splits_name_the_jobs_that_are_there(card):
    folder, report = card
    train, val = ((folder / "splits" / f"{n}.txt").read_text().split() for n in ("train", "val"))
    assert val == [one.name for one in ROWS if one.split == "val"]
    assert "03" not in train and len(train) == 19
    assert report["splits"]["train"]["jobs"] == 19


def test_card_says_how_to_read_and_repeat(card):
    folder, report = card
    text = (folder / "README.md").read_text()
    for part in (
        "# Drives", 'lidarpool.sweeps(".", split="train")', "CC-BY-4.0", "velodyne/vlp16, 10 Hz",
        "lidarpool run campaign.yaml --job 0 --out", "1.2 (sources 01234567)", report["sha256"],
        "| 29 (1 failed) |", "| 6 |", "`visibility` | 0.1 to 19.78", "os1-64, vlp16",
    ):  # fmt: skip
        assert part in text, part
    pictures = re.findall(r"!\[.*?\]\((.*?)\)", text)
    assert pictures == ["pictures/job.png", "pictures/varied.png", "pictures/results.png"]
    assert all((folder / path).is_file() for path in pictures)


@pytest.mark.extended
def test_classes_have_their_names(tmp_path):
    place = Storage.at(tmp_path, durable=False)
    write(place, [row(1, classes={0: 5, 6: 10, 7: 20})], classes={6: "building & yard", 9: "water"})
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["class_names"] == {"6": "building & yard", "9": "water"}
    card, page = ((tmp_path / name).read_text() for name in ("README.md", "report.html"))
    for label in ("0 none", "6 building & yard", "7"):
        assert f"| {label} |" in card.replace("\\", "")
        assert f'title="{html.escape(label)}"' in page
    assert "water" not in card


def test_page_shows_what_failed_and_why(card):
    folder, _ = card
    page = (folder / "report.html").read_text()
    assert page.startswith("<!DOCTYPE html>")
    assert "1 failed job" in page and "no &lt;b&gt;surface&lt;/b&gt; | in range" in page
    assert "1 job of the campaign is missing from the table" in page
    assert page.count("<svg viewBox") == 3 and "var(--picture-ink" in page
    assert "campaign.yaml --retry-failed" in page


@pytest.mark.slow
def test_same_jobs_make_the_same_files(card, tmp_path):
    folder, report = card
    other = [*ROWS[:-1], row(29, sha256="f" * 64)]
    assert write(Storage.at(tmp_path, durable=False), other)["sha256"] != report["sha256"]
    write(Storage.at(tmp_path, durable=False), ROWS)
    for name in ("report.html", "report.json", "splits/train.txt", "pictures/varied.png"):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes(), name


@pytest.mark.extended
def test_casting_times_are_in_the_report_alone(card, tmp_path):
    folder, _ = card
    slower = [replace(row, seconds=2 * row.number + 1) if row.done else row for row in ROWS]
    place = Storage.at(tmp_path, durable=False)
    write(place, slower, Page((80, 40)))
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    changed = {
        name for name in names if (tmp_path / name).read_bytes() != (folder / name).read_bytes()
    }
    assert changed == {"report.html", "report.csv", "report.json"}
    assert read_seconds(place) == {row.number: row.seconds for row in slower if row.done}


@pytest.mark.extended
def test_unknown_casting_times_are_empty(tmp_path):
    rows = [row(0, seconds=2.0), row(1, seconds=None), row(2, seconds=5.0), row(3, seconds=None)]
    report = write(Storage.at(tmp_path), rows)
    assert (tmp_path / "report.csv").read_text() == "number,seconds\n0,2.0\n1,\n2,5.0\n3,\n"
    assert read_seconds(Storage.at(tmp_path)) == {0: 2.0, 2: 5.0}
    assert report["seconds"]["casting"] == 7.0
    assert report["of_a_job"]["seconds"]["lowest"] == 2.0
    assert [one["seconds"] for one in report["slowest"]] == [5.0, 2.0]
    report = write(Storage.at(tmp_path), rows[1::2])
    assert report["of_a_job"]["seconds"] is None and report["slowest"] == []
    page = (tmp_path / "report.html").read_text()
    assert "The casting times of the jobs are unknown." in page


@pytest.mark.extended
def test_the_card_counts_jobs_in_which_a_quantity_is_not_set(tmp_path):
    unset = {"visibility": None, "model": "vlp16", "night": None}
    rows = [row(0), *(row(k, values=unset) for k in range(1, 20))]
    rows += [JobRow(20, "20", "", {}, "the function raised KeyError")]  # its values are unknown
    report = write(Storage.at(tmp_path), rows)
    assert {one["name"]: one["unset"] for one in report["varied"]} == {
        "visibility": 19, "model": 0, "night": 19,
    }  # fmt: skip
    card = (tmp_path / "README.md").read_text()
    assert "| `visibility` | 0.1 to 0.1, median 0.1; not set in 19 jobs |" in card
    assert "| `model` | vlp16 |" in card and "| `night` | false; not set in 19 jobs |" in card
    assert "boxes of the actors" in card
    write(Storage.at(tmp_path), rows[1:20])
    assert "| `visibility` | not set |" in (tmp_path / "README.md").read_text()


@pytest.mark.extended
def test_letters_of_users_are_escaped(tmp_path):
    names = (EVIL, "a")
    rows = [
        row(k, name=f"{k} {EVIL}", values={EVIL: ("x", EVIL)[k % 2], "a": f"v{k}_$x^"})
        for k in range(20)
    ]
    rows.append(JobRow(20, EVIL, "train", {EVIL: EVIL}, EVIL))
    write(
        Storage.at(tmp_path, durable=False), rows, title=EVIL, names=names, sensors={EVIL: EVIL},
        license=EVIL, notes=[EVIL], versions={EVIL: EVIL, "lidarpool": EVIL}, command=EVIL,
        description=EVIL, keep={"format": EVIL},
    )  # fmt: skip
    page = (tmp_path / "report.html").read_text()
    assert "<script" not in page and "\u202e" not in page
    assert "&lt;script&gt;alert(1)" in html.unescape(html.escape(page))
    card = re.sub(r"```.*?```", "", (tmp_path / "README.md").read_text(), flags=re.DOTALL)
    assert "<script" not in card.replace(r"\<", "")
    assert "[a](b)" not in card.replace(r"\[", "").replace(r"\]", "")


@pytest.mark.slow(every=9)
@pytest.mark.parametrize(
    "rows",
    [
        [],
        [JobRow(0, "0", "", {"visibility": 1.0}, "no scene")],
        [row(0)],
        [row(0, values={}), row(1, values={})],
        [row(k, values={"visibility": v}) for k, v in enumerate([1, 2.5, "auto", True])],
        [
            row(k, values={"visibility": v})
            for k, v in enumerate([float("inf"), float("nan"), -5.0])
        ],
        [row(k, values={"visibility": v}) for k, v in enumerate([0.3, 0.1 + 0.2])],
        [row(k, points=0, hits=0, rays=0, seconds=0.0, classes={}) for k in range(4)],
        [row(k, values={"model": f"city-{k:04d}.glb"}) for k in range(60)],
    ],
    ids=range(9),
)
def test_any_jobs_have_a_card(tmp_path, rows):
    report = write(Storage.at(tmp_path, durable=False), rows)
    assert report["jobs"]["done"] == sum(one.done for one in rows)
    assert (tmp_path / "README.md").is_file() and (tmp_path / "report.html").is_file()
    text = (tmp_path / "README.md").read_text()
    assert all((tmp_path / path).is_file() for path in re.findall(r"\((pictures/.*?)\)", text))


@pytest.mark.extended
def test_an_earlier_report_goes_first(tmp_path):
    """What has a report.json is complete."""

    def broken():
        yield ROWS[0]
        raise LidarError("the database cannot be read")

    place = Storage.at(tmp_path, durable=False)
    write(place, ROWS)
    with pytest.raises(LidarError, match="database"):
        write(place, broken())
    assert not (tmp_path / "report.json").exists()


@pytest.mark.parametrize("split", ["../x", "a/b", "-", "a\nb"])
def test_splits_are_names_of_files(tmp_path, split):
    with pytest.raises(LidarError, match="is not a valid split name"):
        write(Storage.at(tmp_path), [row(0, split=split)])


@pytest.mark.slow
def test_memory_is_bounded():
    """A job takes some numbers."""
    tracemalloc.start()
    figures = DataSetStatistics(NAMES, (row(k % 30) for k in range(20_000)))
    taken = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert figures.jobs == 20_000 and taken < 20_000 * 100
