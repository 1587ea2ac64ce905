from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest
from distributed import Client

from poolpart import Pipe, await_news

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


def test_an_item_ends_the_wait_and_stays(client, pipe):
    threading.Timer(0.1, pipe.put, ["item"]).start()
    assert seconds_of(client, LONG_S, pipes=[pipe.name]) < LONG_S / 2
    assert pipe.poll() == ["item"]


@pytest.mark.parametrize("change", [Pipe.close, Pipe.delete, lambda pipe: pipe.fail("why not")])
def test_the_end_of_a_pipe_ends_the_wait(client, pipe, change):
    threading.Timer(0.1, change, [pipe]).start()
    assert seconds_of(client, LONG_S, pipes=[pipe.name]) < LONG_S / 2


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
