"""Fingerprints and sources: another content or another code is another one, the same the same."""

from __future__ import annotations

import copy
import enum
import os
import shutil
import subprocess
import sys
import threading
import time
from collections import namedtuple
from dataclasses import dataclass, field
from functools import cached_property, partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from lidarfiles.identity.fingerprint import fingerprint
from lidarfiles.identity.versions import PACKAGES, software, source_hash
from lidarpool.identity.software import describe_difference
from lidarsim import Beams, LidarError, Sensor, Spin
from lidarsim.sensor import Head

Pair = namedtuple("Pair", "a b")
Other = namedtuple("Other", "a c")


class Mode(enum.Enum):
    ONE = 1
    TWO = 2


@dataclass
class Box:
    content: object
    more: dict = field(default_factory=dict)

    @cached_property
    def half(self):
        return 0.5


DIFFERENT = [
    [0, False, 0.0, -0.0, 0j, "0", b"0", None, float("nan"), ..., Path("0")],
    [1, 1 + 2**70, 1.0, np.nextafter(1.0, 2), True, "1"],
    [(), (0,), (0, 0), ((0,),), [[0], 0], {0: 0}, {0}],
    [("ab", "c"), ("a", "bc"), ("abc",)],
    [np.zeros(4), np.zeros((2, 2)), np.zeros(4, np.float32), np.zeros(4, int), np.zeros(5),
     np.array([0, 0, 0, -0.0]), [0.0] * 4],
    [np.array([np.nan]), np.array([np.inf]), np.array([0], "M8[s]"), np.array([0], "m8[s]")],
    [Box(1), Box(2), Box(1, {"a": 1}), Pair(1, 2), Other(1, 2), (1, 2), Mode.ONE, Mode.TWO],
    [Spin(), Spin(rate_hz=20), Beams([0]), Beams([0, 1]), Beams([0, -0.0])],
    [len, max, np.sin, np.cos, np, os, int, float, Box, Pair],
]  # fmt: skip


@pytest.mark.parametrize("things", DIFFERENT, ids=range(len(DIFFERENT)))
def test_what_differs_has_another(things):
    assert len({fingerprint(thing) for thing in things}) == len(things)


def test_what_is_the_same_has_the_same():
    assert fingerprint({"a": 1, "b": 2.5}) == fingerprint({"b": 2.5, "a": 1})
    assert fingerprint({"x", "y", "z"}) == fingerprint(frozenset({"z", "y", "x"}))
    assert fingerprint(np.float32(0.5)) == fingerprint(0.5), "a number, whoever holds it"
    assert fingerprint(float("nan")) == fingerprint(-float("nan"))
    table = np.arange(12.0).reshape(3, 4)
    assert fingerprint(table.T) == fingerprint(table.T.copy()) != fingerprint(table)
    assert fingerprint(table[::2]) == fingerprint(table[::2].copy())
    assert fingerprint(np.zeros((0, 3))) != fingerprint(np.zeros((0, 4)))
    box = Box(1)
    used = Box(1)
    assert used.half and fingerprint(box) == fingerprint(used), "what follows from its fields"
    used.note = "not a field, but its own"
    assert fingerprint(box) != fingerprint(used)


def test_a_circle_ends():
    around = [1]
    around.append(around)
    box = Box(None)
    box.content = [box]
    assert fingerprint(around) != fingerprint([1]) and fingerprint(box) != fingerprint(Box([]))


content = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
    | npst.arrays(npst.scalar_dtypes(), npst.array_shapes(min_dims=0, min_side=0, max_side=3)),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner),
)  # fmt: skip


@pytest.mark.extended
@settings(max_examples=50)
@given(content)
def test_whatever_is_plain_has_one_that_lasts(thing):
    assert fingerprint(thing) == fingerprint(copy.deepcopy(thing))
    assert fingerprint(thing) != fingerprint([thing])


# -- code -----------------------------------------------------------------------------------------

# {what differs: a thing, and two versions of a part of it}
CODE = {
    "body": ("def thing(r): return {}", "r.range", "-r.range"),
    "constant": ("thing = lambda r: r.range * {}", "2", "3"),
    "text": ("def thing(r): return r[{}]", "'a'", "'b'"),
    "default": ("def thing(r, k={}): return k", "1", "2"),
    "keyword": ("def thing(r, *, k={}): return k", "1", "2"),
    "closure": ("def of(k):\n  return lambda r: k * r\nthing = of({})", "1", "2"),
    "function in it": (
        "def thing(r):\n  return [x + 1 for x in (lambda: {})()]", "r", "-r",
    ),
    "set in it": ("def thing(r): return r in {}", "{1, 2}", "{1, 3}"),
    "global": ("K = {}\ndef thing(r): return K", "1", "2"),
    "global array": ("K = {}\ndef thing(r): return K", "np.zeros(3)", "np.ones(3)"),
    "what it calls": ("def f(r): return {}\ndef thing(r): return f(r)", "r", "-r"),
    "partial": ("thing = partial(lambda r, k: k, k={})", "1", "2"),
    "method": (
        "class C(Sensor):\n  def directions(self, f): return super().directions({})", "f", "f + 1",
    ),
    "constant of a class": (
        "class C(Sensor):\n  K = {}\n  def directions(self, f): return self.K", "1", "2",
    ),
    "property": ("class C(Sensor):\n  @property\n  def period(self): return {}", "1", "2"),
    "static method": ("class C:\n  @staticmethod\n  def k(): return {}", "1", "2"),
    "call": ("class C:\n  def __call__(self, r): return {}", "r", "-r"),
    "method of a base": ("class B:\n  def k(self): return {}\nclass C(B): pass", "1", "2"),
    "head that follows the protocol": (
        "class C(Head):\n  def azimuths(self, f): return {}", "f", "f * 0.5",
    ),
    "bound method": ("class B:\n  def k(self, r): return {}\nthing = B().k", "r", "-r"),
}  # fmt: skip


