"""Campaign files: the jobs that they describe, and a message for each way to get one wrong."""

from __future__ import annotations

import pickle
import re
from collections import Counter
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import yaml

from lidarpool import Campaign
from lidarscenario import Job
from lidarscenario.campaign.campaign_file import is_campaign
from lidarscenario.campaign.campaign_jobs import file_hashes
from lidarscenario.campaign.campaign_sections import JobRandom
from lidarscenario.scenario import Scenario
from lidarsim import LidarError, Noise, Scene, Survey, load_sensor
from lidarsim.sensor.models import model_names

EXAMPLES = Path(__file__).parents[2] / "examples"

BASE = """
scene:
  files: [hall.glb]
  copies:
    - {name: Crate, box: [1, 1, 1], at: [[4, 5, 0]]}
sensors:
  roof: {model: velodyne/vlp16, mount: {position: [0, 0, 2]}}
  front.left: {model: velodyne/vlp16}
trajectory:
  points:
    - {time_s: 0, position: [0, 0, 0]}
    - {time_s: 9, position: [9, 0, 0]}
actors:
  - name: Van
    box: [5, 2, 2]
    trajectory: {points: [{time_s: 0, position: [9, 3, 0]}, {time_s: 9, position: [0, 3, 0]}]}
steps: 4
"""
TRAFFIC = """# Name and place.
name,box,class,trajectory.points.0.time_s,trajectory.points.0.position,trajectory.points
7,"[4, 2, 1.5]",10,,,"[{time_s: 0, position: [0, 1, 0]}, {time_s: 9, position: [9, 1, 0]}]"
Car #8,"[4, 2, 1.5]",,,,"[{time_s: 0, position: [0, 5, 0]}, {time_s: 9, position: [9, 5, 0]}]"
"""


@pytest.fixture
def folder(tmp_path):
    """Return a folder with a base, a table of actors, and mesh files that are not read."""
    (tmp_path / "base.yaml").write_text(BASE)
    (tmp_path / "traffic.csv").write_text(TRAFFIC)
    for name in ("hall.glb", "yard.glb"):
        (tmp_path / name).write_bytes(name.encode())
    return tmp_path


@pytest.fixture
def campaign(folder):
    """Return a function that loads a campaign of what is varied, and other fields."""

    def load(vary=None, **fields):
        path = folder / "campaign.yaml"
        given = {"base": "base.yaml", "count": 40, "seed": 7} | fields
        given = {k: v for k, v in given.items() if v is not None}
        path.write_text(yaml.safe_dump(given | {"vary": vary or {}}, sort_keys=False))
        return Campaign.load(path)

    return load


ALWAYS = [
    18.853258822,
    0.551838115172,
    0.45439467202,
    229826611260,
    4,
    [11, 30, 67, 70],
    [2, 3, 0, 1, 4, 5],
    7817553027339740253,
]
OF_THE_EXAMPLE = {
    "sensors.roof.model": "ouster/os1-32",
    "sensors.roof.mount.position.2": 1.68921121921,
    "weather.visibility_km": 6.5876689241,
    "noise.range_m": 0.0213501171904,
    "scene.files.0.rotation_deg.2": "back",
    "actors": 8,
}


def values(found, name):
    return [found.values(number).get(name) for number in range(found.count)]


# --- what is varied ----------------------------------------------------------------------------


