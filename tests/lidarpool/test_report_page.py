"""The report as a page: whole, asking for nothing, with the numbers of the report."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from lidarpool import Cloud, Planning, Result, Scene, Survey
from lidarpool.base.task_book import TaskBook
from lidarpool.plan import best
from lidarpool.plan.trial import run_trial
from lidarpool.report.cloud_numbers import CountedCloud
from lidarpool.report.page.page import OBJECTS_MOST, write_page
from lidarpool.report.page.timeline import ROWS_MOST
from lidarpool.report.report import make_report
from lidarpool.run.trials import TRIAL
from lidarpool.scan import COLLECT, GENERATE, INTERSECT, SORT
from lidarpool.scenario.scenario import Scenario
from lidarpool.scene.mesh import Mesh
from lidarpool.sensor import Sensor
from poolpart import TaskRecord

VOID = {"meta", "img", "br", "link", "input"}
EVIL = (
    "\"'><script>alert(1)</script><img src=//evil.test/x onerror=y>&amp;{{ 7*7 }}\u202e\x00\udc80"
)
PICTURES = ["scene.png", "intensity.png", "cloud.png", "path.png"]
SCENARIO = Scenario.from_data({"steps": 35}, source="surveys/hall.yaml")
EPOCH = 1.7e9


class Page(HTMLParser):
    """A page as its parser sees it; every element has to be closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.text: list[str] = []  # of each element, by its number
        self._open: list[int] = []
        self.feed(text)
        self.close()
        assert not self._open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))
        self.text.append("")
        if tag not in VOID:
            self._open.append(len(self.elements) - 1)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))
        self.text.append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.elements[self._open.pop()][0] == tag

    def handle_data(self, data: str) -> None:
        for number in self._open:
            self.text[number] += data

    def all(self, tag: str, class_: str | None = None) -> list[int]:
        """Numbers of the elements of a kind."""
        return [
            number
            for number, (name, attributes) in enumerate(self.elements)
            if name == tag and (class_ is None or class_ in attributes.get("class", "").split())
        ]

    def texts(self, tag: str, class_: str | None = None) -> list[str]:
        return [" ".join(self.text[number].split()) for number in self.all(tag, class_)]

    def attributes(self, tag: str, name: str) -> list[str]:
        return [self.elements[n][1][name] for n in self.all(tag) if name in self.elements[n][1]]

    def pairs(self) -> dict[str, str]:
        """All descriptions with what they describe."""
        return dict(zip(self.texts("dt"), self.texts("dd"), strict=True))


def records(workers: int = 1, tasks: int = 20, prefix: str = "") -> list[TaskRecord]:
    """Tasks of a run of ten seconds: three long ones, short ones, and trials."""

    def record(stage: str, partition: str, worker: str, start: float, stop: float) -> TaskRecord:
        name, items = f"{prefix}{partition}-{worker}", 1 if stage == TRIAL else 6
        return TaskRecord(
            stage, partition, name, (partition,), EPOCH + start, EPOCH + stop, items=items
        )

    long = [(GENERATE, 1, 5), (SORT, 1.5, 6), (COLLECT, 1.6, 6.1), (COLLECT, 1.7, 6.2)]
    of = np.random.default_rng(3).integers(0, workers, tasks)
    made = [record(stage, "LIDAR", "0", start, stop) for stage, start, stop in long]
    for number in range(tasks):
        at = 1 + 4 * number / tasks
        made.append(record(INTERSECT, "GPU", str(of[number]), at, at + 2 / tasks))
        at = 10 * number / tasks
        made.append(record(TRIAL, "OTHER", str(of[number]), at, at + 9 / tasks))
    return made


@pytest.fixture(scope="module")
def planning() -> Planning:
    return Planning((0, 0), (10, 0), [(5, 0)], 2.0, trials=3, particles=20, iterations=30)


