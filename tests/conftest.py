"""What all tests start from."""

import gc
import json
import logging
import os
import signal
import sys
import types
from collections import Counter
from collections.abc import Generator, Iterator
from fnmatch import fnmatchcase
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

# With Python's threshold, collections of garbage take a tenth of the time of all imports.
gc.set_threshold(50_000)

# A shell starts jobs in the background with interrupts ignored, and whatever they start inherits
# that: programs that tests interrupt would not notice.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# A test that hangs fails after this many seconds, and the others are run. As an option of
# pyproject.toml the limit would stop `--strict-config` where pytest-timeout is not installed.
os.environ.setdefault("PYTEST_TIMEOUT", "900")

# What tests start imports what they do.
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))

# Threads of OpenBLAS wait for the next product of matrices by turning in a loop, which takes ten
# times the product from the other processes of `make test`. Read when NumPy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Tests keep dozens of Dask processes, most of them idle; each watches itself for 4 % of a core.
# And a worker that is forked costs a tenth of one that imports Dask anew. Set before Dask is
# imported, here and in every process that is started from here.
os.environ |= {
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "1s",
    "DASK_DISTRIBUTED__ADMIN__SYSTEM_MONITOR__INTERVAL": "5s",
    "DASK_DISTRIBUTED__WORKER__MULTIPROCESSING_METHOD": "forkserver",
}

# Packages that the tests in a folder need, if not Dask: machines with a GPU often have few packages
# and no network, and each distribution is tested with its own requirements only.
_RECORDED = ("matplotlib", "open3d", "scipy", "trimesh")
_NEEDED = {
    "raybeam": ("numpy",),
    "lidarsim": ("pydantic", "trimesh"),
    "lidarfiles": ("cloudpickle", "fsspec", "trimesh"),
    "lidarscenes": _RECORDED,
    "lidarview": _RECORDED,
    "lidarscenario": _RECORDED,
    "lidarreal": _RECORDED,
}


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Leave out tests of packages whose requirements are not installed."""
    parts = collection_path.relative_to(Path(__file__).parent).parts
    if not parts:
        return None
    needed = _NEEDED.get(parts[0], ("distributed",))
    return None if all(map(find_spec, needed)) else True


# Dask's own clusters look this long after each death whether the worker is there, and give it up
# when it is not: also one that has come back since and was killed again by the same test.
try:
    import dask
except ImportError:  # the kernels can be tested without it
    pass
else:
    dask.config.set({"distributed.deploy.lost-worker-timeout": "1h"})

# An example may take as long as a busy machine needs. The examples are the same in each run, or
# what is checked after a change would fail by chance; `HYPOTHESIS_PROFILE=default` varies them.
try:
    from hypothesis import HealthCheck, settings
except ImportError:
    pass
else:
    slow = [HealthCheck.too_slow]
    settings.register_profile(
        "patient", deadline=None, suppress_health_check=slow, derandomize=True
    )
    settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "patient"))


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> Generator[None, None, None]:
    """Choose tests by their marks, and put the files that take longest first.

    Processes share the files in this order, so that none is left with a long one in the end.
    """
    _leave_out_rows(items)
    yield  # pytest leaves out what `-m` does not ask for
    durations = json.loads((Path(__file__).parent / "durations.json").read_text())
    seconds: Counter[Path] = Counter()
    for item in items:
        tests = durations.get(item.nodeid.partition("::")[0], {})
        seconds[item.path] += tests.get(getattr(item, "originalname", item.name), 0.02)
    items.sort(key=lambda item: -seconds[item.path])


def _leave_out_rows(items: list[pytest.Item]) -> None:
    """Take the marks `extended` and `slow` from the rows that the marks say to keep.

    `keep` has the ids of rows, with wildcards; `every=n` keeps the first of each n rows. If values
    of several parameters are multiplied, no number of values should have a factor of `n`.
    """
    counts: Counter[tuple[str, str]] = Counter()
    for item in items:
        test, _, row = item.nodeid.partition("[")
        for mark in [mark for mark in item.own_markers if mark.name in ("extended", "slow")]:
            kept = any(fnmatchcase(row[:-1], pattern) for pattern in mark.kwargs.get("keep", ()))
            if every := mark.kwargs.get("every"):
                kept |= counts[test, mark.name] % every == 0
                counts[test, mark.name] += 1
            if kept:
                item.own_markers.remove(mark)


def pytest_collection_finish() -> None:
    """Exclude modules and tests, which last as long as the process, from collections of garbage."""
    gc.freeze()


_HANDLERS = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}


@pytest.fixture(scope="session", autouse=True)
def _fork_server() -> Iterator[None]:
    """Start the fork server as the product does, before a cluster of Dask's own starts another.

    A command in this process does not end it: workers of the session's clusters would end with it.
    """
    try:
        from lidarpool.processes import fork_server
    except ImportError:
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fork_server, "stop_fork_server", lambda: None)
        fork_server.start_fork_server()
        yield


@pytest.fixture(scope="session", autouse=True)
def _outside_the_checkout(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Run fixtures of modules in a folder of their own, too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("fixtures"))
        yield


@pytest.fixture(autouse=True)
def _as_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Run a test in a folder of its own, and undo what a command in this process did.

    The checkout may hold results of `make demo`, and files of the same names as a test's. Without
    -v, a command silences all libraries, and a second interrupt ends the process at once: that of a
    later test.
    """
    monkeypatch.chdir(tmp_path)
    yield
    logging.disable(logging.NOTSET)
    for number, handler in _HANDLERS.items():
        if signal.getsignal(number) is not handler:
            signal.signal(number, handler)


@pytest.fixture(scope="session")
def cluster() -> Iterator[str]:
    """Address of a cluster whose workers are threads of this process, with the slots of one run."""
    from tests.clusters import thread_cluster  # the kernels can be tested without Dask

    with thread_cluster({"GPU": 1}, {"LIDAR": 4}, {"OTHER": 1}) as cluster:
        yield cluster.scheduler_address


@pytest.fixture(scope="session")
def cluster_client(cluster: str) -> Iterator[Any]:
    """Client of the cluster whose workers are threads, for surveys of a test."""
    from distributed import Client

    with Client(cluster, set_as_default=False) as client:
        yield client


@pytest.fixture
def torch(monkeypatch: pytest.MonkeyPatch) -> Iterator[types.ModuleType]:
    """A module in place of PyTorch, whose tensors are arrays."""
    played: Any = types.ModuleType("torch")
    played.__spec__ = types.SimpleNamespace()
    played.from_numpy = lambda array: array
    played.utils = types.ModuleType("torch.utils")
    played.utils.data = types.ModuleType("torch.utils.data")
    played.utils.data.IterableDataset = object
    played.utils.data.get_worker_info = lambda: None
    played.distributed = types.ModuleType("torch.distributed")
    played.distributed.is_available = lambda: True
    played.distributed.is_initialized = lambda: False
    for module in (played, played.utils, played.utils.data, played.distributed):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.delitem(sys.modules, "lidarfiles.datasets.torch_sweeps", raising=False)
    yield played
    sys.modules.pop("lidarfiles.datasets.torch_sweeps", None)
