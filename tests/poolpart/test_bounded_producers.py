"""Producers that are faster than their consumers are slowed down, as the manual shows."""

import time
from collections import Counter

from tests.poolpart.helpers import LONG_S

from poolpart import Pipe, Pool, n_workers, rest

counts: Counter[str] = Counter()  # of pages, in this process
most: Counter[str] = Counter()  # largest values


def begin(kind):
    counts[kind] += 1
    most[kind] = max(most[kind], counts[kind])


def load(document, pages):
    for number in range(6):
        pages.put((document, number))
        begin("pages")


def recognize(page, texts):
    time.sleep(0.002)
    texts.put(page)
    counts["pages"] -= 1


def test_pages_of_documents_wait_in_a_pipe_and_not_in_memory(start):
    counts.clear()
    most.clear()
    client = start({name: {"nthreads": 2} for name in "abc"})
    loaders, readers = (
        Pool.from_client(client).divide({"LOAD": n_workers(1), "OCR": rest(slots=2)}).values()
    )
    with Pipe("pages", 8, client) as pages, Pipe("texts", 8, client) as texts:
        found = []
        listener = texts.listen(found.append)
        loading = loaders.for_each(range(15), load, pages=pages, wait=False)
        reading = readers.for_each(pages, recognize, texts=texts, window=4, wait=False)
        assert loading.result(LONG_S) == 15
        pages.close()
        assert reading.result(LONG_S) == 90
        texts.close()
        listener.join(LONG_S)
    assert sorted(found) == [(document, number) for document in range(15) for number in range(6)]
    assert most["pages"] <= 8 + 4 + 1  # in the pipe, in tasks, and just taken


def query(number):
    begin("tasks")
    time.sleep(0.001)
    counts["tasks"] -= 1
    return number


def test_an_endless_generator_is_read_as_results_are_and_slots_limit_tasks(start):
    counts.clear()
    most.clear()

    def numbers():
        number = 0
        while True:
            begin("read")
            yield number
            number += 1

    client = start({name: {"nthreads": 4} for name in "ab"})
    database, _ = (
        Pool.from_client(client).divide({"DB": n_workers(1, slots=3), "OTHER": rest()}).values()
    )
    results = database.map(query, numbers(), chunk=1)
    assert [next(results) for _ in range(300)] == [*range(300)]
    results.close()
    assert most["read"] <= 300 + 512
    assert most["tasks"] <= 3
