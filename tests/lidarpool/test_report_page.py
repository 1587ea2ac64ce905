"""The report as a page: whole, asking for nothing, with the numbers of the report."""

from __future__ import annotations

import io
import re
from base64 import b64decode
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from lxml import html
from PIL import Image
from tests.cloud_counting import counts_of

from lidarpool import Result
from lidarpool.report.page.rendering import (
    MAX_ROWS,
    draw_top_view,
    insert_picture,
    write_page,
)
from lidarpool.report.report import make_report
from lidarpool.run.pipeline.stage_names import COLLECT, GENERATE, INTERSECT, SORT
from lidarpool.run.pipeline.task_book import TaskBook
from lidarpool.run.pipeline.task_records import TaskRecord
from lidarpool.run.planning_trials import TRIAL
from lidarscenario import Planning
from lidarscenario.plan import best
from lidarscenario.plan.trial import run_trial
from lidarscenario.scenario import Scenario
from lidarsim import (
    Cloud,
    Mounted,
    Noise,
    Returns,
    Scene,
    SceneMesh,
    Sensor,
    Survey,
    Track,
    load_sensor,
)
from lidarview.page_templates import sentence

EVIL = (
    "\"'><script>alert(1)</script><img src=//evil.test/x onerror=y>&amp;{{ 7*7 }}\u202e\x00\udc80"
)
PICTURES = ["scene", "hits", "intensity", "cloud", "path"]
SCENARIO = Scenario.from_data({"steps": 35}, source="surveys/hall.yaml")
PLANNING = Planning((0, 0), (10, 0), [(5, 0)], 2.0, trials=3, particles=20, iterations=30)
RING = [(10 + 3 * np.cos(a), 3 * np.sin(a)) for a in np.arange(0, 6.28, 0.5)]
ENCLOSED = Planning((0, 0), (10, 0), RING, 1.5, trials=2, particles=10, iterations=5)


def records(workers: int = 1, tasks: int = 20, prefix: str = "") -> list[TaskRecord]:
    """Tasks of a run of ten seconds: three long ones, short ones, and trials."""

    def record(stage: str, partition: str, worker: str, start: float, stop: float) -> TaskRecord:
        name = f"{prefix}{partition}-{worker}"
        items = 1 if stage == TRIAL else 6
        return TaskRecord(stage, partition, name, (partition,), start, stop, items=items)

    long = [(GENERATE, 1, 5), (SORT, 1.5, 6), (COLLECT, 1.6, 6.1), (COLLECT, 1.7, 6.2)]
    of = np.random.default_rng(3).integers(0, workers, tasks)
    made = [record(stage, "LIDAR", "0", start, stop) for stage, start, stop in long]
    for number in range(tasks):
        at = 1 + 4 * number / tasks
        made.append(record(INTERSECT, "GPU", str(of[number]), at, at + 2 / tasks))
        at = 10 * number / tasks
        made.append(record(TRIAL, "OTHER", str(of[number]), at, at + 9 / tasks))
    return made


