"""Pools and partitions as notebooks show them."""

import re
from html import unescape

import pytest
from distributed import Client
from tests.clusters import cluster_of

from poolpart import Partition, Pipe, Pool

NASTY = "<script>alert('x')</script>&\"'"


def rows_of(text):
    """Cells of each row of a table below its head, by the first."""
    rows = [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in text.split("<tr>") if "<td" in row]
    return {unescape(first): others for first, *others in rows}


@pytest.fixture
def pool():
    workers = {NASTY: {"nthreads": 1}, "b": {"nthreads": 2}, "c": {"nthreads": 1}}
    with (
        cluster_of(workers, {"dashboard": True}, host="127.0.0.1") as cluster,
        Client(cluster) as client,
    ):
        yield Pool.from_client(client)


def test_a_table_of_partitions_and_a_link_to_the_open_page(pool):
    cpu, rest = pool.partition("CPU", workers=[NASTY, "b"])
    pool.client.gather([cpu.submit(pow, 2, n) for n in range(3)])
    text = pool._repr_html_()
    assert unescape(text).startswith('<table>\n<caption style="text-align: left"><Pool: workers 3')
    assert rows_of(text) == {
        "CPU": ["2", "3", "0", "0", "0", "0", "3", "0"],
        "no partition": ["1", "1", "0", "0", "0", "0", "0", "0"],
    }
    assert "pool.page()" in text
    assert "href" not in text
    url = pool.page()
    assert f'<a href="{url}"' in rest._repr_html_()
    assert "pool.page()" not in cpu._repr_html_()
    assert rows_of(cpu._repr_html_()) == {"CPU": ["2", "3", "0", "0", "0", "0", "3", "0"]}


def test_a_partition_says_how_the_page_opens_and_that_it_was_dissolved(pool):
    part, _ = pool.partition("CPU", workers=["b"])
    assert "call <code>Pool.from_client(client).page()</code>" in part._repr_html_()
    part.dissolve()
    text = part._repr_html_()
    assert "<table>" not in text
    assert "It was dissolved, or its workers have left" in text
    assert "No worker declares this partition" in Partition("never", pool.client)._repr_html_()


def test_a_pipe_shows_its_depth_capacity_and_state(pool):
    pipe = Pipe("<numbers>", 3, pool.client)
    assert "The pipe does not exist. It was deleted or never created." in pipe._repr_html_()
    assert repr(pipe) == "<Pipe '<numbers>': does not exist>"
    with pipe:
        pipe.put_many([1, 2])
        assert repr(pipe) == "<Pipe '<numbers>': 2 of 3 items, open>"
        assert rows_of(pipe._repr_html_()) == {"<numbers>": ["2", "3", "open"]}
        pipe.close()
        assert rows_of(pipe._repr_html_()) == {"<numbers>": ["2", "3", "closed"]}
        assert repr(pipe) == "<Pipe '<numbers>': 2 of 3 items, closed>"
        pipe.fail("no <disk>")
        assert repr(pipe) == "<Pipe '<numbers>': 2 of 3 items, failed: no <disk>>"
        assert rows_of(pipe._repr_html_()) == {"<numbers>": ["2", "3", "failed: no &lt;disk&gt;"]}
    assert "The pipe does not exist" in pipe._repr_html_()


def test_statistics_are_tables_of_a_partition_and_of_its_stages(pool):
    part, _ = pool.partition("CPU", workers=["b"])
    assert rows_of(part.stats()._repr_html_()) == {"CPU": ["1", "2", *"000000", "–", "–"]}
    pool.client.gather([part.submit(pow, 2, n) for n in range(3)])
    stats = part.stats()
    rows = rows_of(stats._repr_html_())
    assert rows["CPU"][:-2] == ["1", "2", "0", "0", "0", "0", "3", "0"]
    assert rows["pow"][:-2] == ["0", "0", "0", "3", "0"]
    assert "<td" in stats.stages["pow"]._repr_html_()


def test_a_closed_client_leaves_the_text(pool):
    part, _ = pool.partition("<b>", workers=["b"])
    pool.client.close()
    text = part._repr_html_().replace("&#39;", "&#x27;")  # the quote of earlier versions of tornado
    assert text == "<pre>&lt;Partition &#x27;&lt;b&gt;&#x27;&gt;</pre>"
    assert pool._repr_html_().startswith("<pre>&lt;Pool: workers 3")
