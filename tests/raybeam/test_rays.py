"""Invalid rays are rejected with a message that names the first; the rest are unit vectors."""

import numpy as np
import pytest

from raybeam import Pattern, RayCaster
from raybeam.rays import check_rays, unit_directions

DOWN = [[0.0, 0, -1]]


@pytest.mark.parametrize(
    ("origins", "directions", "words"),
    [
        (
            [0, 0, 1],
            [[0, 0, -1], [0, 0, 0], [0, 0, 0]],
            r"Direction 1 must .* \[0.0, 0.0, 0.0\].*2 of 3",
        ),
        ([0, 0, 1], [[0, 0, -1], [0, np.nan, 1]], "Direction 1 must .*nan"),
        ([0, 0, 1], [[0, 0, -1], [np.inf, 0, 0]], "Direction 1 must .*inf"),
        ([0, 0, np.nan], DOWN, "Origin 0 must .*nan"),
        ([[0, 0, 1], [0, np.inf, 1]], [[0, 0, -1], [0, 0, -1]], "Origin 1 must .*inf"),
        ([[0, 0, 1], [0, 0, 1]], DOWN * 3, "directions, which is 3, but has length 2"),
        (
            [0, 0, 1],
            [[0, 0]],
            r"directions must be an array of real numbers with shape \(n, 3\), .* \(1, 2\)",
        ),
        (
            [0, 0],
            DOWN,
            r"origins must be an array of real numbers with shape \(n, 3\), .* int64 .* \(2,\)",
        ),
        (
            0,
            DOWN,
            r"origins must be an array of real numbers with shape \(n, 3\), .* int64 .* \(\)",
        ),
        ([0, 0, 1], [["a", "b", "c"]], "directions must be an array of real numbers"),
        ([0, 0, 1], [[0, 0, 1j]], "directions must be an array of real numbers"),
    ],
)
def test_refused(origins, directions, words):
    caster = RayCaster([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], "numpy")
    with pytest.raises(ValueError, match=words):
        caster.cast(origins, directions)


def test_limits_refused():
    for limits in ((-1, 5), (np.nan, 5), (0, np.nan), (3, 2), (np.inf, np.inf)):
        with pytest.raises(ValueError, match="t_min is"):
            check_rays([0, 0, 0], DOWN, *limits)


def test_no_rays(backend):
    caster = RayCaster([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], backend)
    for origins in ([0, 0, 1], np.empty((0, 3))):
        assert len(caster.cast(origins, np.empty((0, 3)))) == 0
    assert len(caster.scan(Pattern(np.empty((0, 3))), [0, 0, 1])) == 0


def test_unit_directions():
    rng = np.random.default_rng(0)
    given = rng.normal(size=(1000, 3)) * 10.0 ** rng.integers(-150, 150, (1000, 1))
    given[0] = [0, 0, 5e-324]
    given[1] = [1e308, 1e308, 1e308]
    out = unit_directions(given)
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 1, rtol=1e-15)
    np.testing.assert_allclose(
        np.cross(out, given / np.abs(given).max(axis=1)[:, None]), 0, atol=1e-15
    )


def test_unit_vectors_stay_as_they_are():
    rng = np.random.default_rng(1)
    unit = rng.normal(size=(1000, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    np.testing.assert_array_equal(unit_directions(unit), unit)
    mixed = unit.copy()
    mixed[::2] *= 7
    np.testing.assert_array_equal(unit_directions(mixed)[1::2], unit[1::2])
