"""The picture of the page of partitions shows partitions at work."""

import re
from pathlib import Path
from urllib.request import urlopen

import pytest
from docs.pictures import partitions_page


@pytest.mark.slow
def test_the_page_is_drawn_while_partitions_work(tmp_path, monkeypatch):
    def read(url: str, picture: Path) -> None:
        with urlopen(url, timeout=60) as page:
            picture.write_bytes(page.read())

    monkeypatch.setattr(partitions_page, "draw", read)
    monkeypatch.setattr(partitions_page, "ITEM_S", 0.02)
    assert partitions_page.main([str(tmp_path / "page.png")]) == 0
    page = (tmp_path / "page.png").read_text()
    cells = set(re.findall(r'<td data-name="([a-z]+)"[^>]*>([^<]+)</td>', page))
    assert {("partition", name) for name in ("GPU", "IO", "OTHER")} <= cells
    assert {("stage", "shrink"), ("stage", "load")} <= cells
    assert {("pipe", "pictures"), ("state", "open")} <= cells