def test_each_kind_of_choice_comes_to_where_its_path_leads(campaign):
    found = campaign({
        "weather.visibility_km": {"log_uniform": [0.2, 20]},
        "noise.range_m": {"normal": {"mean": 0.02, "std": 0.01, "limits": [0, 0.03]}},
        "sensors.roof.model": {"choice": ["velodyne/vlp16", "ouster/os1-64"]},
        "sensors.front.left.mount.position.2": {"uniform": [0.5, 1]},
        "scene.files.0.file": {"choice": ["hall.glb", "yard.glb"]},
        "scene.copies.Crate.box.0": {"uniform": [1, 2]},
        "steps": {"integer": [2, 4]},
        "actors": {"sample": {"from": "traffic.csv", "count": [0, 2]}},
        "returns.subrays": {"each": [1, 7, 19]},
    })  # fmt: skip
    drawn = [found.values(number) for number in range(40)]
    assert [found.name(number) for number in range(2)] == ["0000", "0001"]
    for number, own in enumerate(drawn):
        assert tuple(own) == found.names
        made = found.scenario(number)
        read = (
            made.weather.visibility_km,
            made.noise.range_m,
            made.sensors["roof"].model,
            made.sensors["front.left"].mount.position[2],
            made.scene.files[0].file,
            made.scene.copies[0].box[0],
            made.steps,
            len(made.actors) - 1,
            made.returns.subrays,
        )
        assert read == tuple(own.values())
        assert made.sensors["roof"].mount.position == (0, 0, 2)  # the rest is the base's
    each = list(zip(*(own.values() for own in drawn), strict=True))
    for column, (low, high) in {0: (0.2, 20), 1: (0, 0.03), 3: (0.5, 1), 5: (1, 2)}.items():
        assert low <= min(each[column]) < max(each[column]) <= high
        assert len({*each[column]}) == 40
    assert {*each[6]} == {2, 3, 4} and {*each[7]} == {0, 1, 2}
    assert {*each[2]} == {"velodyne/vlp16", "ouster/os1-64"}
    assert each[8][:6] == (1, 7, 19, 1, 7, 19)


@pytest.mark.extended
def test_numbers_are_distributed_as_they_say():
    draw = JobRandom(1, 2, "test")
    count = 4000
    uniform = np.array([draw.uniform(2, 4) for _ in range(count)])
    assert uniform.mean() == pytest.approx(3, abs=0.04) and uniform.std() == pytest.approx(
        2 / 12**0.5, abs=0.02
    )
    logs = np.log([draw.log_uniform(1, np.e**2) for _ in range(count)])
    assert logs.mean() == pytest.approx(1, abs=0.04)
    normal = np.array([draw.normal(5, 2) for _ in range(count)])
    assert normal.mean() == pytest.approx(5, abs=0.15) and normal.std() == pytest.approx(2, abs=0.1)
    cut = np.array([draw.normal(0, 1, (1, 2)) for _ in range(500)])
    assert cut.min() >= 1 and cut.max() <= 2
    assert Counter(draw.integer(-1, 1) for _ in range(3000)).keys() == {-1, 0, 1}
    weighted = Counter(draw.index(3, (1, 0, 3)) for _ in range(count))
    assert weighted[1] == 0 and weighted[2] / count == pytest.approx(0.75, abs=0.03)
    subsets = Counter(tuple(draw.subset(4, 2)) for _ in range(count))
    assert len(subsets) == 6 and min(subsets.values()) > count / 6 * 0.8


def test_the_values_are_those_of_always():
    """Written down in November 2026: another machine or year must not draw others."""
    draw = JobRandom(7, 417, "weather.visibility_km")
    drawn = [
        *(draw.uniform(0.2, 20), draw.log_uniform(0.2, 20), draw.normal(1, 0.5)),
        *(draw.integer(-(10**12), 10**12), draw.index(5, (1, 2, 3, 4, 5))),
        *(draw.subset(100, 4), draw.permutation(6), draw.bits(63)),
    ]
    assert drawn == ALWAYS
    found = Campaign.load(EXAMPLES / "campaign.yaml")
    assert (found.name(17), found.split(17), found.values(17)) == ("0017", "val", OF_THE_EXAMPLE)
    made = Campaign(
        lambda number, rng: job(rng.bit_generator.random_raw() % 2**60), count=9, seed=7
    ).job(5)
    assert made.values == {"drawn": 720261597643068392}


def test_other_quantities_do_not_change_a_value(campaign):
    visible = {"weather.visibility_km": {"log_uniform": [0.2, 20]}}
    model = {"sensors.roof.model": {"choice": ["velodyne/vlp16", "ouster/os1-64"]}}
    alone = values(campaign(visible), "weather.visibility_km")
    assert values(campaign(visible | model), "weather.visibility_km") == alone
    assert values(campaign(model | visible), "weather.visibility_km") == alone
    assert values(campaign(visible, count=10), "weather.visibility_km") == alone[:10]
    assert not {*values(campaign(visible, seed=8), "weather.visibility_km")} & {*alone}


