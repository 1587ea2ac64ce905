"""What the cells of a notebook show of an object: a table and a small picture."""

import io
import re
from base64 import b64decode

import numpy as np
import pytest
from PIL import Image

from lidarsim import Actor, Cloud, Mounted, Pose, Scene, Sensor, Survey, Track, box, load_sensor
from lidarview.cell_pictures import MAX_BYTES

SCENE = Scene.from_meshes([box("<b>Floor</b>", (40, 30, 0.1)), box("Shelf & Co", (2, 1, 3))])
VLP16 = load_sensor("velodyne/vlp16")
DRIVE = Survey(
    sensors=[Mounted(VLP16, Pose((0, 0, 1.9)), name="<roof>"), Mounted(VLP16, name="rear")],
    trajectory=Track([0, 0.5], [(0, 0, 0), (3, 1, 0)]),
)
CLOUD = Cloud(np.random.default_rng(0).uniform(0, 9, (200_000, 3)), {"range": np.ones(200_000)})
SHOWN = {
    "scene": (SCENE, "2 objects: &lt;b&gt;Floor&lt;/b&gt;, Shelf &amp; Co", "40.00 × 30.00 × "),
    "actors": (SCENE.with_actors([Actor(box("Car 1", (4, 2, 1.5)))]), "actors", "Car 1"),
    "sensor": (VLP16, "360°, -15° to 15°", "10 Hz, 289,440 rays/s", "from 0.4 m to 130 m"),
    "sector": (Sensor.grid(horizontal_fov_deg=90), "89.91°, -30° to 30°", "from 0 m"),
    "survey": (Survey(Sensor.grid(100, 4), poses=[(0, 0, 1), (3, 2, 1)]), "2 positions", "800"),
    "drive": (DRIVE, "2 sensors: &lt;roof&gt;: Velodyne VLP-16", "along a trajectory", "sensor"),
    "cloud": (CLOUD, "200,000 points, 9.00 × 9.00 × 9.00 m", "<td>range</td>"),
    "point": (Cloud(np.ones((1, 3)), {}), "1 points"),
}


@pytest.mark.extended(every=2)
@pytest.mark.slow(every=4)
@pytest.mark.parametrize("name", SHOWN)
def test_a_cell_has_a_table_and_a_small_picture(name):
    instance, *words = SHOWN[name]
    html = instance._repr_html_()
    assert [word for word in words if word not in html] == []
    tags = {tag.lower() for tag in re.findall(r"<(\w+)", html)}
    assert tags <= {"table", "caption", "tr", "th", "td", "img"}
    assert "color" not in html  # those of the notebook, light or dark
    (data,) = re.findall(r'src="data:image/png;base64,([^"]+)"', html)
    png = b64decode(data)
    assert len(png) <= MAX_BYTES
    image = Image.open(io.BytesIO(png)).convert("RGB")
    assert image.size == ((400, 250) if name == "cloud" else (800, 500))
    assert len(np.unique(np.asarray(image).reshape(-1, 3), axis=0)) > 8


def test_an_empty_cloud_has_a_table_alone():
    html = Cloud(np.empty((0, 3)), {})._repr_html_()
    assert "0 points" in html
    assert "<img" not in html