def scene_of(names: Sequence[str]) -> Scene:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    faces = np.array([[0, 1, 2]])
    return Scene.from_meshes(
        [SceneMesh(name, corners + 2 * k, faces) for k, name in enumerate(names)]
    )


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
def write(tmp_path: Path) -> Callable[..., tuple[str, dict[str, Any]]]:
    """Make a result up and write its page; returns the page and the report."""

    def write(
        names: Sequence[str] = ("Tower", "Wall"),
        points: int = 500,
        tasks: Sequence[TaskRecord] = tuple(records()),
        plan: Planning | None = PLANNING,
        scenario: Scenario | None = SCENARIO,
        origin: tuple[float, float, float] = (0, 0, 0),
        cloud: Cloud | None = None,
        *,
        epsg: int | None = None,
        **changes: Any,
    ) -> tuple[str, dict[str, Any]]:
        scene = replace(scene_of(names), origin=np.array(origin))
        survey = Survey(Sensor.grid(layers=16), poses=[(0, 0, 1), (1, 0, 2)], steps=60, epsg=epsg)
        trials = tuple(run_trial(plan, number) for number in range(plan.trials)) if plan else ()
        book = TaskBook()
        for task in tasks:
            book.add_task(task)
        result = Result(
            **{
                "scene": scene,
                "survey": survey,
                "planning": plan,
                "points": cloud or cloud_of(points, len(names), survey.scan_count, 16),
                "plan": best(trials, plan) if plan else None,
                "trials": trials,
                "backend": "numpy",
                "rays": survey.ray_count,
                "hit_count": 5 * points,
                "stages": tuple(book.stages.values()),
                "seconds": 10.0,
                "survey_seconds": 6.2,
                "planning_seconds": 10.0 if plan else 0.0,
                "replayed": 3,
                "resumed": 0,
                "notes": (),
                "identity": {},
                "_hit_counts": lambda: np.zeros(len(scene.faces), np.int64),
                "sample_rays": np.zeros((0, 2, 3), np.float32),
            }
            | changes
        )
        drawn = PICTURES if plan else PICTURES[:4]
        page = tmp_path / "report.html"
        numbers = counts_of(result.points, len(scene.names))
        report = make_report(result, numbers)
        write_page(page, report, result, numbers, scenario)
        for name in drawn:
            insert_picture(page, name, f'<svg id="{name}"></svg>')
        return page.read_text(encoding="utf-8"), report

    return write


def test_the_page_refers_to_nothing_outside_and_has_its_pictures_within(write):
    text, _ = write()
    page = html.fromstring(text)
    assert not page.xpath("//script | //link | //iframe | //object | //embed | //base")
    assert not page.xpath("//@srcset | //@action | //@poster | //@data")
    assert all(source.startswith("data:image/png;base64,") for source in page.xpath("//@href"))
    assert not re.search(r"url\(|@import|https?://|\son\w+=", text)
    assert "default-src 'none'" in page.xpath("//meta[@http-equiv]/@content")[0]
    assert not page.xpath("//@src")
    assert page.xpath("//figure/svg/@id") == PICTURES
    assert page.xpath("//figure[not(@hidden)]/@data-picture") == [*PICTURES, "above"]


def test_pictures_come_into_the_page_when_they_are_drawn(write, tmp_path):
    text, _ = write(plan=None)
    assert html.fromstring(text).xpath("//figure[@hidden]/@data-picture") == ["path"]
    page = tmp_path / "report.html"
    for size in (9, 1):
        insert_picture(page, "path", f'<svg class="{size * "x"}">\\1</svg>')
    assert page.read_text("utf-8") == text.replace(
        '"path" hidden>\n    \n    <figc', '"path"><svg class="x">\\1</svg><figc'
    )
    page.write_text("of another program")
    insert_picture(page, "path", "<svg></svg>")
    assert page.read_text() == "of another program"


def test_the_points_are_shown_from_above(write):
    places = np.array([(0, 0, 0), (0, 0, 1), (0, 0, 2), (10, 0, 0), (0, 5, 0.0)])
    places += 1000
    columns_by_name = {name: np.zeros(5, np.int32) for name in ("scan", "channel", "object")}
    page = html.fromstring(write(cloud=Cloud(places, columns_by_name))[0])
    (source,) = page.xpath("//image/@href")
    with Image.open(io.BytesIO(b64decode(source.partition(",")[2]))) as image:
        shade = np.asarray(image)[..., 3]
    rows, columns = shade.shape
    assert 25 < columns <= 50 and 1.8 < columns / rows < 2.2  # 10 by 5 m
    assert (shade[-1, 0], shade[-1, -1], shade[0, 0]) == (255, 127, 127)  # the north is up
    assert np.count_nonzero(shade) == 3
    (bar,) = page.xpath("//path[@class='scale']/@d")
    (length,) = page.xpath("//text[@class='scale']/text()")
    pixels = float(re.search(r"H([\d.]+)", bar)[1])
    pixel_m = 0.256
    assert length == "2 m" and pixels * pixel_m == pytest.approx(2, abs=0.02)
    (key,) = page.xpath("//span[@class='key']")
    assert re.sub(" +", " ", key.text_content()) == "15.3 45.8 points per m²"  # 1 and 3 in a pixel


