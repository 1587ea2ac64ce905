from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest
from distributed import Client

from poolpart import Pipe, await_news, take_news
from poolpart.pipe import await_room

LONG_S = 120.0  # nobody waits so long: a test that does has failed


@pytest.fixture
def pipe(client: Client) -> Iterator[Pipe]:
    pipe = Pipe("news", capacity=4, client=client).create()
    yield pipe
    pipe.delete()


def seconds_of(client: Client, seconds: float, **what) -> float:
    start = time.monotonic()
    await_news(client, seconds, **what)
    return time.monotonic() - start


WAITS = [await_news, take_news]
ENDS = [Pipe.close, Pipe.delete, lambda pipe: pipe.fail("why not")]


@pytest.mark.parametrize("wait", WAITS)
@pytest.mark.parametrize("change", [*ENDS, lambda pipe: pipe.put("item")])
def test_an_item_or_the_end_of_a_pipe_ends_the_wait(client, pipe, change, wait):
    threading.Timer(0.1, change, [pipe]).start()
    start = time.monotonic()
    wait(client, LONG_S, [pipe.name])
    assert time.monotonic() - start < LONG_S / 2


def test_a_task_that_ends_or_is_not_known_ends_the_wait(client, pipe):
    future = client.submit(time.sleep, 0.1, pure=False)
    assert seconds_of(client, LONG_S, pipes=[pipe.name], keys=[future.key]) < LONG_S / 2
    assert seconds_of(client, LONG_S, keys=["nobody-knows"]) < LONG_S / 2


def test_without_news_the_wait_is_as_long_as_was_said(client, pipe):
    assert seconds_of(client, 0.1, pipes=[pipe.name]) >= 0.1
    assert not await_news(client, 0.0, [pipe.name])
    pipe.put("item")
    assert await_news(client, 0.0, [pipe.name])


def test_one_that_waits_does_not_take_the_item(client, pipe):
    """As a consumer that died would: the next one gets all that comes."""
    waiter = threading.Thread(target=await_news, args=(client, 0.5, [pipe.name]))
    waiter.start()
    for number in range(3):
        pipe.put(number)
    waiter.join()
    assert pipe.poll() == [0, 1, 2]


# -- waiting for news, and taking it ---------------------------------------------------


@pytest.fixture
def pipes(client: Client, make_pipe) -> list[Pipe]:
    return [make_pipe(client, capacity=100) for _ in range(3)]


def test_all_that_is_in_the_pipes_is_taken_in_one_request(client, pipes, monkeypatch):
    one, two, empty = pipes
    for number in range(5):
        one.put(number)
    two.put({"scan": 7})
    asked, ask = [], client.run_on_scheduler
    monkeypatch.setattr(client, "run_on_scheduler", lambda *a, **k: asked.append(1) or ask(*a, **k))
    found = take_news(client, LONG_S, [pipe.name for pipe in pipes])
    assert len(asked) == 1
    assert found == {one.name: [0, 1, 2, 3, 4], two.name: [{"scan": 7}]}
    assert [pipe.depth for pipe in pipes] == [0, 0, 0]
    assert take_news(client, 0.0, [one.name, two.name, empty.name]) == {}


def test_what_was_put_before_a_pipe_was_closed_is_taken(client, pipes):
    pipes[0].put("left")
    pipes[0].close()
    assert take_news(client, LONG_S, [pipes[0].name]) == {pipes[0].name: ["left"]}
    assert take_news(client, LONG_S, [pipes[0].name]) == {}  # at once


# -- waiting for room ------------------------------------------------------------------


@pytest.fixture
def full(pipe: Pipe) -> Pipe:
    for number in range(pipe.capacity):
        pipe.put(number)
    return pipe


def test_there_is_room_below_the_capacity_and_none_above(client, full):
    assert await_room(client, 0.0, full.name, full.capacity + 1)
    start = time.monotonic()
    assert not await_room(client, 0.1, full.name, full.capacity)
    assert time.monotonic() - start >= 0.1


@pytest.mark.parametrize("change", [*ENDS, Pipe.poll])
def test_room_or_the_end_of_a_pipe_ends_the_wait_for_room(client, full, change):
    threading.Timer(0.1, change, [full]).start()
    start = time.monotonic()
    assert await_room(client, LONG_S, full.name, full.capacity)
    assert time.monotonic() - start < LONG_S / 2
