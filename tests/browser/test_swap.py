"""A mesh that is exchanged for another is never missing from the picture."""

import time

import numpy as np
import pytest
import trimesh

from lidarpool.live.mesh_node import MeshNode, coloured_triangles
from lidarpool.live.page import live_page

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


def ball(colour):
    """Return a ball of 20,480 triangles as binary glTF."""
    made = trimesh.creation.icosphere(subdivisions=5)
    corners = made.triangles.astype(np.float32)
    return coloured_triangles(corners, np.tile(np.uint8(colour), (len(corners), 1)))


@pytest.fixture
def page():
    """Return a page that looks at a ball."""
    with live_page("a ball", port=0) as page:
        page.frame_scene([[-1, -1, -1], [1, 1, 1]])
        yield page


def swapped(tab, show):
    """Show a red ball and a blue one in turn, each when the other is seen; return what was seen.

    (n, 2): pixels of each colour in each frame, from the first on that had a ball.
    """
    colours = [RED, BLUE]
    show(ball(RED))
    wait_for_colour(tab, 0)
    tab.value("window.seen.length = 0")
    for number in range(1, SWAPS + 1):
        show(ball(colours[number % 2]))
        wait_for_colour(tab, number % 2)
    return np.array(tab.value("window.seen"))


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

    def show(data):
        node.show(data, "same")
        node.settle()

    seen = swapped(tab, show)
    assert len(seen) > SWAPS
    assert seen.sum(axis=1).min() > 5 * GONE
    assert tab.errors == []


def test_the_sampler_sees_a_mesh_vanish(page, new_tab):
    tab = opened(new_tab, page)
    node = MeshNode(page, "/ball")
    node.show(ball(RED), "same")
    wait_for_colour(tab, 0)
    node.visible = False
    deadline = time.monotonic() + 120
    while np.array(tab.value("window.seen")).sum(axis=1)[-1] > GONE:
        assert time.monotonic() < deadline, "the ball is still there"
        time.sleep(0.02)