@pytest.mark.parametrize(
    ("epsg", "up", "words"), [(25832, "N", "North is up."), (None, "y", "y axis")]
)
def test_the_top_view_has_a_heading_and_an_arrow_up(write, epsg, up, words):
    page = html.fromstring(write(epsg=epsg)[0])
    (figure,) = page.xpath("//figure[@data-picture='above']")
    assert figure.xpath("h2/text()") == ["Top view"] and words in figure.text_content()
    assert figure.xpath(".//text[@class='up']/text()") == [up]
    (steps,) = figure.xpath(".//path[@class='up']/@d")
    x, bottom, tip = map(float, re.match(r"M([\d.]+) ([\d.]+)V([\d.]+)M", steps).groups())
    (image,) = figure.xpath(".//image")
    assert float(image.get("height")) < tip < bottom and x < float(image.get("width"))


def test_sensors_within_the_points_are_marked_from_above(write):
    corners = np.array([(-1, -1, 0), (9, -1, 0), (-1, 4, 0.0)])  # the sensors stand at x of 0 and 1
    columns = {name: np.zeros(3, np.int32) for name in ("scan", "channel", "object")}
    page = html.fromstring(write(cloud=Cloud(corners, columns))[0])
    marks = [
        tuple(
            float(r.get(edge)) + float(r.get(side)) / 2
            for edge, side in (("x", "width"), ("y", "height"))
        )
        for r in page.xpath("//g[@class='stations']/rect")
    ]
    assert page.xpath("//g[@class='stations']/text/text()") == ["1", "2"]
    (size,) = page.xpath("//image")
    rows = int(size.get("height"))
    pixels = 1 / 0.256  # per meter; the first row and column are of points 1 m from the marks
    (first, y), (second, other_y) = marks
    assert second - first == pytest.approx(pixels, abs=0.11)
    assert pixels - 0.1 <= first <= pixels + 1.1
    assert y == other_y and rows - pixels - 1.1 <= y <= rows - pixels + 0.1
    assert "with the numbers of the sensor positions" in page.text_content()


def test_stations_above_each_other_share_a_mark_with_all_their_numbers():
    marks = [(8, 8, 1), (8, 8, 2), (8, 8.1, 3), (20, 8, 4), (20, 8, 6), (30, 20, 5)]
    page = html.fromstring(draw_top_view(np.ones((30, 40)), marks=marks))
    texts = page.xpath("//g[@class='stations']/text")
    assert {t.text: float(t.get("x")) for t in texts} == {"1–3": 8.0, "4, 6": 20.0, "5": 30.0}


@pytest.mark.extended
def test_the_title_has_the_scenario_where_no_sensor_has_a_model(write):
    assert "<h1>hall, from 2 positions</h1>" in write()[0]
    assert "<h1>Sensor with 16 channels from 2 positions</h1>" in write(scenario=None)[0]
    assert "<dd>2</dd><dt>sensor positions</dt>" in write()[0]


def test_cells_of_wide_tables_have_the_names_of_their_columns(write):
    page = html.fromstring(write()[0])
    row = page.xpath("//table[@class='wide']//tr[@data-column='scan']/td")
    names = ["unit", "minimum", "maximum", "meaning"]
    assert [cell.get("data-name") for cell in row] == names