def test_rows_of_a_table_become_entries(campaign):
    found = campaign({"actors": {"sample": {"from": "traffic.csv", "count": 2}}}, count=1)
    van, *rows = found.scenario(0).actors
    assert (van.name, found.values(0)) == ("Van", {"actors": 2})
    assert [row.name for row in rows] == ["7", "Car #8"]  # text, though one is a number
    assert [row.semantic_class for row in rows] == [10, None]
    assert rows[1].trajectory.points[1].position == (9, 5, 0)


@pytest.mark.parametrize(
    "text",
    [
        'name;box.0;box.1;box.2;at\nA;1;2;3;"[[1, 2]]"\n',
        'name\tbox\tat\nA\t"[1, 2, 3]"\t[[1, 2]]\n',
        '\n# Crates, in meters\nname,box,at.0.position\nA,"[1, 2, 3]","[1, 2]"\n\n',
    ],
)
def test_tables_may_be_written_in_several_ways(campaign, folder, text):
    (folder / "crates.csv").write_text(text)
    found = campaign({"scene.copies": {"sample": {"from": "crates.csv", "count": 1}}})
    crate = found.scenario(0).scene.copies[1]
    assert (crate.name, crate.box, crate.at[0].position) == ("A", (1, 2, 3), (1, 2))


@pytest.mark.parametrize("cell", ["[" * 100_000, "9" * 5_000])
def test_cells_that_are_no_values_are_text(campaign, folder, cell):
    (folder / "crates.csv").write_text(f'name,box,at\nA,{cell},"[[1, 2]]"\n')
    sample = {"from": "crates.csv", "count": 1}
    with pytest.raises(LidarError, match=r"crates\.csv, line 2: box must be .* but is") as raised:
        campaign({"scene.copies": {"sample": sample}}).check_files()
    assert len(str(raised.value)) < 3_000


def test_columns_of_a_table_are_fields_or_ignored(campaign, folder):
    (folder / "crates.csv").write_text('name,Wood,box,at,wood\nA,oak,"[1, 2, 3]","[[1, 2]]",5\n')
    sample = {"from": "crates.csv", "count": 1}
    with pytest.raises(
        LidarError, match=r"unknown columns Wood and wood\. Rename .* available columns are name, "
    ):
        campaign({"scene.copies": {"sample": sample}}).check_files()
    found = campaign({"scene.copies": {"sample": {**sample, "ignore": "wood"}}})
    assert found.scenario(0).scene.copies[1].box == (1, 2, 3)
    with pytest.raises(LidarError, match=r"ignore contains the unknown column 'steel'"):
        campaign({"scene.copies": {"sample": {**sample, "ignore": ["wood", "steel"]}}})


def test_a_value_that_is_not_set_is_none(campaign):
    found = campaign({KM: {"each": [None, 0.5]}, "steps": {"choice": [None, 3], "weights": [1, 0]}})
    assert [found.values(number) for number in range(2)] == [
        {KM: None, "steps": None}, {KM: 0.5, "steps": None},
    ]  # fmt: skip
    assert dict(found.choices) == {
        KM: "each of none, 0.5, in turn",
        "steps": "chosen from none (1), 3 (0), with these weights",
    }


def test_the_guide_names_the_sensors_whose_data_sheets_suffice_for_rain():
    """No other model can be used in rain without further values."""
    guide = Path(__file__).parents[2] / "docs" / "how-to" / "campaign.md"
    rain = guide.read_text(encoding="utf-8").partition("### Rain\n")[2].partition("Set it in")[0]
    found = set()
    for name in model_names():
        with suppress(LidarError):  # a value is missing
            sensor = load_sensor(name, performance="datasheet")
            Survey(sensor, poses=[(0, 0, 1)], rain_mm_h=10)
            found.add(name)
    assert set(re.findall(r"`([a-z]+/[\w-]+)`", rain)) == found


def test_names_may_be_given_to_values(campaign):
    found = campaign(
        {
            "scene": {"choice": {"in": "hall.glb", "out": {"files": ["yard.glb"]}}},
            "cloud.columns": {"each": [["time"], ["range", "time"]]},
            "weather.visibility_km": {"each": [None, 5.0]},
        },
        count=12,
    )
    files = {"in": "hall.glb", "out": "yard.glb"}
    for number in range(12):
        made = found.scenario(number)
        own = found.values(number)
        assert made.scene.files[0].file == files[own["scene"]]
        assert made.weather.visibility_km == own.get("weather.visibility_km")
    assert values(found, "cloud.columns")[:2] == ['["time"]', '["range", "time"]']
    assert values(found, "weather.visibility_km")[:4] == [None, None, 5, 5]


