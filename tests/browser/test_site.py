"""The documentation as a site, opened from disk."""

import time
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]


@pytest.fixture
def site(tmp_path):
    """Build a site of two pages with the theme, the scripts and the search of the whole one."""
    pytest.importorskip("material", reason="mkdocs-material is for `make docs`")
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    settings = yaml.safe_load((ROOT / "mkdocs.yml").read_text("utf-8"))
    pages = tmp_path / "docs"
    for folder in ("javascripts", "stylesheets"):
        (pages / folder).mkdir(parents=True)
        for file in (ROOT / "docs" / folder).iterdir():
            (pages / folder / file.name).write_bytes(file.read_bytes())
    (pages / "index.md").write_text("# Overview\n\n[Sweeps](deep/sweeps.md) are elsewhere.\n")
    (pages / "deep").mkdir()
    (pages / "deep" / "sweeps.md").write_text("# Turns\n\nA sweep is a turn of the kaleidoscope.\n")
    config = load_config(
        str(ROOT / "mkdocs.yml"),
        docs_dir=str(pages),
        site_dir=str(tmp_path / "site"),
        nav=[{"Overview": "index.md"}, {"Turns": "deep/sweeps.md"}],
        not_in_nav=None,
        hooks=[],
        plugins=[plugin for plugin in settings["plugins"] if isinstance(plugin, str)],
    )
    build(config)
    return tmp_path / "site"


@pytest.mark.extended
@pytest.mark.slow(keep=("deep/sweeps.html",))
@pytest.mark.parametrize("page", ("index.html", "deep/sweeps.html"))
def test_search_works_from_disk_and_asks_no_network(site, new_tab, page):
    tab = new_tab((site / page).as_uri())
    tab.wait_for(lambda text: tab.value("document.readyState") == "complete" and "Overview" in text)
    box = "document.querySelector('.md-search__input')"
    assert tab.value(f"{box}.getBoundingClientRect().width") > 100
    # A window that has no focus gets no events of it, so typing is played.
    tab.value("document.querySelector('[data-md-toggle=search]').click()")
    tab.value(f"{box}.value = 'kaleido'; {box}.dispatchEvent(new KeyboardEvent('keyup'))")
    found = "[...document.querySelectorAll('.md-search-result__link')].map(link => link.href)"
    deadline = time.monotonic() + 60
    while not (links := tab.value(found)):
        assert time.monotonic() < deadline, tab.text
        time.sleep(0.1)
    assert links[0].startswith((site / "deep/sweeps.html").as_uri())
    assert {url.partition(":")[0] for url in tab.requests} <= {"file", "data", "about"}
    assert tab.errors == []