@pytest.mark.extended
def test_names_are_words_and_never_markup(write):
    tame, _ = write(notes=("a note",))
    evil, _ = write(
        (EVIL, "Wall"),
        tasks=records(prefix=EVIL),
        scenario=Scenario.from_data({"scene": EVIL[:-1]}, source=f"surveys/{EVIL}"),
        notes=(EVIL,),
        backend=EVIL,
    )
    shapes = [
        [(element.tag, *sorted(element.keys())) for element in html.fromstring(text).iter()]
        for text in (tame, evil)
    ]
    assert shapes[0] == shapes[1]
    assert "x onerror=y>&amp;{{ 7" in html.fromstring(evil).xpath("string(//dl[1])")
    assert not set("\u202e\x00\udc80") & set(evil)


def test_numbers_are_those_of_the_report(write):
    text, report = write()
    page = html.fromstring(text)
    pairs = {dt.text: dt.getnext().text for dt in page.xpath("//dl[@class='pairs']//dt")}
    assert pairs["batches repeated because a worker was lost"] == "3"
    assert pairs["tasks outside their partition"] == "0"
    assert pairs["shortest possible path"] == f"{report['planning']['shortest_possible']:.2f} m"
    lead = page.xpath("//p[@class='lead']")[0].text_content()
    assert lead.startswith(
        f"120 scans (4 sweeps) from 2 positions with {report['rays']:,} rays and 2 objects"
    )
    assert (
        "2,500 hits. The cloud contains 500 points. A path was searched with 3 particle swarms"
        in lead
    )
    rows = {row.get("data-stage"): row for row in page.xpath("//tr[@data-stage]")}
    assert list(rows) == list(report["stages"])
    for stage, told in report["stages"].items():
        cells = [cell.text_content() for cell in rows[stage].findall("td")]
        assert cells[:3] == [told["partition"], str(len(told["workers"])), str(told["tasks"])]


def test_what_differs_from_an_ideal_sensor_is_told_of_each(write):
    sensor = load_sensor("velodyne/vlp16", max_range_m=60)
    own = Noise(0.02, detection_range_m=60, false_alarm_hz=2000)
    survey = Survey(
        sensors=[
            Mounted(sensor, name="left", noise=own),
            Mounted(sensor, name="right", returns=Returns("dual", subrays=7)),
        ],
        poses=[(0, 0, 1)],
        steps=60,
        noise=Noise(detection_range_m=50),
        rain_mm_h=10,
    )
    text, report = write(survey=survey)
    left, right = report["parameters"]["sensors"].values()
    assert (left["noise"]["false_alarm_hz"], right["noise"]["false_alarm_hz"]) == (2000, 0)
    assert (left["returns"]["mode"], right["returns"]["mode"]) == ("strongest", "dual")
    heads = html.fromstring(text).xpath("//h3")
    told = {
        head.text: {dt.text: dt.getnext().text for dt in head.getnext().iter("dt")}
        for head in heads
        if head.getnext().tag == "dl"
    }
    assert told["Noise of sensor left"] == {
        "range_m": "0.02", "detection_range_m": "60", "false_alarm_hz": "2,000",
    }  # fmt: skip
    assert told["Returns of sensor right"] == {"mode": "dual", "subrays": "7"}
    assert told["Noise of sensor right"] == {"detection_range_m": "50"}
    assert "Returns of sensor left" not in told
    assert "<dt>rain_mm_h</dt><dd>10</dd>" in text and "snow_mm_h" not in text


def test_figures_have_the_digits_that_are_read(write):
    """The VLP-16's firings in a turn are 1,808.4491."""
    sensor = load_sensor("velodyne/vlp16", max_range_m=1234.5678)
    survey = Survey(
        sensors=[Mounted(sensor, name="left", noise=Noise(detection_range_m=100.8767244))],
        poses=[(0, 0, 1)], steps=60, visibility_km=10 / 3,
    )  # fmt: skip
    text, _ = write(survey=survey, origin=(500_000.123456, -0.00004, 1.5), tasks=())
    told = {
        dt.text: dt.getnext().text for dt in html.fromstring(text).xpath("//dl[@class='pairs']//dt")
    }
    assert told["firings per turn"] == "1,808.4" and told["range"] == "0.4 m to 1,234.6 m"
    assert (told["detection_range_m"], told["visibility_km"]) == ("100.9", "3.333")
    assert told["local origin"] == "(500,000.123, 0, 1.5) m"
    assert told["overlap of survey and planning"] == "0 s"