def test_a_grid_has_each_pair_of_values_once(campaign):
    found = campaign(
        {"steps": {"each": [1, 2, 3]}, "returns.subrays": {"each": [1, 7]}}, count=None
    )
    pairs = [tuple(found.values(number).values()) for number in range(found.count)]
    assert pairs == [(1, 1), (2, 1), (3, 1), (1, 7), (2, 7), (3, 7)]


def test_bases_are_taken_in_turn(campaign, folder):
    other = yaml.safe_load(BASE) | {"weather": {"visibility_km": 1}}
    (folder / "other").mkdir()
    (folder / "other" / "fog.yaml").write_text(yaml.safe_dump(other))
    (folder / "other" / "hall.glb").touch()
    found = campaign({"steps": {"each": [1, 2]}}, base=["base.yaml", "other/fog.yaml"], count=None)
    assert found.names == ("base", "steps")
    assert [tuple(found.values(number).values()) for number in range(found.count)] == [
        ("base.yaml", 1), ("fog.yaml", 1), ("base.yaml", 2), ("fog.yaml", 2),
    ]  # fmt: skip
    made = [found.scenario(number) for number in range(found.count)]
    assert [one.weather.visibility_km for one in made] == [None, 1, None, 1]
    # Files are beside the base that names them.
    assert [*made[1].files] == [folder / "other" / "hall.glb"]


def test_a_section_that_the_base_lacks_is_made(campaign, folder):
    (folder / "base.yaml").write_text("poses: [[0, 0, 1]]\n")
    found = campaign({
        "mount.position.2": {"choice": [3.5]},
        "scene.ground.height_m": {"choice": [-1]},
        "poses.0.yaw_deg": {"choice": [90]},
    })  # fmt: skip
    made = found.scenario(0)
    assert (made.mount.position, made.scene.ground.height_m) == ((0, 0, 3.5), -1)
    assert made.poses[0].yaw_deg == 90


def test_a_mesh_file_may_be_the_base(campaign):
    found = campaign({"scene.files.0.scale": {"uniform": [1, 2]}}, base="hall.glb")
    scales = [found.scenario(n).scene.files[0].scale for n in range(3)]
    assert [(value,) * 3 for value in values(found, "scene.files.0.scale")[:3]] == scales


def test_values_may_have_short_forms(campaign, folder):
    (folder / "base.yaml").write_text("actors: [{name: Van, box: [5, 2, 2], at: [9, 0, 0]}]\n")
    found = campaign({
        "sensor": {"each": ["velodyne/vlp16", "ouster/os1-64"]},
        "mount": {"choice": [[0, 0, 1.5]]},
        "actors.Van.at": {"choice": [[8, 1, 0]]},
    })  # fmt: skip
    made = found.scenario(1)
    assert values(found, "sensor")[:2] == ["velodyne/vlp16", "ouster/os1-64"]
    assert (made.sensor.model, made.mount.position) == ("ouster/os1-64", (0, 0, 1.5))
    assert made.actors[0].at.position == (8, 1, 0)


# --- noise, splits, what is kept ----------------------------------------------------------------


def test_each_job_has_its_own_noise(campaign, folder):
    def seeds(found):
        return [found.scenario(number).noise.seed for number in range(5)]

    own = seeds(campaign())
    assert len({*own}) == 5 and min(own) > 0
    assert seeds(campaign({"noise.range_m": {"uniform": [0, 1]}})) == own
    assert seeds(campaign({"noise.seed": {"choice": [0]}})) == [0] * 5
    (folder / "base.yaml").write_text(BASE + "noise: {seed: 0}\n")  # as lidarpool init writes it
    assert seeds(campaign()) == own
    (folder / "base.yaml").write_text(BASE + "noise: {seed: 5}\n")
    assert seeds(campaign()) == [5] * 5


