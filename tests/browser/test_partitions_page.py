"""The page of partitions in a browser: each task has a lane to itself, however many there are."""

import json
import random
from importlib.resources import files

import pytest

pytestmark = [pytest.mark.browser, pytest.mark.slow]

PAGE = files("poolpart").joinpath("page.html")
START = 1_700_000_000.0
EVERY_S = 0.5  # from one snapshot to the next
BEAT_S = 1.3  # from one heartbeat to the next: what the scheduler knows is older than that

# Tasks of one lane that overlap by more than clocks may be wrong, and lanes that are too many.
FAULTS = """(() => {
  const byLane = new Map(), slots = new Map(data.workers.map(w => [w.name, w.slots]));
  const faults = { overlaps: 0, beyond: 0, tasks: 0 };
  for (const item of [...tasks, ...running]) {
    faults.tasks++;
    if (item.lane >= slots.get(item[0])) faults.beyond++;
    const key = item[0] + "/" + item.lane;
    byLane.set(key, [...(byLane.get(key) || []), item]);
  }
  for (const lane of byLane.values()) {
    lane.sort((a, b) => a[2] - b[2]);
    for (let i = 1; i < lane.length; i++)
      if (Math.min(lane[i][3], lane[i - 1][3]) - lane[i][2] > 0.03) faults.overlaps++;
  }
  return faults;
})()"""


class Cluster:
    """A cluster that is made up: its workers, and what they have done and do at any time."""

    def __init__(self, workers, seconds, longest_s, seed=0):
        self.workers = workers  # {name: (partition, slots)}
        rng = random.Random(seed)
        self.tasks = []  # [worker, stage, start, stop, failed]
        for name, (_, slots) in workers.items():
            for _ in range(slots):
                at = START + rng.uniform(0, longest_s)
                while at < START + seconds:
                    # Short ones most of the time, and some that last.
                    stop = at + longest_s * rng.random() ** 4 + 0.01
                    self.tasks.append([name, f"stage-{rng.randrange(4)}", at, stop, 0])
                    at = stop + rng.choice([0.0, rng.uniform(0, longest_s)])
        self.tasks.sort(key=lambda task: task[3])

    def snapshot(self, at, since):
        """What the scheduler would tell at a time, and how many have ended by then."""
        ended = sum(task[3] <= at for task in self.tasks)
        beat = at - at % BEAT_S
        running = {name: [] for name in self.workers}
        for number, (name, stage, start, stop, _) in enumerate(self.tasks):
            if start <= beat and stop > at:
                running[name].append([f"task-{number}", stage, start + 0.004])
        none = {"waiting": 0, "queued": 0, "running": 0, "done": 0, "failed": 0, "recomputed": 0}
        stages = {f"stage-{n}": {**none, "seconds": 0.0} for n in range(4)}
        partitions = sorted({partition for partition, _ in self.workers.values()})
        return {
            "time": at,
            "ran": ended,
            "tasks": self.tasks[since:ended][-4000:],
            "partitions": [
                {"name": name, "busy": 0, "slots": 1, "exclusive": False, "stages": stages}
                for name in partitions
            ],
            "workers": [
                {
                    "name": name,
                    "address": "tcp://127.0.0.1:1",
                    "partition": partition,
                    "threads": slots,
                    "slots": slots,
                    "busy": len(running[name]),
                    "status": "running",
                    "given": 0,
                    "seen": at - at % BEAT_S,
                    "executing": running[name],
                }
                for name, (partition, slots) in self.workers.items()
            ],
            "pipes": [],
            "totals": {},
            "kept_out": 0,
        }


@pytest.fixture
def page(new_tab, tmp_path):
    """Return a function that shows a made-up cluster, second by second, in a tab."""
    (tmp_path / "page.html").write_text(PAGE.read_text(encoding="utf-8"), encoding="utf-8")
    tab = new_tab((tmp_path / "page.html").as_uri())
    tab.wait_for(lambda text: "Partitions" in text)
    tab.value("look = async () => {}")  # there is no scheduler to ask

    def show(cluster, seconds, begin=0.0):
        since, at = 0, START + begin
        while at <= START + seconds:
            told = cluster.snapshot(at, since)
            tab.value(f"take({json.dumps(told)})")
            since = told["ran"]
            at += EVERY_S
        return tab

    return show


@pytest.mark.parametrize("begin", [0.0, 29.0])  # whoever comes late is told all at once
def test_each_task_has_a_lane_to_itself(page, begin):
    workers = {"one": ("A", 1), "four": ("B", 4), "sixteen": ("C", 16)}
    tab = page(Cluster(workers, 30, 3.0), 30, begin)
    faults = tab.value(FAULTS)
    assert faults.pop("tasks") > 300
    assert faults == {"overlaps": 0, "beyond": 0}


def test_two_hundred_workers_stay_on_the_page_and_cheap(page):
    workers = {
        f"{partition}-{number}": (partition, slots)
        for partition, slots, count in (("GPU", 1, 60), ("LIDAR", 4, 60), ("OTHER", 16, 80))
        for number in range(count)
    }
    tab = page(Cluster(workers, 12, 20.0), 12)
    faults = tab.value(FAULTS)
    assert faults.pop("tasks") > 1200
    assert faults == {"overlaps": 0, "beyond": 0}
    assert tab.value("document.getElementById('plot').clientHeight") < 1000
    drawn = tab.value("boxes.length")
    assert drawn > 1000
    rows = tab.value("new Set(boxes.map(([, , top]) => Math.round(top))).size")
    assert rows > 200  # lanes lie beside each other, also where they are thin