def scene_of(names: Sequence[str]) -> Scene:
    corners, faces = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float), np.array([[0, 1, 2]])
    return Scene.from_meshes([Mesh(name, corners + 2 * k, faces) for k, name in enumerate(names)])


def counted(cloud: Any, objects: int) -> CountedCloud:
    """Count a cloud while it is read, as by whoever writes it."""
    counted = CountedCloud(cloud, objects)
    assert sum(map(len, counted.chunks())) == len(counted) == len(cloud)
    return counted


def cloud_of(points: int, objects: int, scans: int, layers: int) -> Cloud:
    random = np.random.default_rng(7)
    positions = random.normal(0, 10, (points, 3)).round(2)
    columns = {
        "scan": np.sort(random.integers(0, scans, points)).astype(np.int32),
        "channel": random.integers(0, layers, points).astype(np.uint16),
        # the later an object, the fewer points it has
        "object": (objects * random.random(points) ** 2).astype(np.int32),
    }
    return Cloud(positions, columns)


@pytest.fixture
def write(tmp_path: Path, planning: Planning) -> Callable[..., tuple[str, dict[str, Any]]]:
    """Make a result up and write its page; returns the page and the report."""

    def write(
        names: Sequence[str] = ("Tower", "Wall"),
        points: int = 500,
        tasks: Sequence[TaskRecord] = tuple(records()),
        plan: Planning | None = planning,
        scenario: Scenario | None = SCENARIO,
        origin: tuple[float, float, float] = (0, 0, 0),
        **changes: Any,
    ) -> tuple[str, dict[str, Any]]:
        scene = replace(scene_of(names), origin=np.array(origin))
        survey = Survey(Sensor.grid(layers=16), poses=[(0, 0, 1), (1, 0, 2)], steps=60)
        trials = tuple(run_trial(plan, number) for number in range(plan.trials)) if plan else ()
        book = TaskBook()
        for task in tasks:
            book.add(task)
        result = Result(
            **{
                "points": cloud_of(points, len(names), survey.scan_count, 16),
                "plan": best(trials, plan) if plan else None,
                "trials": trials,
                "backend": "numpy",
                "rays": survey.ray_count,
                "hits": 5 * points,
                "records": tuple(book.records),
                "stages": tuple(book.stages.values()),
                "seconds": 10.0,
                "survey_seconds": 6.2,
                "planning_seconds": 10.0 if plan else 0.0,
                "replayed": 3,
                "duplicates_dropped": 17,
                "resumed": 0,
                "notes": (),
                "_hit_counts": lambda: np.zeros(len(scene.faces), np.int64),
                "_sample_rays": lambda: np.zeros((0, 2, 3), np.float32),
            }
            | changes
        )
        pictures = PICTURES if plan else PICTURES[:3]
        for name in pictures:
            (tmp_path / name).write_bytes(f"picture {name}".encode())
        files = [*pictures, "report.html", "report.json"]
        cloud = counted(result.points, len(scene.names))
        report = make_report(result, scene, survey, plan, files, cloud)
        write_page(tmp_path / "report.html", report, result, cloud, scenario)
        return (tmp_path / "report.html").read_text(encoding="utf-8"), report

    return write


# -- it needs nothing and nobody -----------------------------------------------------------------


def test_the_page_refers_to_nothing_outside(write):
    text, _ = write()
    page = Page(text)
    references = [
        value
        for _, attributes in page.elements
        for name, value in attributes.items()
        if name in ("src", "href", "srcset", "action", "xlink:href", "poster", "data")
    ]
    assert len(references) == len(PICTURES)
    assert all(reference.startswith(("data:", "#")) for reference in references)
    assert not {"script", "link", "iframe", "object", "embed", "base"} & {
        t for t, _ in page.elements
    }
    assert not [name for _, attributes in page.elements for name in attributes if name[:2] == "on"]
    assert not re.search(r"url\(|@import|https?://", text)
    policy = next(a["content"] for _, a in page.elements if "http-equiv" in a)
    assert "default-src 'none'" in policy