def test_splits_have_their_shares_in_each_block(campaign):
    found = campaign(splits={"train": 0.8, "val": 0.1, "test": 0.1}, count=200)
    names = [found.split(number) for number in range(200)]
    for begin in range(0, 200, 10):
        assert Counter(names[begin : begin + 10]) == {"train": 8, "val": 1, "test": 1}
    assert len({*(names[begin : begin + 10].index("val") for begin in range(0, 200, 10))}) > 4
    more = campaign(splits={"train": 0.8, "val": 0.1, "test": 0.1}, count=2000)
    assert [more.split(number) for number in range(200)] == names
    odd = campaign(splits={"a": 0.3333333, "b": 0.6666667}, count=1000)
    assert Counter(odd.split(number) for number in range(1000))["a"] == 333
    assert campaign().split(0) == ""


def test_identity_is_that_of_the_content(campaign, folder):
    vary = {"scene.files.0.file": {"choice": ["hall.glb", "yard.glb"]}}
    vary |= {"actors": {"sample": {"from": "traffic.csv", "count": [0, 2]}}}
    first = campaign(vary).identity
    assert all(len(value) == 64 for value in first.values())
    (folder / "campaign.yaml").write_text(
        "# another remark\n" + (folder / "campaign.yaml").read_text()
    )
    assert Campaign.load(folder / "campaign.yaml").identity == first

    def changed(*given, **fields):
        return {k for k, v in campaign(*given, **fields).identity.items() if v != first[k]}

    assert changed(vary, license="CC0", title="T") == set()
    assert changed(vary, count=50) == set()
    assert changed(vary, seed=8) == {"seed"}
    assert changed(vary, splits={"a": 1}) == {"splits"}
    assert changed(vary, keep="parquet") == {"keep"}
    assert changed(vary | {"steps": {"integer": [1, 2]}}) == {"vary"}
    (folder / "yard.glb").write_bytes(b"another")  # which is of the jobs that read it
    assert changed(vary) == set()
    (folder / "yard.glb").write_bytes(b"yard.glb")
    (folder / "traffic.csv").write_text(TRAFFIC.replace("1.5", "1.6"))
    assert changed(vary) == {"tables"}
    (folder / "traffic.csv").write_text(TRAFFIC)
    (folder / "base.yaml").write_text(BASE + "pool: {gpu: 2}\n")
    assert changed(vary) == set()
    (folder / "base.yaml").write_text(BASE + "weather: {visibility_km: 2}\n")
    assert changed(vary) == {"base"}


# --- given scenarios, and functions -------------------------------------------------------------


def test_scenarios_as_they_are(folder):
    (folder / "a").mkdir()
    for name in ("a/base.yaml", "my hall.yaml"):
        (folder / name).write_text("noise: {range_m: 0.1}\n")
    paths = [folder / name for name in ("base.yaml", "a/base.yaml", "my hall.yaml", "hall.glb")]
    found = Campaign.from_scenarios(paths, keep="folder", splits={"a": 0.5, "b": 0.5})
    every = range(found.count)
    assert [found.name(number) for number in every] == ["base", "base-2", "my_hall", "hall"]
    assert {found.split(number) for number in every} == {"a", "b"}
    assert not any(map(found.values, every)) and found.names == ()
    assert [found.scenario(number).model_dump() for number in every] == [
        Scenario.load(path).model_dump() for path in paths
    ]
    before = file_hashes(found.scenario(3).files)
    assert [name for name, _ in before] == ["hall.glb"]
    (folder / "hall.glb").write_bytes(b"another")
    assert file_hashes(found.scenario(3).files) != before


def job(*drawn, **options):
    survey = Survey(poses=[(0, 0, 1)], **options)
    return Job(Scene.seed(), survey, values={"drawn": int(*drawn)} if drawn else {})