@pytest.mark.extended
def test_scanning_of_a_flight_is_on_its_lines(write):
    """Of 20 s, a turn of 4 s."""
    rates = np.radians(np.where((np.arange(401) > 160) & (np.arange(401) <= 240), 45, 0))
    headings = np.cumsum(rates) * 0.05
    steps = 3.0 * np.stack([np.cos(headings), np.sin(headings), 0 * headings], axis=1)
    track = Track(np.arange(401) * 0.05, np.cumsum(steps, axis=0))
    text, report = write(survey=Survey(load_sensor("airborne/riegl-vq780i"), trajectory=track))
    assert "<dt>scanning time on 2 flight lines</dt>" in text
    lines = report["parameters"]["flight_lines"]
    assert lines["count"] == 2
    assert lines["seconds"] == pytest.approx(16, abs=0.5)
    assert lines["length_m"] == pytest.approx(60 * 16, rel=0.04)
    scanners = [
        Mounted(load_sensor("airborne/riegl-vq780i"), name="first", steps=1),
        Mounted(load_sensor("airborne/riegl-vq780i"), name="strip", steps=5 * 200 * 36),
    ]
    scanners = [replace(m, sensor=replace(m.sensor, start_ns=14e9)) for m in scanners]
    text, report = write(survey=Survey(sensors=scanners, trajectory=track))
    assert "<dt>scanning time on 1 flight line</dt>" in text
    lines = report["parameters"]["flight_lines"]
    assert lines["count"] == 1
    assert lines["seconds"] == pytest.approx(5, abs=0.1)
    assert lines["length_m"] == pytest.approx(60 * 5, rel=0.02)
    text, report = write(survey=Survey(Sensor.grid(), trajectory=track))
    assert re.search("<dd>20[^<]*</dd><dt>scanning time</dt>", text)
    assert report["parameters"]["flight_lines"] is None


def test_hits_on_nothing_are_told_from_those_on_surfaces(write):
    cloud = cloud_of(500, 2, 120, 16)
    cloud["object"][:100] = -1
    on = np.full(len(scene_of(("Tower", "Wall")).faces), 2, np.int64)
    text, report = write(cloud=cloud, _hit_counts=lambda: on)
    assert report["hits_on_surfaces"] == on.sum() < report["hits"] == 2500
    assert f"2,500 hits ({2500 - on.sum():,} of them not on a surface)." in text
    assert f"The {on.sum():,} hits on surfaces, per square meter" in text


def test_points_by_object_are_all_accounted_for(write):
    names = [f"Part {k}" for k in range(300)]
    text, report = write(names, points=3000)
    rows = re.findall(r'title="(Part \d+)">\d+</th><td>.*?</td><td>([\d,]+)', text)
    assert len(rows) == 25
    counts = [int(count.replace(",", "")) for _, count in rows]
    assert counts == sorted(report["points_by_object"].values(), reverse=True)[:25]
    assert counts == [report["points_by_object"][name] for name, _ in rows]
    more = re.search(r"(\d+) more objects with ([\d,]+) points", text)
    missed = re.search(r"(\d+) objects? without points", text)
    assert int(more[2].replace(",", "")) == report["points"] - sum(counts)
    assert int(more[1]) + 25 + (int(missed[1]) if missed else 0) == 300


