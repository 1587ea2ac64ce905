"""A mesh that is exchanged for another is never missing from the picture."""

import time

import numpy as np
import pytest
import trimesh

from lidarpool.live.page import live_page
from lidarpool.live.surface import MeshNode

pytestmark = [pytest.mark.browser, pytest.mark.slow]

RED, BLUE = (220, 30, 30), (30, 30, 220)
SWAPS = 6
GONE = 20  # pixels at most are of the page's compass; the ball has hundreds

# Looks at the canvas before each frame: how many pixels of 64 x 40 are red, and how many blue.
SAMPLE = """(() => {
  // The largest: there is a small one for the compass.
  const size = (canvas) => canvas.width * canvas.height;
  const small = new OffscreenCanvas(64, 40).getContext('2d', {willReadFrequently: true});
  window.seen = [];
  const look = () => {
    const canvas = [...document.querySelectorAll('canvas')].sort((a, b) => size(b) - size(a))[0];
    small.clearRect(0, 0, 64, 40);
    small.drawImage(canvas, 0, 0, 64, 40);
    const data = small.getImageData(0, 0, 64, 40).data;
    let red = 0, blue = 0;
    for (let i = 0; i < data.length; i += 4) {
      if (data[i + 3] && data[i] - data[i + 2] > 60) red++;
      if (data[i + 3] && data[i + 2] - data[i] > 60) blue++;
    }
    window.seen.push([red, blue]);
    requestAnimationFrame(look);
  };
  look();
})()"""


@pytest.fixture
def page():
    """Return a page that looks at a ball."""
    with live_page("a ball", port=0) as page:
        page.frame_scene([[-1, -1, -1], [1, 1, 1]])
        yield page


def wait_for_colour(tab, which):
    deadline = time.monotonic() + 120
    while not (tab.value("window.seen.at(-1)") or [0, 0])[which] > 50:
        assert time.monotonic() < deadline, "the ball was not shown"
        time.sleep(0.02)


def opened(new_tab, page):
    tab = new_tab(page.url)
    tab.wait_for(lambda _: tab.value("!!document.querySelector('canvas')"))
    # Few pixels are drawn fast, so that there are frames between two steps of an exchange.
    tab.call(
        "Emulation.setDeviceMetricsOverride",
        width=480, height=300, deviceScaleFactor=1, mobile=False,
    )  # fmt: skip
    tab.value(SAMPLE)
    return tab


def test_a_mesh_is_seen_in_every_frame_while_it_is_exchanged(page, new_tab):
    tab = opened(new_tab, page)
    node = MeshNode(page, "/ball")
    corners = trimesh.creation.icosphere(subdivisions=5).triangles.astype(np.float32)
    for number in range(SWAPS + 1):
        which = number % 2  # red and blue in turn, each when the other is seen
        node.show(corners, np.tile(np.uint8((RED, BLUE)[which]), (len(corners), 1)), True)
        wait_for_colour(tab, which)
        node.settle()
        if not number:
            tab.value("window.seen.length = 0")
    seen = np.array(tab.value("window.seen"))
    assert len(seen) > SWAPS
    assert seen.sum(axis=1).min() > 5 * GONE
    node.set_visible(False)  # which the sampler sees
    deadline = time.monotonic() + 120
    while np.array(tab.value("window.seen")).sum(axis=1)[-1] > GONE:
        assert time.monotonic() < deadline, "the ball is still there"
        time.sleep(0.02)
    assert tab.errors == []