def test_a_function_makes_jobs():
    def make(number, rng):
        noise = Noise(range_m=rng.uniform(0.01, 0.02))
        made = job(noise=noise)
        values = {"number": np.int64(number), "sigma": noise.range_m, "fog": None}
        return Job(made.scene, made.survey, values=values)

    found = Campaign(make, count=20, seed=3, keep="kitti", splits={"a": 1})
    assert (found.names, dict(found.choices)) == (("number", "sigma", "fog"), {})
    jobs = [found.job(number) for number in (0, 7, 7)]
    assert [made.values["number"] for made in jobs] == [0, 7, 7]
    assert type(jobs[1].values["number"]) is int and jobs[1].values["fog"] is None
    assert jobs[1].values == jobs[2].values != jobs[0].values
    assert (jobs[1].number, jobs[1].name, jobs[1].split) == (7, "0007", "a")
    assert found.scenario(7) is None and found.values(7) == jobs[1].values
    seeds = [made.survey.noise.seed for made in jobs]
    assert 0 != seeds[0] != seeds[1] == seeds[2]
    other = Campaign(lambda number, rng: make(number + 1, rng), count=20, seed=3)
    assert other.identity["make"] != found.identity["make"]


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (
            lambda number, rng: 5,
            "job 1: the function must return a Job(scene, survey), but returned 5",
        ),
        (lambda number, rng: 1 / 0, "job 1: the function raised ZeroDivisionError: division"),
        (
            lambda number, rng: job(keep_every=0),
            "job 1: keep_every must be a whole number from 1 to 1000000, but is 0",
        ),
        (
            lambda number, rng: job(*[3] * number),
            "Job 1 has a value 'drawn', which the first job does not have",
        ),
        (
            lambda number, rng: Job(job().scene, job().survey, values={"a": [1]}),
            "but job 1 has {'a': [1]}",
        ),
    ],
    ids=["no job", "raises", "refused", "other names", "a list"],
)
def test_a_function_that_makes_no_job(make, says):
    with pytest.raises(LidarError) as raised:
        Campaign(make, count=3).job(1)
    assert says in str(raised.value)


# --- errors -------------------------------------------------------------------------------------

KM = "weather.visibility_km"
WRONG = {
    "no section": ({"wether.visibility_km": {"uniform": [1, 2]}}, "Did you mean 'weather'?"),
    "no field": ({"weather.visibility": {"uniform": [1, 2]}}, "Did you mean 'visibility_km'?"),
    "other unit": ({"weather.visibility_m": {"choice": [60]}}, "Its unit is km, not m."),
    "no name": ({"sensors.rof.model": {"choice": ["a"]}}, "Did you mean 'roof'?"),
    "short form": (
        {"sensors.front.left.mount.0": {"uniform": [1, 2]}},
        "Did you mean 'sensors.front.left.mount.position.0'?",
    ),
    "no list": ({"poses.0.yaw_deg": {"uniform": [1, 2]}}, "the base has no poses"),
    "low": ({KM: {"uniform": [0, 2]}}, f"{KM} can be 0.0, but must be from 0.001 to"),
    "tail": (
        {"noise.range_m": {"normal": {"mean": 1, "std": 1}}},
        "can be -5.0, but must be from 0 to",
    ),
    "limits": ({"noise.range_m": {"normal": {"mean": 1, "std": 1}}}, "Set `limits`."),
    "far": ({KM: {"normal": {"mean": 1, "std": 1, "limits": [9, 10]}}}, "at least 1% of the"),
    "not whole": ({"steps": {"uniform": [1, 9]}}, "steps can be 1.0, but must be a whole"),
    "type": ({"noise.range_m": {"choice": [0, "a"]}}, "noise.range_m can be 'a', but must be"),
    "model": (
        {"sensors.roof.model": {"choice": ["velodyne/vlp15"]}},
        "Did you mean 'velodyne/vlp16",
    ),
    "together": (
        {"sensors.roof.layers": {"integer": [8, 9]}},
        "`model` and `layers` cannot be combined",
    ),
    "file": (
        {"scene.files.0.file": {"choice": ["hall.glb", "hut.glb"]}},
        "hut.glb does not exist",
    ),
    "descending": (
        {KM: {"uniform": [2, 1]}},
        f"vary.{KM}.uniform must be [least, largest], but is [2, 1",
    ),
    "two kinds": (
        {KM: {"uniform": [1, 2], "choice": [1]}},
        "Set exactly one of uniform, log_uniform",
    ),
    "a value": ({KM: 3}, "must be a mapping that defines the choice"),
    "misspelt": ({KM: {"unifrom": [1, 2]}}, "Did you mean 'uniform'?"),
    "weights": ({KM: {"choice": [1, 2], "weights": [1]}}, "must have one weight for each value"),
    "twice": (
        {"actors.0.box.0": {"uniform": [1, 2]}, "actors.Van.box.0": {"uniform": [1, 2]}},
        "actors.0.box.0 and actors.Van.box.0 refer to the same field",
    ),
    "other section": ({"performance": {"choice": ["ideal"]}}, "mean 'sensors.roof.performance'?"),
    "of a list": ({"up_axis": {"choice": ["z"]}}, "Did you mean 'scene.files.0.up_axis'?"),
    "of a section": ({"visibility_km": {"choice": [5]}}, "mean 'weather.visibility_km'?"),
    "of a mapping": ({"rate_hz": {"choice": [5]}}, "mean 'sensors.roof.rate_hz'?"),
    "within": (
        {"scene": {"choice": ["hall.glb"]}, "scene.files.0.file": {"choice": ["hall.glb"]}},
        "cannot be combined, because scene replaces",
    ),
    "no table": ({"actors": {"sample": {"from": "no.csv", "count": 1}}}, "no.csv does not exist"),
    "few rows": ({"actors": {"sample": {"from": "traffic.csv", "count": 3}}}, "has only 2 rows"),
    "rows of no list": (
        {"steps": {"sample": {"from": "traffic.csv", "count": 1}}},
        "but this field is not a list",
    ),
    "other rows": (
        {"scene.copies": {"sample": {"from": "traffic.csv", "count": 1}}},
        "traffic.csv cannot be used as a table: it contains the unknown columns trajectory",
    ),
}