def test_pictures_are_within_with_captions_and_words(write, tmp_path):
    page = Page(write()[0])
    data = [base64.b64decode(uri.split(",")[1]) for uri in page.attributes("img", "src")]
    assert data == [(tmp_path / name).read_bytes() for name in PICTURES]
    assert all(len(words) > 30 for words in page.attributes("img", "alt"))
    assert len(page.all("figcaption")) == len(PICTURES)


def test_names_are_words_and_never_markup(write):
    def shape(page: Page) -> list[tuple[str, list[str]]]:
        return [(tag, sorted(attributes)) for tag, attributes in page.elements]

    notes = ("a note",)
    tame, _ = write(("Tower", "Wall"), tasks=records(), notes=notes)
    evil, _ = write(
        (EVIL, "Wall"),
        tasks=records(prefix=EVIL),
        scenario=Scenario.from_data({"scene": EVIL[:-1]}, source=f"surveys/{EVIL}"),
        notes=(EVIL,),
        backend=EVIL,
    )
    assert shape(Page(evil)) == shape(Page(tame))
    page = Page(evil)
    assert page.texts("h1")[0].startswith("Lidar survey: x onerror=y>&amp;{{ 7*7 }}")
    assert any(text.startswith("\"'><script>alert(1)") for text in page.texts("th"))
    assert not set("\u202e\x00\udc80") & set(evil)


# -- its numbers are the report's ----------------------------------------------------------------


def test_numbers_are_those_of_the_report(write):
    text, report = write()
    page = Page(text)
    pairs = page.pairs()
    assert pairs["batches offered again because a worker was lost"] == "3"
    assert pairs["scans that came twice, and were dropped"] == "17"
    assert pairs["tasks outside their partition"] == "0"
    assert pairs["best length"] == f"{report['planning']['best_length']:.2f} m"
    assert pairs["shortest possible"] == f"{report['planning']['shortest_possible']:.2f} m"
    assert pairs["triangles"] == str(report["parameters"]["triangles"])
    assert pairs["numpy"] == report["versions"]["numpy"]
    (lead,) = page.texts("p", "lead")
    assert lead.startswith(f"120 scans from 2 positions sent {report['rays']:,} rays at 2 objects")
    assert "2,500 hit, and 500 points of them are in the cloud; 3 particle swarms" in lead


def test_the_table_of_stages(write):
    text, report = write()
    rows = re.findall(r'<tr data-stage="(\w+)">(.*?)</tr>', text, re.DOTALL)
    assert [stage for stage, _ in rows] == list(report["stages"])
    for stage, row in rows:
        cells, told = Page(f"<table>{row}</table>").texts("td"), report["stages"][stage]
        assert cells[:3] == [told["partition"], str(len(told["workers"])), str(told["tasks"])]
        assert cells[3].split() == [str(told["items"]), "trials" if stage == TRIAL else "scans"]


def test_points_by_object_are_all_accounted_for(write):
    names = [f"Part {k}" for k in range(300)]
    text, report = write(names, points=3000)
    rows = re.findall(
        r'<th scope="row" title="(Part \d+)">\d+</th>'  # without what all names begin with
        r'<td><b style="width: ([\d.]+)%"></b></td><td>([\d,]+)',
        text,
    )
    assert len(rows) == OBJECTS_MOST
    counts = [int(count.replace(",", "")) for _, _, count in rows]
    assert counts == sorted(report["points_by_object"].values(), reverse=True)[:OBJECTS_MOST]
    assert all(
        report["points_by_object"][name] == n for (name, *_), n in zip(rows, counts, strict=True)
    )
    assert [float(width) for _, width, _ in rows] == [
        pytest.approx(100 * count / counts[0], abs=0.06) for count in counts
    ]
    more = re.search(r"(\d+) more objects with ([\d,]+) points", text)
    missed = re.search(r"(\d+) objects? without points", text)
    assert int(more[2].replace(",", "")) == report["points"] - sum(counts)
    assert int(more[1]) + OBJECTS_MOST + (int(missed[1]) if missed else 0) == 300


