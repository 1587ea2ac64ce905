"""A driver that is killed before any one file operation while its result goes into place."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from lidarfiles.clouds.folder import result_folder
from lidarpool.report.result_files import FILES

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="forks")

NEW = sorted({*FILES} - {"path.png"})  # the earlier run planned a path, this one does not

# Forks a process for each k; its k-th file operation in the folder never happens.
SCRIPT = """
import json, os, signal, sys
from pathlib import Path
from lidarpool.report.result_files import REPORT, obsolete_files
from lidarfiles.work.publishing import move_into_place

root, files, earlier = Path(sys.argv[1]), json.loads(sys.argv[2]), json.loads(sys.argv[3])

def publish(out, k):
    whole, left = out / ".lidarpool-writing-01234567", [k]
    whole.mkdir(parents=True)
    for name in earlier:
        (out / name).write_text("earlier")
    for name in files:
        (whole / name).write_text("new")
    def count(event, arguments):
        if (event == "open" or event.startswith("os.")) and str(arguments[0]).startswith(str(out)):
            left[0] -= 1
            if not left[0]:
                os.kill(os.getpid(), signal.SIGKILL)
    sys.addaudithook(count)
    move_into_place(whole, out, last=REPORT, remove=obsolete_files(files, []))

killed = k = 1
while killed:
    if not (child := os.fork()):
        publish(root / str(k), k)
        os._exit(0)
    killed = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    k += 1
"""


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Folders as each of the killed left them; the last was left to do its work."""
    root = tmp_path_factory.mktemp("killed")
    subprocess.run(
        [sys.executable, "-W", "ignore", "-c", SCRIPT, root, json.dumps(NEW), json.dumps(FILES)],
        check=True,
    )
    folders = sorted(root.iterdir(), key=lambda folder: int(folder.name))
    assert len(folders) > len(NEW)
    return folders


def whose(out: Path) -> set[str]:
    """Which runs the files that are to be seen are of."""
    files = [path for path in out.iterdir() if not path.name.startswith(".")]
    return {"earlier" if path.read_text() == "earlier" else "new" for path in files}


def test_what_looks_finished_is_one_result(killed):
    seen = set()
    for out in killed:
        names = {path.name for path in out.iterdir() if not path.name.startswith(".")}
        if "report.json" in names:
            (run,) = whose(out)
            assert names == {*(NEW if run == "new" else FILES)}, out
            seen.add(run)
        else:
            seen.add("none")
        if "report.html" in names and (out / "report.html").read_text() == "new":
            assert names == {*NEW} - ({"report.json"} - names), out
    assert seen == {"earlier", "none", "new"}


def test_the_next_run_clears_up(killed):
    for out in killed:
        theirs = [out / ".writing-01234567", out / ".lidarpool-writing-notes"]
        for folder in theirs:
            folder.mkdir()
        link = out / ".lidarpool-writing-89abcdef"
        link.symlink_to(theirs[0])
        with result_folder(out):
            assert sorted(out.glob(".*")) == sorted([*theirs, link])