def test_a_missing_file_of_a_table_is_named_with_its_line(campaign, folder):
    (folder / "cars.csv").write_text(
        "# van.obj\nname,file,trajectory\nCar,hall.glb,\nVan,van.obj,\n"
    )
    vary = {"actors": {"sample": {"from": "cars.csv", "count": 1}}}
    with pytest.raises(LidarError) as raised:
        campaign(vary).check_files()
    where = f"actors: {folder / 'cars.csv'}, line 4: {folder / 'van.obj'} does not exist"
    assert where in str(raised.value)


@pytest.mark.parametrize(
    ("base", "hint"),
    [
        ("sensor: {layers: 8}\n", "'mount.position.2'"),
        ("sensors: {roof: {layers: 8}}\n", "'sensors.roof.mount.position.2'"),
    ],
    ids=["one sensor", "several"],
)
def test_the_whole_path_of_a_mount_is_suggested(tmp_path, base, hint):
    (tmp_path / "base.yaml").write_text(f"scene: seed\nposes: [[0, 0, 2]]\n{base}")
    vary = {"sensor.mount.position.2": {"uniform": [1, 2]}}
    (tmp_path / "c.yaml").write_text(
        yaml.safe_dump({"base": "base.yaml", "count": 2, "vary": vary})
    )
    with pytest.raises(LidarError) as raised:
        Campaign.load(tmp_path / "c.yaml").check_files()
    assert f"'mount' is not a field of sensor. Did you mean {hint}?" in str(raised.value)


@pytest.mark.parametrize("name", WRONG)
def test_it_is_told_what_is_wrong(campaign, name):
    vary, says = WRONG[name]
    with pytest.raises(LidarError) as raised:
        campaign(vary).check_files()
    told = str(raised.value)
    assert says in told
    assert "campaign.yaml: " in told
    assert "vary" in told
    assert len(told.splitlines()) <= 2 or name == "other rows"


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"base": None}, "base is required"),
        ({"base": "bse.yaml"}, "bse.yaml does not exist"),
        ({"base": "campaign.yaml"}, "base must be a scenario, but 'campaign.yaml' is a campaign"),
        ({"cont": 5}, "Did you mean 'count'?"),
        ({"keep": "kiti"}, "Did you mean 'kitti'?"),
        ({"splits": {"train": 0.8, "val": 0.1}}, "must add up to 1, but add up to 0.9"),
        ({"splits": {"a/b": 1}}, "a-z, A-Z, 0-9, - and _, but is 'a/b'"),
    ],
)
def test_fields_that_cannot_be_meant(campaign, fields, says):
    with pytest.raises(LidarError) as raised:
        campaign(**fields)
    assert says in str(raised.value) and "campaign.yaml" in str(raised.value)
    assert len(str(raised.value).splitlines()) == 1


def test_a_count_is_needed_where_something_is_drawn(campaign):
    with pytest.raises(LidarError, match=r"count is required, because values of steps are drawn"):
        campaign({"steps": {"integer": [1, 2]}}, count=None)
    assert campaign(count=None).count == 1