@pytest.mark.extended
def test_points_by_class_have_the_names_of_classes(write):
    assert "Points by class" not in write()[0]
    cloud = cloud_of(500, 2, 120, 16)
    cloud.columns["class"] = np.repeat(np.array([40, 0, 7], np.uint16), [300, 150, 50])
    survey = Survey(Sensor.grid(layers=16), [(0, 0, 1)], classes={40: "<road>", 9: "pole"})
    text, report = write(cloud=cloud, survey=survey)
    assert report["classes"] == {
        "0": {"points": 150}, "7": {"points": 50}, "40": {"points": 300},
    }  # fmt: skip
    assert report["class_names"] == {9: "pole", 40: "<road>"}
    rows = html.fromstring(text).xpath("//h3[.='Points by class']/following-sibling::table[1]//tr")
    told = [[cell.text_content() for cell in row.iter("th", "td")] for row in rows]
    assert [(row[0], row[2]) for row in told] == [
        ("40 <road>", "300"),
        ("0 none", "150"),
        ("7", "50"),
    ]


def density_of(positions: np.ndarray, cell_m: float) -> tuple[float, float]:
    """Mean and median of the points per square meter of the cells with points, by a histogram.

    The boundaries of cells are shifted by 0x15555555 steps of a millimeter.
    """
    columns = np.round(positions[:, :2] * 1000).astype(np.int64) + 0x15555555
    _, counts = np.unique(columns // round(1000 * cell_m), axis=0, return_counts=True)
    return counts.mean() / cell_m**2, float(np.median(counts)) / cell_m**2


@pytest.mark.parametrize("each", [4.0, 11.5, 400.0])
def test_the_density_is_that_of_the_ground_from_above(write, each):
    """Of a square with a sparser corner, at random and wherever it is."""
    random = np.random.default_rng(int(each))
    side = np.sqrt(60_000 / each)
    ground = random.uniform(0, side, (60_000, 3)) * [1, 1, 0.05]
    in_corner = (ground[:, :2] < 0.4 * side).all(axis=1) & (random.uniform(size=60_000) < 0.75)
    positions = (ground[~in_corner] + [-170, 60, 100]).round(3)
    columns = {name: np.zeros(len(positions), np.int32) for name in ("scan", "channel", "object")}
    text, report = write(cloud=Cloud(positions, columns))
    told = report["points_per_m2"]
    mean, median = density_of(positions, told["cell_m"])
    assert (told["mean"], told["median"]) == pytest.approx((mean, median), rel=1e-9)
    # Cells at the border have fewer points, and there are more of these, the larger cells are.
    whole = (1 - 0.75 * 0.4**2) * each
    assert told["median"] == pytest.approx(each, rel=0.08)
    assert 0.85 * whole < told["mean"] < whole < told["median"]
    assert 30 <= told["median"] * told["cell_m"] ** 2 < 30 * 4 * 1.1
    assert f"median of all {told['cell_m']:.3g} m cells that contain points" in text


def test_clouds_of_other_densities_have_other_numbers(write):
    """Also where the squares of both are of the same size."""
    told = []
    for each in (9.0, 9.1):
        side = np.arange(0, 40, 1 / np.sqrt(each))
        x, y = (axis.ravel() for axis in np.meshgrid(side, side))
        columns = {name: np.zeros(len(x), np.int32) for name in ("scan", "channel", "object")}
        _, report = write(cloud=Cloud(np.stack([x, y, 0 * x], axis=1), columns))
        told.append(report["points_per_m2"])
    assert told[0]["cell_m"] == told[1]["cell_m"]
    assert told[1]["mean"] / told[0]["mean"] == pytest.approx(9.1 / 9.0, rel=0.01)
    assert told[1]["mean"] > told[0]["mean"]


def lanes(text: str) -> list[str]:
    """What is said of each lane of the timeline."""
    return html.fromstring(text).xpath("//path[contains(@class, 'lane')]/title/text()")


@pytest.mark.extended
def test_the_timeline_shows_who_worked_when_and_is_bounded(write):
    text, _ = write()
    assert lanes(text)[5:] == [
        "GPU-0: intersect, 20 tasks, 2 s",
        "LIDAR-0: generate, 1 task, 4 s", "LIDAR-0: sort frames, 1 task, 4.5 s",
        "LIDAR-0: collect points, 2 tasks, 9 s",
        "OTHER-0: plan path, 20 tasks, 9 s",
    ]  # fmt: skip
    bars = re.findall(r'class="lane s-generate".*?d="M([\d.]+) 9H([\d.]+)"', text)
    assert len(bars) == 2  # of the stage and of its worker, between first start and last stop
    for bar in bars:
        assert [float(x) for x in bar] == pytest.approx([1000 / 9.95, 5000 / 9.95], abs=0.1)
    text, _ = write(tasks=records(workers=200, tasks=10_000))
    assert len(text) < 2_000_000
    assert len(lanes(text)) == 5 + 3 + 2 * MAX_ROWS
    assert "; only the 24 busiest of 200 rows are shown" in text and f"{20_004:,} tasks in" in text


CLOUD = cloud_of(500, 2, 120, 16)
RANGES = {**CLOUD.columns, "range": np.linspace(0.5, 98.7, 500).astype(np.float32)}
RANGED = Cloud(CLOUD.positions, RANGES)
STRAY = TaskRecord(TRIAL, "OTHER", "GPU-0", ("GPU",), 0, 1)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"points": 0, "hit_count": 0},
            "contains no points, because no ray hit a surface within range.",
        ),
        ({"points": 1}, "The cloud contains 1 point"),
        ({"tasks": (), "resumed": 120}, "No tasks were run"),
        ({"plan": ENCLOSED}, "none, because the obstacles block the way"),
        ({"plan": Planning((0, 0), (10, 0), trials=1, particles=5, iterations=1)}, "no obstacle"),
        (
            {"tasks": [*records(), STRAY]},
            "A task of stage trial ran on GPU-0, which is not in partition OTHER.",
        ),
        ({}, "are not recorded"),
        ({"cloud": RANGED}, "0.5 to 98.7 m"),
    ],
)
def test_what_is_unusual_is_told(write, changes, words):
    assert words in write(**changes)[0]