class Chunks:
    """A cloud that gives itself out in parts only."""

    def __init__(self, cloud: Cloud) -> None:
        self._cloud, self.bounds, self.table = cloud, cloud.bounds, cloud.table

    def __len__(self) -> int:
        return len(self._cloud)

    def chunks(self, points: int = 0) -> Iterator[Cloud]:
        return self._cloud.chunks(97)


def test_the_cloud_is_counted_in_parts():
    cloud = cloud_of(1000, 2, 12, 16)
    found = counted(Chunks(cloud), 2)
    assert found.by_object.tolist() == np.bincount(cloud["object"]).tolist()
    for name in ("scan", "channel", "object"):
        assert found.limits[name] == (cloud[name].min(), cloud[name].max())
    np.testing.assert_array_equal(found.bounds, cloud.bounds)


# -- the timeline --------------------------------------------------------------------------------


def lanes(page: Page) -> dict[str, list[str]]:
    """{heading: what is said of each of its lanes}."""
    said: dict[str, list[str]] = {}
    for number, (tag, attributes) in enumerate(page.elements):
        if tag == "svg" and "tasks over time" in attributes.get("aria-label", ""):
            heading = said.setdefault(attributes["aria-label"].split(":")[0], [])
        elif tag == "title" and page.elements[number - 1][0] == "path":
            heading.append(page.text[number])
    return said


def test_rows_of_the_timeline(write):
    page = Page(write()[0])
    said = lanes(page)
    assert list(said) == ["Stages", "GPU", "LIDAR", "OTHER"]
    assert len(said["Stages"]) == 5 and said["Stages"][1].startswith("intersect: 20 tasks")
    assert said["GPU"] == ["GPU-0: intersect, 20 tasks, 2 s"]
    assert said["OTHER"] == ["OTHER-0: plan path, 20 tasks, 9 s"]
    assert said["LIDAR"] == [
        "LIDAR-0: generate, 1 task, 4 s", "LIDAR-0: sort frames, 1 task, 4.5 s",
        "LIDAR-0: collect points, 2 tasks, 9 s",
    ]  # fmt: skip


def test_bars_are_where_their_tasks_were(write):
    text, _ = write()
    bars = re.findall(r'class="lane s-generate".*?d="([^"]*)"', text)
    begin, end = 1 / 9.95, 5 / 9.95  # of the time from first start to last stop
    for bar in bars:
        low, high = (float(x) for x in re.fullmatch(r"M([\d.]+) 9H([\d.]+)", bar).groups())
        assert (low, high) == (
            pytest.approx(1000 * begin, abs=0.1),
            pytest.approx(1000 * end, abs=0.1),
        )


def test_hundreds_of_workers_and_tens_of_thousands_of_tasks(write):
    text, _ = write(tasks=records(workers=200, tasks=10_000))
    page = Page(text)
    assert len(text) < 2_000_000 and len(page.elements) < 3000
    said = lanes(page)
    assert {name: len(rows) for name, rows in said.items()} == {
        "Stages": 5, "GPU": ROWS_MOST, "LIDAR": 3, "OTHER": ROWS_MOST,
    }  # fmt: skip
    headings = page.texts("div", "group")
    assert headings[0] == "Stages while at least one task ran"
    assert headings[1].startswith("GPU 200 workers, 10,000 tasks, of which 2,5")
    assert headings[1].endswith("; the busiest 24 of 200 rows")
    assert headings[2] == "LIDAR 1 worker, 4 tasks"
    assert f"{20_004:,} tasks in" in text


# -- what there may not be -----------------------------------------------------------------------


def test_without_planning(write):
    text, _ = write(plan=None, tasks=[task for task in records() if task.stage != TRIAL])
    page = Page(text)
    assert "The path" not in page.texts("h2") and "swarm" not in text
    assert len(page.all("img")) == 3
    assert "at the same time" not in text