def test_values_that_do_not_fit_together_are_told_with_the_job(campaign):
    found = campaign({"returns.subrays": {"integer": [1, 7]}})  # of which only the ends are
    wrong = next(n for n in range(40) if 1 < JobRandom(7, n, "returns.subrays").integer(1, 7) < 7)
    with pytest.raises(LidarError) as raised:
        found.job(wrong)
    assert f"campaign.yaml: job {wrong}: returns.subrays must be " in str(raised.value)
    assert "\nThe values of the job are returns.subrays: " in str(raised.value)


def test_files_of_every_row_are_looked_for(campaign, folder):
    rows = "".join(f"Car {i},1 1 1,{i}.csv\n" for i in range(5)).replace("1 1 1", '"[1, 1, 1]"')
    (folder / "cars.csv").write_text("name,box,trajectory.file\n" + rows)
    vary = {"actors": {"sample": {"from": "cars.csv", "count": [0, 2]}}}
    for i in range(4):
        (folder / f"{i}.csv").touch()
    with pytest.raises(LidarError, match=r"line 6: .*4\.csv does not exist"):
        campaign(vary).check_files()
    (folder / "4.csv").touch()
    campaign(vary).check_files()


def test_of_several_bases_the_wrong_one_is_named(campaign, folder):
    (folder / "fog.yaml").write_text("steps: 3\n")
    with pytest.raises(LidarError) as raised:
        campaign(
            {"sensors.roof.model": {"choice": ["velodyne/vlp16"]}}, base=["base.yaml", "fog.yaml"]
        )
    assert "campaign.yaml: vary for fog.yaml: sensors of the base has no entry 'roof'" in str(
        raised.value
    )
    with pytest.raises(LidarError, match=r"vary for fog\.yaml: steps can be 0, but must"):
        campaign({"steps": {"choice": [0]}}, base=["base.yaml", "fog.yaml"])


@pytest.mark.extended
def test_a_grid_that_is_too_large(campaign):
    many = {"each": list(range(1, 1001))}
    vary = {"steps": many, "cloud.keep_every": many, "noise.seed": many}
    with pytest.raises(LidarError, match=r"grid of all values would have 1,000,000,000 jobs"):
        campaign(vary, count=None)
    assert campaign(vary, count=5).count == 5


def test_given_files_that_cannot_be_used(folder):
    (folder / "wrong.yaml").write_text("stepps: 3\n")
    (folder / "campaign.yaml").write_text("base: base.yaml\n")
    names = ("none.yaml", "wrong.yaml", "none.glb", "campaign.yaml", "base.yaml")
    with pytest.raises(LidarError) as raised:
        Campaign.from_scenarios([folder / name for name in names])
    lines = str(raised.value).splitlines()
    says = (
        "none.yaml does not exist",
        "Did you mean 'steps'?",
        "is a campaign",
    )
    assert len(lines) == 3 and all(map(str.__contains__, lines, says))
    with pytest.raises(LidarError, match=r"none\.glb does not exist"):
        Campaign.from_scenarios([folder / "none.glb", folder / "base.yaml"]).check_files()


def test_which_files_are_campaigns(folder):
    texts = {
        "a.yaml": ("base: x.yaml\n", True),
        "b.yml": ("# remark\ncount: 3\n'base': x.yaml\n", True),
        "c.yaml": ("{base: x.yaml, count: 4}", True),
        "d.yaml": ("vary: {}\n", True),
        "e.yaml": (BASE, False),
        "f.yaml": ("scene:\n  base: 3\n", False),
        "g.txt": ("base: x.yaml\n", False),
        "h.yaml": ("base: [\n", False),
    }
    for name, (text, is_one) in texts.items():
        (folder / name).write_text(text)
        assert is_campaign(folder / name) is is_one, name
    assert not is_campaign(folder / "none.yaml")
    assert not is_campaign(folder)


def test_a_campaign_goes_to_another_process(campaign):
    vary = {"actors": {"sample": {"from": "traffic.csv", "count": [0, 2]}}}
    sent = pickle.loads(pickle.dumps(campaign(vary)))
    assert sent.scenario(3).actors == campaign(vary).scenario(3).actors


def test_a_job_computes_its_sweeps_once():
    job = Job(Scene.seed(), Survey(poses=[(0, 0, 1), (0, 0, 2)]))
    assert job.sweeps is job.sweeps
    assert len(job.sweeps) == 2
    assert job.sweeps.scans[-1] == job.survey.scan_count
