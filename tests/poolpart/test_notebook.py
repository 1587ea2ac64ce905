"""Pools and partitions as notebooks show them."""

import re
from html import unescape

import pytest
from distributed import Client
from tests.clusters import cluster_of

from poolpart import Pool

NASTY = "<script>alert('x')</script>&\"'"


def rows_of(text):
    """Cells of each row of a table below its head, by the first."""
    rows = [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in text.split("<tr>")[2:]]
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
        "remainder": ["1", "1", "0", "0", "0", "0", "0", "0"],
    }
    assert "pool.page()" in text
    assert "href" not in text
    url = pool.page()
    assert f'<a href="{url}"' in rest._repr_html_()
    assert rows_of(cpu._repr_html_()) == {"CPU": ["2", "3", "0", "0", "0", "0", "3", "0"]}


def test_a_closed_client_leaves_the_text(pool):
    part, _ = pool.partition("<b>", workers=["b"])
    pool.client.close()
    assert part._repr_html_() == "<pre>&lt;Partition &#x27;&lt;b&gt;&#x27;&gt;</pre>"
    assert pool._repr_html_().startswith("<pre>&lt;Pool: workers 3")
