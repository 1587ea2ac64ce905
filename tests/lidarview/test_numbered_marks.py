"""Numbers of stations in pictures."""

from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from lidarview.render.picture_page import DPI, Page


@pytest.mark.parametrize("count", [9, 10, 100])
def test_numbers_lie_within_their_marks(count):
    page = Page((1600, 1000))
    axes = page.figure.add_axes((0, 0, 1, 1))
    pixels = np.zeros((count, 2))
    shot = SimpleNamespace(
        sensors=pixels, project_visible=lambda points: (points, np.ones(count, bool))
    )
    page.number_sensors(axes, shot)
    FigureCanvasAgg(page.figure).draw()
    (area,) = axes.collections[0].get_sizes()
    diameter = np.sqrt(area) * DPI / 72  # pixels
    number = axes.texts[-1]
    assert number.get_text() == str(count)
    box = number.get_window_extent()
    assert np.hypot(box.width, box.height) < diameter