@pytest.mark.parametrize(
    ("note", "shown"),
    [
        ("all points are of class 0", "All points are of class 0"),
        ("KITTI cannot store time", "KITTI cannot store time"),
        ("nuScenes cannot store time", "nuScenes cannot store time"),
        ("rosbag2 cannot store time", "rosbag2 cannot store time"),
        ("wall.obj has no faces", "wall.obj has no faces"),
    ],
)
def test_notes_begin_with_a_capital_unless_with_a_name(write, note, shown):
    page = html.fromstring(write(notes=(note,))[0])
    assert page.xpath("//section[@class='notes']//li/text()") == [shown]


def test_a_name_that_looks_like_a_word_keeps_its_first_letter():
    note = "out contains only one in every 5 hits"
    assert (
        sentence(note) == "Out contains only one in every 5 hits"
        and sentence(note, ["out"]) == note
    )


def test_without_planning(write):
    text, _ = write(plan=None, tasks=[task for task in records() if task.stage != TRIAL])
    assert "The path" not in text and "swarm" not in text and text.count(" hidden>") == 1


@pytest.mark.extended
def test_the_scenario_on_the_page_is_the_scenario(write):
    scenario = Scenario.from_data(
        {
            "scene": {
                "files": ["part <1>.stl"],
                "copies": [{"name": "A", "box": [1, 2, 3], "at": [[1, 2]], "class": 3}],
            },
            "materials": [{"objects": "*", "class": 2}],
            "classes": {2: "metal", 3: "box"},
            "poses": [{"position": [1, 2, 3], "yaw_deg": 5}],
            "planning": {"start": [0, 0], "target": [9, 9], "obstacles": []},
        }
    )
    (shown,) = html.fromstring(write(scenario=scenario)[0]).xpath("//pre/code/text()")
    assert Scenario.from_data(yaml.safe_load(shown)).model_dump() == scenario.model_dump()
    many = Scenario.from_data({"poses": [{"position": [k, 0, 1]} for k in range(5000)]})
    assert len(write(scenario=many)[0]) < len(write()[0]) + 60_000
