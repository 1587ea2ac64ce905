"""Drivers of `lidarpool run` that are killed, one after the other, at chosen moments."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

# Each driver is a process of its own, forked from one that has imported everything. It is killed
# when it passes a point for the n-th time; a point in capitals stands for a call.
DRIVERS = """
import json, os, signal, sys, traceback
import lidarpool.cli.run_command, lidarpool.run.pipeline.policies
import lidarpool.report.campaign_output as campaign_output
import lidarpool.report.result_pictures as pictures
from lidarpool.__main__ import main
from lidarsim.io.storage import Storage
from lidarpool.processes.tracing import trace_to
from lidarfiles.datasets.dataset import DataSet
from lidarpool.report.growing_cloud import CloudWriter
from lidarpool.run.store.database import RunDatabase
from lidarpool.run.store.run_store import RunStore

CALLS = {
    "OPEN": (RunDatabase, "__init__"),
    "COMMIT": (RunDatabase, "commit"),
    "END": (RunStore, "commit_jobs"),
    "TABLE": (campaign_output, "write_table"),
    "FINISH": (DataSet, "finish"),
    "GROW": (CloudWriter, "append"),
    "SAVE": (CloudWriter, "finish"),
    "PUT": (Storage, "put"),
    "COPY": (Storage, "copy_from"),
    "REMOVE": (RunStore, "remove"),
}

pictures.take_shot = lambda *_, **__: None
class BlankPage:
    def __init__(self, *_, **__): pass
    def save(self, path): path.write_bytes(b"x")
    def html(self): return "<svg></svg>"
pictures.draw_scene = pictures.draw_hits = BlankPage
pictures.draw_cloud = pictures.draw_path = BlankPage
lidarpool.run.pipeline.policies.scans_per_batch = lambda *_: 10

def drive(point, times):
    left = [times]
    def strike(passed, fields=None):
        left[0] -= passed == point
        if not left[0]:
            os.kill(os.getpid(), signal.SIGKILL)
    def before(owner, name, label):
        function = getattr(owner, name)
        def call(*arguments, **options):
            if arguments[1:] != ([],):  # something
                strike(label)
            return function(*arguments, **options)
        setattr(owner, name, call)
    trace_to(strike)
    for label, (owner, name) in CALLS.items():
        before(owner, name, label)
    sys.argv = ["lidarpool", "run", *json.loads(sys.argv[1])]
    main()

for point, times in json.loads(sys.argv[2]):
    if not (child := os.fork()):
        try:
            drive(point, times)
        except SystemExit as ended:
            sys.stderr.flush()
            sys.stdout.flush()
            os._exit(ended.code or 0)
        except BaseException:
            traceback.print_exc()
        os._exit(70)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    print(json.dumps(["ended", code]), flush=True)
    if code >= 0:
        break
"""


def drive(
    folder: Path, kills: list[tuple[str, int]], *arguments: str, prelude: str = ""
) -> list[int]:
    """Run in a folder again and again, each killed at a point; returns how they ended.

    A point that nobody passes lets one end by itself. `prelude` is Python that comes first.
    """
    done = subprocess.run(
        [sys.executable, "-c", prelude + DRIVERS, json.dumps(arguments), json.dumps(kills)],
        cwd=folder, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert "Traceback" not in done.stderr and "lidarpool:" not in done.stderr, done.stderr
    return [json.loads(line)[1] for line in done.stdout.splitlines() if '"ended"' in line]
