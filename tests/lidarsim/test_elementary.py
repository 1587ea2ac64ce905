"""Functions with the same bits everywhere: how exact they are, and what they do at the limits."""

import importlib
import sys

import mpmath
import numpy as np
import pytest

from lidarsim.numerics import elementary
from lidarsim.numerics.vectors import determinant, inverse, matmul, rank

RNG = np.random.default_rng(7)
COUNT = 300
AROUND_1 = np.concatenate([1 + RNG.normal(size=COUNT) * 10.0 ** RNG.uniform(-16, -1, COUNT), [1.0]])
WIDE = 10.0 ** RNG.uniform(-300, 300, COUNT)
SIGNED = RNG.choice([-1, 1], COUNT) * WIDE
WITHIN = np.concatenate([np.sin(RNG.uniform(-1.6, 1.6, COUNT)), np.minimum(AROUND_1, 1), [-1, 0]])
QUARTERS = np.rint(10.0 ** RNG.uniform(0, 14, COUNT)) * (np.pi / 2)
ANGLES = np.concatenate([10.0 ** RNG.uniform(-10, 14, COUNT), QUARTERS, -QUARTERS[:9], [0.0, -0.0]])
SMALL = np.concatenate([RNG.uniform(-0.9, 9, COUNT), 10.0 ** RNG.uniform(-300, -1, COUNT)])
INF = np.inf
NAN = np.nan

RANGES = {
    "sin": (ANGLES,),
    "cos": (ANGLES,),
    "exp": (np.concatenate([RNG.uniform(-707, 709, COUNT), SMALL]),),
    "log": (np.concatenate([WIDE, np.abs(AROUND_1)]),),
    "arctan2": (SIGNED, RNG.permutation(SIGNED) * RNG.choice([1, 0], COUNT)),
    "arcsin": (WITHIN,),
    "arccos": (WITHIN,),
    "log1p": (SMALL,),
    "expm1": (SMALL,),
}
NAMES = {"arctan2": "atan2", "arcsin": "asin", "arccos": "acos"}


@pytest.mark.extended
@pytest.mark.parametrize(("name", "limit"), [(name, 4 if "1" in name else 2) for name in RANGES])
def test_it_is_within_units_of_the_last_place(name, limit):
    given = RANGES[name]
    exact = getattr(mpmath, NAMES.get(name, name))
    found = getattr(elementary, name)(*given)
    with mpmath.workprec(2200):
        for value, *numbers in zip(found.tolist(), *(x.tolist() for x in given), strict=True):
            true = exact(*map(mpmath.mpf, numbers))
            off = abs(mpmath.mpf(value) - true) / np.spacing(max(abs(float(true)), 1e-307))
            assert off <= limit, (numbers, float(off))


@pytest.mark.parametrize(
    ("name", "given", "expected"),
    [
        ("sin", [0.0, -0.0, NAN, INF], [0.0, -0.0, NAN, NAN]),
        ("exp", [0.0, -0.0, 710, -750, INF, -INF, NAN], [1, 1, INF, 0, INF, 0, NAN]),
        (
            "log",
            [0.0, -0.0, 1, INF, -1, NAN, 5e-324],
            [-INF, -INF, 0, INF, NAN, NAN, np.log(5e-324)],
        ),
        ("arcsin", [0.0, -0.0, 2, NAN], [0.0, -0.0, NAN, NAN]),
        ("arccos", [1.0, -1, 2, NAN], [0.0, np.pi, NAN, NAN]),
        ("log1p", [0.0, -0.0, -1], [0.0, -0.0, -INF]),
        ("expm1", [0.0, -0.0, 1000, -1000], [0.0, -0.0, INF, -1]),
        ("cbrt", [8, -27, 1e-3, 1], [2, -3, 0.1, 1]),
    ],
)
def test_limits(name, given, expected):
    with np.errstate(all="ignore"):
        found = getattr(elementary, name)(given)
    np.testing.assert_array_equal(found, expected)
    zero = np.equal(expected, 0)
    np.testing.assert_array_equal(np.signbit(found)[zero], np.signbit(expected)[zero])


def test_angles_of_zero_and_infinite_vectors():
    some = np.array([0.0, -0.0, 1, -1, INF, -INF, NAN])
    y, x = np.meshgrid(some, some)
    found = elementary.arctan2(y, x)
    np.testing.assert_allclose(found, np.arctan2(y, x), rtol=3e-16)
    np.testing.assert_array_equal(found[:2, :2], np.arctan2(y, x)[:2, :2])


@pytest.mark.parametrize("name", ["sin_cos", "exp", "log", "arctan2"])
def test_few_numbers_in_python_have_the_bits_of_many_that_are_compiled(name, monkeypatch):
    given = tuple(x[:100] for x in RANGES.get(name, (ANGLES,)))
    function = getattr(elementary, name)
    importlib.import_module("numba")  # once it is there, it computes all
    compiled = function(*given)
    monkeypatch.delitem(sys.modules, "numba")
    np.testing.assert_array_equal(function(*given), compiled)


def test_small_helpers():
    exact = np.array([0.5, 1, 2, 4])
    np.testing.assert_array_equal(elementary.geomspace(0.5, 4, 4), exact)
    x = RNG.uniform(0, 5, 100)
    np.testing.assert_allclose(
        elementary.interp(x, exact, exact**2), np.interp(x, exact, exact**2), rtol=1e-15
    )
    numbers = [1e-6, 9.99e-4, 1e-3, 0.1, 1, 99, 1000]
    assert [*map(elementary.decade, numbers)] == [-6, -4, -3, -1, 0, 1, 3]


def test_matrices():
    some = RNG.normal(size=(50, 3, 3))
    np.testing.assert_allclose(
        matmul(some, inverse(some)), np.tile(np.eye(3), (50, 1, 1)), atol=1e-9
    )
    np.testing.assert_allclose(determinant(some), np.linalg.det(some), atol=1e-12)
    line = np.outer([1, 2, 3.0], [0.3, 0.7, 0.1])
    plane = some[0] @ np.diag([1, 1, 0.0])
    given = np.stack([some[0], np.diag([1, 1e-9, 1e-12]), plane, line, np.eye(3) * 1e-200])
    assert rank(given).tolist() == [3, 3, 2, 1, 3]
