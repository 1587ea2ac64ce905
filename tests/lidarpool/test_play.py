"""The command `play`: sources and schedule, through a bridge that keeps what it is sent."""

from __future__ import annotations

import threading
import time
from functools import partial
from itertools import count

import numpy as np
import pytest
from click.testing import CliRunner

from lidarfiles.clouds.writing import ExportSpec
from lidarlive.playback import bridge as bridges
from lidarlive.playback.bridge import Bridge
from lidarlive.playback.bridge_table import BRIDGES, BridgeEntry
from lidarlive.playback.schedule import Prefetcher
from lidarlive.playback.sources import open_source
from lidarpool.cli.commands import cli
from lidarsim import LidarError

SCENARIO = """
sensor: {model: velodyne/vlp16, rate_hz: 20}
scene: {preset: seed}
poses: [[0, 0, 1]]
steps: 108
"""


class Kept(Bridge):
    """Keeps the sweeps that it is sent, and when."""

    format = ExportSpec("pcap")
    sent: list = []  # noqa: RUF012 - the test reads it

    description = "nowhere"

    def send(self, sweep, points, shift_ns):
        late_ns = time.monotonic_ns() - self.schedule.deadline_ns(self.due_ns(sweep) + shift_ns)
        self.sent.append((sweep, points, shift_ns, late_ns))
        if len(self.sent) == 5:
            raise KeyboardInterrupt

    summary = "kept"

    def __exit__(self, *error):
        self.sent.append("closed")


@pytest.fixture
def kept(monkeypatch):
    monkeypatch.setitem(BRIDGES, "kept", BridgeEntry(f"{__name__}:Kept"))
    monkeypatch.setattr(Kept, "sent", [])
    return Kept.sent


def play(*arguments):
    return CliRunner().invoke(cli, ["play", *map(str, arguments)])


def test_sweeps_of_a_scenario_and_its_result_leave_at_their_times(kept, tmp_path):
    scenario = tmp_path / "s.yaml"
    scenario.write_text(f"{SCENARIO}output: {{write: [pcap]}}\n")
    outcome = play(scenario, "--as", "kept", "--rate", 2)
    assert outcome.exit_code == 0, outcome.output
    assert outcome.stdout == "ready: nowhere. Press Ctrl-C to stop.\nkept\n"
    *cast, closed = kept
    assert closed == "closed"
    assert [sweep for sweep, *_ in cast] == [0, 1, 2]
    assert all(0 <= late_ns < 0.5e9 for *_, late_ns in cast)
    assert all("reflectivity" in points.columns for _, points, *_ in cast)


def test_a_loop_goes_on_in_time_until_ctrl_c(kept, tmp_path):
    (tmp_path / "s.yaml").write_text(SCENARIO)
    outcome = play(tmp_path / "s.yaml", "--as", "kept", "--loop", "--rate", 4)
    assert outcome.exit_code == 1  # click's word for an interrupt
    *sent, closed = kept
    assert closed == "closed"
    assert [sweep for sweep, *_ in sent] == [0, 1, 2, 0, 1]
    shifts_ns = [shift_ns for _, _, shift_ns, _ in sent]
    assert shifts_ns[:3] == [0, 0, 0]
    assert shifts_ns[3:] == pytest.approx([150e6, 150e6], rel=1e-3)


@pytest.mark.extended
def test_a_result_gives_the_points_of_its_scenario(cluster, tmp_path):
    scenario = tmp_path / "s.yaml"
    scenario.write_text(f"{SCENARIO}output: {{write: [pcap]}}\n")
    options = ["--out", str(tmp_path / "out"), "--cloud-only"]
    outcome = CliRunner().invoke(cli, ["run", str(scenario), *options, "--scheduler", cluster])
    assert outcome.exit_code == 0, outcome.output
    with open_source(tmp_path / "out") as recorded, open_source(scenario, Kept.format) as cast:
        for (sweep, points), (same_sweep, same_points) in zip(recorded, cast, strict=True):
            assert sweep == same_sweep
            assert np.allclose(points.positions, same_points.positions, atol=1e-5)
            assert np.array_equal(points["ray"], same_points["ray"])


def test_what_cannot_be_played_is_refused_in_a_line(tmp_path):
    (tmp_path / "a.pcap").write_bytes(b"")
    needs_packets = pytest.raises(
        LidarError, match=r"contains packets\. Play it with `--as packets`"
    )
    with needs_packets, open_source(tmp_path / "a.pcap"):
        pass
    lacks_cloud = pytest.raises(LidarError, match=r"contains no cloud\.ply")
    with lacks_cloud, open_source(tmp_path):
        pass
    with pytest.raises(LidarError, match=r"not a bridge\. Did you mean 'foxglove'\? Use packets"):
        bridges.bridge_class("foxglov")


def test_an_error_of_what_is_made_ahead_comes_at_its_place():
    def refuse():
        raise LidarError("no more")

    with Prefetcher([lambda: 1, refuse, lambda: 2], 4) as prefetcher:
        ahead = iter(prefetcher)
        assert next(ahead) == 1
        with pytest.raises(LidarError, match="no more"):
            next(ahead)


def test_what_several_threads_make_ahead_comes_in_order():
    both_run = threading.Barrier(2)

    def make(number):
        if number < 2:
            both_run.wait(10)  # the first two at the same time
        time.sleep(0.02 * (number % 2 == 0))  # later tasks end earlier
        return number

    tasks = (partial(make, number) for number in range(10))
    with Prefetcher(tasks, 4, threads=2) as prefetcher:
        assert list(prefetcher) == list(range(10))


def test_what_is_made_ahead_is_bounded_and_dropped_at_the_end():
    started = []
    with Prefetcher((partial(started.append, k) for k in count()), 3, threads=2) as prefetcher:
        ahead = iter(prefetcher)
        for _ in range(5):
            next(ahead)
    assert 5 <= len(started) <= 5 + 3