def test_an_empty_cloud(write):
    page = Page(write(points=0, hits=0)[0])
    assert "The cloud has no points: no ray hit anything within range." in page.texts("p", "aside")


def test_nothing_ran_because_an_earlier_run_had_done_all(write):
    page = Page(write(tasks=(), resumed=120)[0])
    assert page.pairs()["scans of an earlier run that this one went on with"] == "120"
    assert any(text.startswith("No task ran") for text in page.texts("p", "aside"))


def test_a_single_point(write):
    page = Page(write(points=1)[0])
    assert "1 point of them is in the cloud" in page.texts("p", "lead")[0]


def test_no_way_to_the_target(write):
    ring = [(10 + 3 * np.cos(a), 3 * np.sin(a)) for a in np.arange(0, 6.28, 0.5)]
    closed = Planning((0, 0), (10, 0), ring, 1.5, trials=2, particles=10, iterations=5)
    page = Page(write(plan=closed)[0])
    assert page.pairs()["shortest possible"] == "none, the obstacles leave no way"
    assert page.pairs()["collisions"] == "enters an obstacle"


def test_the_straight_line_is_the_shortest(write):
    page = Page(write(plan=Planning((0, 0), (10, 0), trials=1, particles=5, iterations=1))[0])
    assert page.pairs()["obstacles"] == "0"
    assert page.pairs()["least distance to an obstacle"] == "there are none"


def test_tasks_in_the_wrong_place_are_told(write):
    stray = TaskRecord(TRIAL, "OTHER", "GPU-0", ("GPU",), EPOCH, EPOCH + 1)
    page = Page(write(tasks=[*records(), stray])[0])
    (note,) = page.texts("section", "notes")
    assert note == "A task of trial ran on GPU-0, which is not in OTHER."
    assert "GPU-0: plan path, 1 task, 1 s" in lanes(page)["GPU"]


@pytest.mark.parametrize("replayed", [0, 3])
def test_tasks_of_lost_workers_are_told_to_be_missing(write, replayed):
    text, _ = write(replayed=replayed)
    assert ("has left no record" in text) == (replayed > 0)


def test_the_same_run_gives_the_same_page(write):
    assert write()[0] == write()[0]


def test_a_path_far_from_zero_is_told_in_world_coordinates(write, planning):
    _, near = write()
    _, far = write(origin=(500_000.0, 4_000_000.0, 100.0))
    for place in ("start", "target"):
        assert far["planning"][place] == np.add(near["planning"][place], (5e5, 4e6)).tolist()
    shift = np.subtract(far["planning"]["path"], near["planning"]["path"])
    np.testing.assert_allclose(shift, np.full(shift.shape, (5e5, 4e6)), atol=1e-8)
    assert far["planning"]["best_length"] == near["planning"]["best_length"]


# -- what it was made from ----------------------------------------------------------------------


def test_the_scenario_on_the_page_is_the_scenario(write):
    files = [{"file": "hall.glb", "matrix": np.eye(4).tolist()}, "part <1>.stl"]
    data = {
        "scene": {"files": files},
        "poses": [{"position": [1, 2, 3], "yaw_deg": 5}],
        "planning": {
            "start": [0, 0],
            "target": [9, 9],
            "obstacles": [{"centre": [1, 1], "radius_m": 1}],
        },
    }
    scenario = Scenario.from_data(data)
    page = Page(write(scenario=scenario)[0])
    (shown,) = page.all("code")
    assert (
        Scenario.from_data(yaml.safe_load(page.text[shown])).model_dump() == scenario.model_dump()
    )
    assert not Page(write(scenario=Scenario())[0]).all("code")


def test_a_million_poses_are_cut_short(write):
    scenario = Scenario.from_data({"poses": [{"position": [k, 0, 1]} for k in range(5000)]})
    assert len(write(scenario=scenario)[0]) < len(write()[0]) + 60_000
