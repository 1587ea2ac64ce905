"""Our own pages keep their content policies: nothing that a page does is refused."""

import re

import pytest
from tests.spirals import COUNT

pytestmark = [pytest.mark.browser, pytest.mark.slow]

REFUSED = "[...window.refused, ...Array.from(window).flatMap((frame) => frame.refused)]"
INLINE = """(() => {
  const script = document.createElement('script');
  script.textContent = 'window.ran = 1';
  document.body.append(script);
  document.body.insertAdjacentHTML('beforeend', '<img src="data:," onerror="window.ran = 2">');
  document.body.insertAdjacentHTML('beforeend', '<i style="color: red" id="styled"></i>');
  return document.getElementById('styled').style.color;
})()"""


def opened(new_tab, url):
    """Open an address in a tab that notes what is refused."""
    tab = new_tab("about:blank")
    tab.watch_policy()
    tab.resize(1280)
    tab.open(url)
    return tab


def check(tab):
    """Assert that nothing was refused yet, and that inline scripts and styles would be."""
    assert tab.value(REFUSED) == [] and tab.errors == []
    assert tab.value(INLINE) == ""
    kinds = ("script-src-elem", "script-src-attr", "style-src-attr")
    refused = tab.wait_for(lambda _: len(told := tab.value(REFUSED)) >= len(kinds) and told)
    assert all(any(line.startswith(kind) for line in refused) for kind in kinds), refused
    assert tab.value("window.ran === undefined")


@pytest.mark.parametrize("page", ["result", "exported"])
def test_a_page_is_opened_played_measured_and_exported(own_pages, new_tab, tmp_path, page):
    tab = opened(new_tab, own_pages[page])
    tab.wait_for(lambda _: tab.value("lidarpool.picture.drawn") == COUNT)
    tab.key("ArrowRight")
    tab.wait_for(lambda text: "sweep 2 of 10" in text)
    tab.key(" ")
    tab.wait_for(lambda text: "sweep 4 of 10" in text)
    tab.key(" ")
    if page == "result":
        tab.click("Range image")
        image = "document.querySelector('#images canvas')"
        tab.wait_for(lambda _: (tab.value(f"{image}?.height") or 1) > 1)
        tab.call("Page.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
        tab.value("document.querySelectorAll('details').forEach((part) => { part.open = true; })")
        tab.click("Download")
        tab.wait_for(lambda _: (tmp_path / "cloud.ply").exists())
    tab.choose("color", "wetness")
    tab.wait_for(lambda text: "wetness, %" in text)
    for key in "b?":
        tab.key(key)
    assert "play or pause" in tab.text
    tab.key("?")
    tab.open(own_pages[page] + "#measure=distance;0,0,0;3,4,0")
    tab.wait_for(lambda text: re.search(r"distance\s5.000 m", text))
    check(tab)


@pytest.mark.parametrize("page", ["jobs", "campaign", "live"])
def test_pages_of_jobs_and_runs_show_bars_frames_and_charts(own_pages, new_tab, page):
    tab = opened(new_tab, own_pages[page])
    shown = {
        "jobs": lambda text: "Points of job 00" in text,
        "campaign": lambda _: tab.value("document.querySelectorAll('#charts svg').length") == 2,
        "live": lambda text: "2 intersect" in text and "30,000 points" in text,
    }
    tab.wait_for(shown[page])
    if page == "campaign":
        fills = "new Set([...document.querySelectorAll('#charts path')].map((e) => e.style.fill))"
        assert tab.value(f"{fills}.size") > 3
    check(tab)
