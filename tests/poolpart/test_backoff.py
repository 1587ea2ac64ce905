import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from poolpart import Backoff


@given(least=st.floats(1e-6, 1.0), factor=st.floats(1.0, 1e4), count=st.integers(1, 40))
def test_pauses_double_up_to_the_longest(least, factor, count):
    most = least * factor
    pause = Backoff(least, most)
    pauses = [pause.next() for _ in range(count)]
    assert pauses[0] == least
    assert all(b == min(2 * a, most) for a, b in itertools.pairwise(pauses))
    pause.reset()
    assert pause.next() == least


def test_sleep_uses_up_a_pause(monkeypatch):
    slept = []
    monkeypatch.setattr("time.sleep", slept.append)
    pause = Backoff(0.5, 1.0)
    pause.sleep()
    pause.sleep()
    pause.sleep()
    assert slept == [0.5, 1.0, 1.0]


@pytest.mark.parametrize(("least", "most"), [(0, 1), (-1, 1), (2, 1), (float("nan"), 1)])
def test_pauses_that_cannot_be(least, most):
    with pytest.raises(ValueError, match="least_s <= most_s"):
        Backoff(least, most)
