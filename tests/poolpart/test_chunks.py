"""Chunks as they run, and how many items they have."""

import time

import pytest
from distributed import Reschedule
from hypothesis import given
from hypothesis import strategies as st

from poolpart.mapping import GROWTH, MOST_BYTES, MOST_ITEMS, ChunkSize, run_chunk


def invert(x):
    return 1 / x


def calls(*numbers):
    return [(number,) for number in numbers]


def test_all_results_come_in_order():
    answer = run_chunk(invert, 10, 0, 5, calls(1, 2, 4))
    assert answer.results == [1, 0.5, 0.25]
    assert answer.nbytes > 0 < answer.seconds


def test_it_ends_before_an_item_that_fails():
    assert run_chunk(invert, 10, 0, 5, calls(1, 2, 0, 4)).results == [1, 0.5]


def test_it_takes_what_the_stage_before_has_made():
    before = run_chunk(invert, 10, 0, 5, calls(1, 2, 0, 4))
    answer = run_chunk(pow, 10, 1, 5, calls(2, 3, 4, 5), before)
    assert answer.results == [2, 3**0.5]
    assert answer.seconds > before.seconds


def test_an_error_of_the_first_item_is_raised():
    with pytest.raises(ZeroDivisionError) as caught:
        run_chunk(invert, 10, 0, 5, calls(0, 1))
    assert caught.value.__notes__ == ["poolpart: this was item 5 of a map: 0"]


def test_long_items_are_shortened_in_the_note():
    with pytest.raises(TypeError) as caught:
        run_chunk(invert, 10, 0, 0, [("x" * 10_000,)])
    assert len(caught.value.__notes__[0]) < 100


def test_it_ends_when_the_time_is_up_but_not_before_the_first_item():
    answer = run_chunk(time.sleep, 0.015, 0, 0, calls(0.01, 0.01, 0.01, 0.01))
    assert len(answer.results) in (1, 2)
    assert len(run_chunk(invert, 0, 0, 0, calls(1, 1)).results) == 1


def test_dask_is_told_to_reschedule():
    def again(_):
        raise Reschedule

    with pytest.raises(Reschedule):
        run_chunk(again, 10, 0, 0, calls(1))


def learned(item_s, item_bytes, rounds=30, target_s=0.1):
    size = ChunkSize()
    for _ in range(rounds):
        items = size.items(target_s)
        size.learn(items, item_s * items, int(item_bytes * items))
    return size.items(target_s)


@pytest.mark.parametrize(
    ("item_s", "item_bytes", "items"),
    [(1e-2, 100, 10), (1, 100, 1), (1e-6, 100, MOST_ITEMS), (1e-6, MOST_BYTES / 4, 4)],
)
def test_chunks_are_as_large_as_time_and_size_allow(item_s, item_bytes, items):
    assert learned(item_s, item_bytes) == pytest.approx(items, abs=1)


def test_chunks_get_small_again_when_items_take_longer():
    size = ChunkSize()
    for item_s in [1e-4] * 20 + [1e-1] * 20:
        items = size.items(0.1)
        size.learn(items, item_s * items, 100)
    assert size.items(0.1) == 1


@given(st.lists(st.tuples(st.integers(1, 1000), st.floats(0, 1e3), st.integers(0, 2**40))))
def test_a_chunk_has_an_item_and_at_most_four_times_what_was_tried(chunks):
    size = ChunkSize()
    for items, seconds, nbytes in chunks:
        size.learn(items, seconds, nbytes)
    tried = max((items for items, _, _ in chunks), default=0)
    assert 1 <= size.items(0.1) <= max(1, min(GROWTH * tried, MOST_ITEMS))
