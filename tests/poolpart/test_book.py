"""The book of who is where, without a cluster: held places, what should be declared."""

import pytest

from poolpart import PoolError, WorkerInfo, n_workers, rest
from poolpart.book import FORGET_S, HOLD_S, Book, Seat, seat_key


def seat(book, name, nanny=None, **found):
    info = WorkerInfo(name, f"tcp://{name}", "h", 2)
    book.seats[name] = Seat(name, info, found, nanny=nanny)
    return book.seats[name]


@pytest.fixture
def clock(monkeypatch):
    now = [1000.0]
    monkeypatch.setattr("poolpart.book.time.monotonic", lambda: now[0])
    return now


def test_a_place_is_held_for_whom_a_nanny_starts_again(clock):
    book = Book()
    book.enter("A", n_workers(2))
    nannied, other = seat(book, "nannied", nanny="tcp://n"), seat(book, "other")
    for one in (nannied, other):
        book.put(one, "A")
        one.absent_since = clock[0]
    assert book.members("A") == [nannied]
    assert book.members("A", present=True) == []
    clock[0] += HOLD_S
    assert book.members("A") == []
    book.forget(clock[0])
    assert list(book.seats) == ["nannied", "other"]
    clock[0] += FORGET_S
    book.forget(clock[0])
    assert not book.seats


def test_what_a_worker_should_declare():
    book = Book()
    one = seat(book, "a", GPU=3, DISK=1)
    assert book.wanted(one) == {"GPU": 3, "DISK": 1}
    book.adopt("GPU")
    assert (one.partition, book.wanted(one)) == ("GPU", {"GPU": 3, "DISK": 1})
    book.enter("A", rest(slots=4))
    book.put(one, "A")
    assert book.wanted(one) == {"A": 4, "DISK": 1}
    book.put(one, None)
    assert book.wanted(one) == {"DISK": 1}
    book.rules.clear()
    assert book.wanted(one) == one.found


def test_what_takes_the_rest_chooses_last():
    book = Book()
    book.enter("R", rest())
    book.enter("A", n_workers(1))
    assert (list(book.rules), book.remainder()) == (["A", "R"], "R")


def test_a_partition_that_nobody_declares():
    with pytest.raises(PoolError, match="There is no partition 'A'"):
        Book().adopt("A")


def test_a_worker_is_known_by_its_name_or_by_its_nanny():
    assert seat_key(3, "tcp://a", "tcp://n") == 3
    assert seat_key("3", "tcp://a", "tcp://n") == "3"
    assert seat_key("tcp://a", "tcp://a", "tcp://n") == "tcp://n"
    assert seat_key("tcp://a", "tcp://a", None) == "tcp://a"