def made(source):
    """A thing of somebody else's module, from its text."""
    names = {"np": np, "partial": partial, "Sensor": Sensor, "Head": Head, "__name__": "theirs"}
    exec(source, names)
    return names["C"]() if "C" in names else names["thing"]


@pytest.mark.parametrize("what", CODE)
def test_another_code_has_another(what):
    source, *parts = CODE[what]
    one, other = (source.replace("{}", part) for part in parts)
    assert fingerprint(made(one)) == fingerprint(made(one))
    assert fingerprint(made(one)) != fingerprint(made(other))


def test_a_function_that_ran_has_the_same():
    """Python replaces the instructions of a function that runs often by faster ones."""
    thing = made("def thing(r): return [r + i for i in range(3)]")
    before = fingerprint(thing)
    for _ in range(5000):
        thing(1)
    assert fingerprint(thing) == before


SCRIPT = """
import numpy as np
from lidarpool import Beams, Column, Pose, Sensor, Spin, Survey
from lidarfiles.identity.fingerprint import fingerprint
from raybeam import available_backends

GAIN = {"low": 0.5, "high": 2.0, "none": None}
NAMES = {"a", "b", "c", "d"}

class Mine(Sensor):
    TILT = (0.1, 0.2)

    def directions(self, firings):
        return super().directions(firings) * self.TILT[0]

def loud(returns, k=3):
    return [GAIN[name] for name in ("low", "high") if name in NAMES or name in {"x", "y"}]

sensor = Mine(Beams(np.linspace(-0.3, 0.3, 7)), Spin(1808.449))
columns = ["time", Column("loud", "float32", "", "how loud", loud)]
survey = Survey(sensor, [Pose((0, 0, 1), 10)], columns=columns)
survey.stored_columns, survey.path  # what is worked out once and kept
print(fingerprint(survey.sensor, survey.path, survey.columns, GAIN, NAMES))
"""


def test_another_process_finds_the_same():
    found = set()
    for seed in ("1", "2"):
        environment = os.environ | {"PYTHONHASHSEED": seed}
        command = [sys.executable, "-c", SCRIPT]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        found.add(done.stdout)
    assert len(found) == 1 and len(found.pop().strip()) == 64


@pytest.mark.parametrize(
    ("thing", "name"),
    [
        (object(), "object"),
        (threading.Lock(), "lock"),
        (np.array([{}]), "ndarray"),
        ((x for x in ()), "generator"),
        (np.random.default_rng(0), "Generator"),
        (made("lock = __import__('threading').Lock()\ndef thing(r): return lock"), "lock"),
    ],
)
def test_what_has_none_is_refused_by_name(thing, name):
    for outer in (thing, [thing], Box({"a": thing})):
        with pytest.raises(LidarError, match=f"of type {name} cannot be hashed.*Use only num"):
            fingerprint(outer)


ASK = "from lidarfiles.identity.versions import source_hash; print(source_hash())"


@pytest.fixture
def packages(tmp_path: Path) -> Path:
    """The packages, copied to another place."""
    for package in PACKAGES:
        spec = find_spec(package)
        assert spec is not None and spec.submodule_search_locations
        shutil.copytree(spec.submodule_search_locations[0], tmp_path / package)
    return tmp_path


def asked(folder: Path) -> str:
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *sys.path])}
    return subprocess.run(
        [sys.executable, "-c", ASK], env=env, check=True, capture_output=True, text=True
    ).stdout.strip()


@pytest.mark.slow
def test_the_same_sources_in_another_place_are_the_same_and_one_letter_more_is_not(packages):
    ours = source_hash()
    assert asked(packages) == ours
    changed = packages / "raybeam" / "intersect.cu"
    changed.write_text(changed.read_text() + "\n")
    os.utime(changed, (0, 0))
    assert asked(packages) not in ("", ours)


@pytest.mark.extended
def test_a_process_older_than_its_files_does_not_speak_for_them(packages):
    late = time.time() + 3600
    os.utime(packages / "lidarsim" / "pulses" / "returns.py", (late, late))
    assert asked(packages) == "changed since the process started"


def test_the_first_difference_is_named():
    here = software("numpy")
    assert describe_difference(here, here) == ""
    there = here | {"numpy": "1.0 with nothing"}
    assert (
        describe_difference(there, here)
        == f"numpy 1.0 with nothing, but the run requires numpy {here['numpy']}"
    )
    assert describe_difference({}, here).startswith(
        "no lidarpool, but the run requires lidarpool 0."
    )
    assert here["numpy"] == np.__version__  # and no instruction sets
