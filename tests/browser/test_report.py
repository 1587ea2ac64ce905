"""The pictures of a report, looked at in a browser that prefers light or dark pages."""

import re
import subprocess
import sys

import numpy as np
import pytest

pytestmark = [pytest.mark.browser, pytest.mark.slow]

SCENARIO = "scene: seed\nsensor: {rays_per_revolution: 100, layers: 8}\n"
PLACE = """(() => {
  const figure = document.querySelector('figure[data-picture=scene]'); figure.scrollIntoView();
  const box = figure.querySelector('svg').getBoundingClientRect();
  return [box.left, box.top, box.width, box.height].map(Math.round);
})()"""


# What is cut off on a page: elements whose content is wider than they are.
CUT = """[...document.querySelectorAll('body, .scroll, table, tr, td, th, dd, dt, figcaption')]
  .filter((e) => e.scrollWidth > e.clientWidth + 1 && e.clientWidth && !e.matches('.bars *'))
  .map((e) => `${e.tagName} ${e.textContent.trim().slice(0, 60)}`)"""


HIDDEN_IN_CHARTS = """[...document.querySelectorAll('.chart .picture-margin')]
  .filter((e) => getComputedStyle(e).display === 'none').length"""
WIDE = re.compile(r'<table class="wide">.*?</table>', re.DOTALL)


def with_long_numbers(table):
    """Return a table with numbers as long as those of large surveys."""
    return re.sub(r"(<td[^>]*>)[\d,.]+(?=</td>)", r"\g<1>814,000,000,123", table[0])


def test_no_number_or_label_is_cut_off(new_tab, tmp_path):
    origin = [691_000, 5_334_000, 515]
    for name, noise in (("a", "{range_m: 0.02}"), ("b", "{}")):
        text = f"{SCENARIO}world: {{origin: {origin}, epsg: 25832}}\nnoise: {noise}\n"
        (tmp_path / f"{name}.yaml").write_text(f"{text}cloud: {{columns: [time, range]}}\n")
        run = [sys.executable, "-m", "lidarpool", "run", f"{name}.yaml", "--out", name]
        subprocess.run(run, cwd=tmp_path, check=True, timeout=180, capture_output=True)
    compare = [sys.executable, "-m", "lidarpool", "compare", "a", "b"]
    subprocess.run(compare, cwd=tmp_path, check=True, timeout=180, capture_output=True)
    tab = new_tab("about:blank")
    for page in ("a/report.html", "lidarpool-compare/compare.html"):
        text = (tmp_path / page).read_text("utf-8")
        (tmp_path / "long.html").write_text(WIDE.sub(with_long_numbers, text), "utf-8")
        for size in ((1400, 900), (390, 844)):
            tab.resize(*size)
            for name in (page, "long.html") if size[0] < 600 else (page,):
                tab.open((tmp_path / name).as_uri())
                tab.wait_for(lambda text: "Nearest" in text or "Sensor and scene" in text)
                assert tab.value(CUT) == [], (name, size)
                assert tab.value("document.documentElement.scrollWidth") <= size[0]
                assert tab.value(HIDDEN_IN_CHARTS) == 0, "charts keep their titles and legends"


# What of a picture lies beside the screen, is too small to read, or covers other text.
UNREADABLE = """(() => {
  const found = [];
  const wide = document.documentElement.clientWidth;
  for (const figure of document.querySelectorAll('figure[data-picture]:not([hidden])')) {
    const name = figure.dataset.picture;
    if (getComputedStyle(figure).overflowX !== 'hidden') found.push(`${name} is scrolled`);
    const shown = (e) => getComputedStyle(e).display !== 'none' && e.getBoundingClientRect();
    const boxes = [...figure.querySelectorAll('.picture-label, .picture-key, .picture-title')]
      .map(shown).filter(Boolean);
    if (name !== 'above' && boxes.length < 5) found.push(`${name} has no text`);
    for (const box of boxes) {
      if (box.left < 0 || box.right > wide) found.push(`${name} has text beside the screen`);
      if (Math.max(box.width, box.height) < 5) found.push(`${name} has tiny text`);
    }
    if ([...figure.querySelectorAll('.picture-margin')].some(shown)) found.push(`${name} twice`);
  }
  return found;
})()"""


def test_pictures_fit_the_screen_of_a_phone(new_tab, tmp_path):
    (tmp_path / "small.yaml").write_text(SCENARIO)
    run = [sys.executable, "-m", "lidarpool", "run", "small.yaml", "--pictures"]
    subprocess.run(run, cwd=tmp_path, check=True, timeout=180, capture_output=True)
    tab = new_tab("about:blank")
    tab.resize(390, 844, mobile=True)
    tab.open((tmp_path / "lidarpool-out" / "report.html").as_uri())
    tab.wait_for(lambda text: "Some of the rays" in text)
    assert tab.value(UNREADABLE) == []
    tab.resize(1280, 900)
    tab.wait_for(lambda text: "Some of the rays" not in text)  # the drawing has it


def test_pictures_are_dark_where_the_browser_is(new_tab, tmp_path):
    (tmp_path / "small.yaml").write_text(SCENARIO)
    run = [sys.executable, "-m", "lidarpool", "run", "small.yaml", "--pictures"]
    subprocess.run(run, cwd=tmp_path, check=True, timeout=180, capture_output=True)
    tab = new_tab((tmp_path / "lidarpool-out" / "report.html").as_uri())
    tab.wait_for(lambda text: "Sensor and scene" in text)
    spread = {}
    for scheme in ("light", "dark"):
        feature = {"name": "prefers-color-scheme", "value": scheme}
        tab.call("Emulation.setEmulatedMedia", features=[feature])
        left, top, width, height = tab.value(PLACE)
        page = tab.picture(tmp_path / f"{scheme}.png")
        picture = page[top : top + height, left : left + width].mean(axis=2)
        spread[scheme] = np.percentile(picture, [0, 50, 100])
    low, middle, high = spread["light"]
    assert low < 60 and middle > 235 and high > 250, "dark letters on a light page"
    low, middle, high = spread["dark"]
    assert low < 40 and middle < 60 and high > 190, "light letters on a dark page"
    # The points from above are light on dark, and the page has more than them in its window.
    pixels = "document.querySelector('figure[data-picture=above] svg').getBoundingClientRect()"
    shown = (
        f"(({{left, top, width, height}}) => [left, top, width, height].map(Math.round))({pixels})"
    )
    tab.value("scrollTo(0, 0)")
    left, top, width, height = tab.value(shown)
    assert height <= 0.6 * tab.value("innerHeight")
    tab.value(f"scrollTo(0, {top})")
    left, top, width, height = tab.value(shown)
    page = tab.picture(tmp_path / "above.png")
    picture = page[top : top + height, left : left + width].mean(axis=2)
    assert np.median(picture) < 60 and picture.max() > 140
    assert tab.errors == []
