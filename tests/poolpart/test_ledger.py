import pytest
from hypothesis import given
from hypothesis import strategies as st

from poolpart import Ledger


@given(data=st.data(), total=st.integers(0, 60))
def test_behaves_as_a_set(data, total):
    ledger, seen, repeated = Ledger(total), set(), 0
    items = st.integers(0, total - 1) if total else st.nothing()
    for item in data.draw(st.lists(items, max_size=150) if total else st.just([])):
        assert ledger.accept(item) is (item not in seen)
        repeated += item in seen
        seen.add(item)
        missing = sorted(set(range(total)) - seen)
        assert ledger.first_missing == (missing[0] if missing else total)
    assert [item for item in range(-3, total + 3) if item in ledger] == sorted(seen)
    assert list(ledger.missing()) == sorted(set(range(total)) - seen)
    assert (ledger.delivered, ledger.duplicates) == (len(seen), repeated)
    assert ledger.complete is (len(seen) == total)


@pytest.mark.parametrize("item", [-1, 3, 4])
def test_an_item_that_was_never_sent(item):
    ledger = Ledger(3)
    with pytest.raises(IndexError, match=f"Item {item} was delivered; there are 3"):
        ledger.accept(item)
    assert ledger.delivered == 0


def test_no_items_are_all_delivered():
    ledger = Ledger(0)
    assert ledger.complete
    assert ledger.first_missing == 0
    assert 0 not in ledger


def test_fewer_than_none():
    with pytest.raises(ValueError, match="-1 items"):
        Ledger(-1)


def test_repr_counts():
    ledger = Ledger(2)
    for _ in range(3):
        ledger.accept(0)
    assert repr(ledger) == "<Ledger 1 of 2 delivered, 2 duplicates dropped>"
