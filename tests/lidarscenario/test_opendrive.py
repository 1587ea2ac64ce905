"""OpenDRIVE: places of lanes, heights, marks, objects and signals; other programs agree."""

import csv
import io
import re
from importlib.util import find_spec

import numpy as np
import pytest

from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim import LidarError, Scene
from lidarsim.scene.files.meshfile import load_meshes

SHAPES = {
    "1": '<line/>',
    "2": '<arc curvature="-0.02"/>',
    "3": '<spiral curvStart="0.0" curvEnd="0.05"/>',
    "4": '<poly3 a="0.0" b="0.0" c="0.002" d="-0.00001"/>',
    "5": '<paramPoly3 aU="0" bU="60" cU="-4" dU="1" aV="0" bV="0" cV="12" dV="-6"'
    ' pRange="normalized"/>',
    "6": '<paramPoly3 aU="0" bU="1" cU="0" dU="-0.000006" aV="0" bV="0" cV="0.003" dV="0"'
    ' pRange="arcLength"/>',
}  # fmt: skip
LENGTHS = {"5": 57.36068960280429}  # arc length
WIDTHS = (
    '<width sOffset="0" a="3.5" b="0" c="0" d="0"/>'
    '<width sOffset="20" a="3.5" b="0.0" c="0.01" d="-0.0002"/>'
)

# road, lane, s, x, y, z of the middles of lanes, as `carla.Map` of CARLA 0.9.16 has them
CARLA = """
1,2,0.0,20.0,-245.5,1.0
1,2,14.0,34.0,-245.3,1.28
1,2,28.0,48.0,-244.0624,1.56
1,2,42.0,62.0,-241.1896,1.696
1,2,56.0,76.0,-239.5712,1.444
1,1,0.0,20.0,-248.25,1.0
1,1,14.0,34.0,-248.05,1.28
1,1,28.0,48.0,-247.0812,1.56
1,1,42.0,62.0,-245.2948,1.696
1,1,56.0,76.0,-244.1356,1.444
1,-1,0.0,20.0,-251.75,1.0
1,-1,14.0,34.0,-251.55,1.28
1,-1,28.0,48.0,-251.1188,1.56
1,-1,42.0,62.0,-251.5052,1.696
1,-1,56.0,76.0,-251.2644,1.444
2,2,0.0,18.2476,-145.8552,1.0
2,2,14.0,32.9227,-141.7464,1.28
2,2,28.0,48.3828,-140.8299,1.56
2,2,42.0,64.5206,-142.8443,1.696
2,2,56.0,79.3167,-150.6223,1.444
2,1,0.0,19.3185,-148.3881,1.0
2,1,14.0,33.2519,-144.4767,1.28
2,1,28.0,47.9018,-143.8102,1.56
2,1,42.0,62.772,-146.5584,1.696
2,1,56.0,76.3071,-154.0539,1.444
2,-1,0.0,20.6815,-151.6119,1.0
2,-1,14.0,33.6709,-147.9515,1.28
2,-1,28.0,47.2586,-147.7962,1.56
2,-1,42.0,60.1268,-152.1773,1.696
2,-1,56.0,71.6064,-159.4133,1.444
3,2,0.0,16.7719,-46.8648,1.0
3,2,14.0,25.8467,-36.7097,1.28
3,2,28.0,31.7686,-25.468,1.56
3,2,42.0,31.8136,-14.246,1.696
3,2,56.0,28.4177,-6.4602,1.444
3,1,0.0,18.7446,-48.7808,1.0
3,1,14.0,27.9691,-38.4584,1.28
3,1,28.0,34.4945,-26.7651,1.56
3,1,42.0,35.9161,-14.3929,1.696
3,1,56.0,32.3423,-4.1296,1.444
3,-1,0.0,21.2554,-51.2192,1.0
3,-1,14.0,30.6704,-40.6839,1.28
3,-1,28.0,38.1404,-28.5,1.56
3,-1,42.0,42.1226,-14.6152,1.696
3,-1,56.0,38.4718,-0.4897,1.444
4,2,0.0,15.8058,51.6306,1.0
4,2,14.0,20.2709,64.6565,1.28
4,2,28.0,23.1756,78.2017,1.56
4,2,42.0,24.0696,92.2779,1.696
4,2,56.0,25.9044,106.1114,1.444
4,1,0.0,18.3689,50.6341,1.0
4,1,14.0,22.8807,63.7895,1.28
4,1,28.0,26.0746,77.3598,1.56
4,1,42.0,28.0406,91.2368,1.696
4,1,56.0,30.336,105.0187,1.444
4,-1,0.0,21.6311,49.3659,1.0
4,-1,14.0,26.2022,62.6861,1.28
4,-1,28.0,29.952,76.2338,1.56
4,-1,42.0,34.048,89.6619,1.696
4,-1,56.0,37.2576,103.3121,1.444
5,2,0.0,15.5019,149.8686,1.0
5,2,14.0,14.3277,163.4484,1.28
5,2,28.0,11.2325,176.895,1.56
5,2,42.0,6.08,190.1374,1.696
5,2,56.0,2.2061,203.9685,1.444
5,1,0.0,18.2507,149.9489,1.0
5,1,14.0,17.0614,163.748,1.28
5,1,28.0,14.2137,177.3699,1.56
5,1,42.0,10.1256,190.8343,1.696
5,1,56.0,6.724,204.6183,1.444
5,-1,0.0,21.7493,150.0511,1.0
5,-1,14.0,20.5405,164.1293,1.28
5,-1,28.0,18.201,178.005,1.56
5,-1,42.0,16.2459,191.8886,1.696
5,-1,56.0,13.7802,205.6332,1.444
6,2,0.0,15.9082,248.1273,1.0
6,2,14.0,9.5518,260.1625,1.28
6,2,28.0,1.3571,271.0186,1.56
6,2,42.0,-8.9322,280.0149,1.696
6,2,56.0,-18.8863,288.7659,1.444
6,1,0.0,18.4087,249.2717,1.0
6,1,14.0,11.9474,261.5129,1.28
6,1,28.0,3.852,272.7181,1.56
6,1,42.0,-5.7499,282.6083,1.696
6,1,56.0,-15.6133,291.9472,1.444
6,-1,0.0,21.5913,250.7283,1.0
6,-1,14.0,14.9964,263.2316,1.28
6,-1,28.0,7.189,274.9912,1.56
6,-1,42.0,-0.9357,286.5316,1.696
6,-1,56.0,-10.5013,296.9159,1.444
"""


def lane(number, inside="", kind="driving", level="false"):
    return f'<lane id="{number}" type="{kind}" level="{level}">{inside}</lane>'


def section(left="", right="", middle="", s=0):
    return (
        f'<laneSection s="{s}"><left>{left}</left><center>{lane(0, middle, "none")}</center>'
        f"<right>{right}</right></laneSection>"
    )


def width(meters, s=0):
    return f'<width sOffset="{s}" a="{meters}" b="0" c="0" d="0"/>'


def road(
    sections="", *, number=1, length=100, shape="<line/>", at=(0, 0, 0), profiles="", more="",
    offset="",
):  # fmt: skip
    x, y, heading = at
    sections = sections or section(right=lane(-1, width(3.5)))
    return (
        f'<road name="" length="{length}" id="{number}" junction="-1"><planView>'
        f'<geometry s="0" x="{x}" y="{y}" hdg="{heading}" length="{length}">{shape}</geometry>'
        f"</planView>{profiles}<lanes>{offset}{sections}</lanes>{more}</road>"
    )


def document(*roads, header='<header revMajor="1" revMinor="6"/>'):
    return f'<?xml version="1.0"?><OpenDRIVE>{header}{"".join(roads)}</OpenDRIVE>'


def network():
    """Return a file with a road for each kind of geometry, with widening lanes and a slope."""
    lanes = section(lane(1, WIDTHS) + lane(2, width(2)), lane(-1, WIDTHS))
    slope = (
        '<elevationProfile><elevation s="0" a="1" b="0.02" c="0" d="0"/>'
        '<elevation s="30" a="1.6" b="0.02" c="-0.001" d="0"/></elevationProfile>'
    )
    offset = (
        '<laneOffset s="0" a="0" b="0" c="0" d="0"/><laneOffset s="10" a="0" b="0.05" c="0" d="0"/>'
    )
    return document(
        *(
            road(
                lanes,
                number=number,
                length=LENGTHS.get(number, 60),
                shape=shape,
                at=(20, 100 * k - 250, 0.4 * k),
                profiles=slope,
                offset=offset,
            )
            for k, (number, shape) in enumerate(SHAPES.items())
        )
    )


def load(tmp_path, text, notes=None, **options):
    path = tmp_path / "a.xodr"
    path.write_text(text)
    meshes = load_meshes(path, report=[].append if notes is None else notes.append, **options)
    return {mesh.name: mesh for mesh in meshes}


def carla_rows():
    """Return rows of road, lane, s, x, y and z: of CARLA if installed, else as recorded."""
    try:
        import carla
    except ImportError:
        return np.array([[float(x) for x in row] for row in csv.reader(io.StringIO(CARLA.strip()))])
    rows = []
    for point in carla.Map("network", network()).generate_waypoints(14.0):
        place = point.transform.location
        rows.append((point.road_id, point.lane_id, point.s, place.x, -place.y, place.z))
    return np.array(rows)


def heights_below(mesh, points):
    """Return the height of a mesh at points (n, 2), by its triangles in plan; NaN beside it."""
    heights = np.full(len(points), np.nan)
    for a, b, c in mesh.vertices[mesh.faces]:
        edges = np.array([b - a, c - a])
        if abs(np.linalg.det(edges[:, :2])) < 1e-9:
            continue
        share = (points - a[:2]) @ np.linalg.inv(edges[:, :2])
        inside = (share >= -1e-3).all(axis=1) & (share.sum(axis=1) <= 1 + 1e-3)
        heights[inside] = a[2] + share[inside] @ edges[:, 2]
    return heights


def test_middles_of_lanes_are_those_of_carla(tmp_path):
    meshes = load(tmp_path, network())
    rows = carla_rows()
    assert len(rows) == 90
    for number, lane_number in np.unique(rows[:, :2].astype(int), axis=0).tolist():
        mesh = meshes[f"driving lane {number}/{lane_number}"]
        of_lane = rows[(rows[:, 0] == number) & (rows[:, 1] == lane_number)]
        np.testing.assert_allclose(heights_below(mesh, of_lane[:, 3:5]), of_lane[:, 5], atol=2e-3)
        # In plan: the middle between the borders next to each place.
        corners = mesh.vertices.reshape(2, -1, 3)
        middles = corners.mean(axis=0)
        ahead = np.diff(middles[:, :2], axis=0)
        size = np.maximum((ahead**2).sum(axis=1), 1e-12)
        for x, y in of_lane[:, 3:5]:
            share = np.clip(
                ((np.array([x, y]) - middles[:-1, :2]) * ahead).sum(axis=1) / size, 0, 1
            )
            nearest = middles[:-1, :2] + share[:, None] * ahead
            assert np.hypot(*(nearest - (x, y)).T).min() < 0.03


def test_tolerance_of_curves(tmp_path):
    text = document(
        road(section(right=lane(-1, width(4))), length=150, shape='<arc curvature="0.02"/>')
    )
    counts = {}
    for sag in (0.001, 0.01, 0.1):
        mesh = load(tmp_path, text, sag_m=sag)["driving lane 1/-1"]
        counts[sag] = len(mesh.faces)
        edges = mesh.vertices.reshape(2, -1, 3)
        middles = (edges[:, 1:] + edges[:, :-1]) / 2
        radii = np.hypot(middles[..., 0], middles[..., 1] - 50)
        assert np.abs(radii - [[50], [54]]).max() <= sag
    assert counts[0.001] > 2.5 * counts[0.01] > 6 * counts[0.1]
    with pytest.raises(LidarError, match=r"support sag_m \(an option of \.xodr\)\. Remove sag_m"):
        Scene.load(_obj(tmp_path), sag_m=0.01)


@pytest.mark.parametrize(("radius", "sag"), [(0.5, 0.01), (2, 0.01), (5, 0.01), (10, 0.1)])
def test_cylinders_have_no_more_segments_than_their_tolerance_needs(tmp_path, radius, sag):
    text = document(road(more=thing("pole", f'radius="{radius}" height="3"', at='s="50" t="20"')))
    mesh = load(tmp_path, text, sag_m=sag)["pole 1/7"]
    count = int(np.ceil(np.pi / np.arccos(1 - sag / radius)))
    ring, top = mesh.vertices.reshape(2, count, 3)
    angle = 2 * np.pi * np.arange(count) / count
    expected = [50 + radius * np.cos(angle), 20 + radius * np.sin(angle), np.full(count, 0.5)]
    np.testing.assert_allclose(ring, np.transpose(expected), atol=1e-9)
    np.testing.assert_allclose(top - ring, [[0, 0, 3]] * count, atol=1e-9)
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    volume = np.einsum("ij,ij->", a - ring.mean(axis=0), np.cross(b - a, c - a)) / 6
    assert volume == pytest.approx(3 * count / 2 * radius**2 * np.sin(2 * np.pi / count))


def _obj(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    return path


def profile(*elements):
    return f"<lateralProfile>{''.join(elements)}</lateralProfile>"


@pytest.mark.parametrize(
    ("inside", "expected"),
    [
        (
            '<superelevation s="0" a="0.1" b="0" c="0" d="0"/>',
            (0, -4 * np.cos(0.1), -4 * np.sin(0.1)),
        ),
        ('<crossfall side="right" s="0" a="0.02" b="0" c="0" d="0"/>', (0, -4, -4 * np.tan(0.02))),
        ('<crossfall side="left" s="0" a="0.02" b="0" c="0" d="0"/>', (0, -4, 0)),
        (
            '<shape s="0" t="-9" a="1" b="0.1" c="0" d="0"/>'
            '<shape s="0" t="-3" a="0.5" b="0" c="0.01" d="0"/>',
            (0, -4, 1 + 0.1 * 5),
        ),
        (
            '<shape s="-50" t="-9" a="0" b="0" c="0" d="0"/>'
            '<shape s="50" t="-9" a="1" b="0" c="0" d="0"/>',
            (0, -4, 0.5),
        ),
    ],
)  # fmt: skip
def test_cross_sections(tmp_path, inside, expected):
    mesh = load(
        tmp_path, document(road(section(right=lane(-1, width(4))), profiles=profile(inside)))
    )
    vertices = mesh["driving lane 1/-1"].vertices
    assert np.abs(vertices - expected).sum(axis=1).min() < 1e-9


def test_level_lanes_heights_and_kerbs(tmp_path):
    height = '<height sOffset="0" inner="0.12" outer="0.15"/>'
    lanes = lane(-1, width(4)) + lane(-2, width(2) + height, "sidewalk", "true")
    bank = profile('<superelevation s="0" a="0.1" b="0" c="0" d="0"/>')
    meshes = load(tmp_path, document(road(section(right=lanes), profiles=bank)), materials=True)
    walk = meshes["sidewalk lane 1/-2"]
    edge = np.array([0, -4 * np.cos(0.1), -4 * np.sin(0.1)])
    up = np.array([0, -np.sin(0.1), np.cos(0.1)])
    for point in (edge, edge + 0.12 * up, edge + (0, -2, 0) + 0.15 * up):  # kerb, inside, outside
        assert np.abs(walk.vertices - point).sum(axis=1).min() < 1e-9
    assert set(walk.materials.names) == {"concrete"}


def test_heights_hold_until_the_next(tmp_path):
    heights = '<height sOffset="0" inner="0" outer="0"/><height sOffset="50" inner="1" outer="1"/>'
    meshes = load(tmp_path, document(road(section(right=lane(-1, width(4) + heights)))))
    points = np.array([[25, -2], [49.9, -2], [50.1, -2]])
    np.testing.assert_allclose(
        heights_below(meshes["driving lane 1/-1"], points), [0, 0, 1], atol=1e-9
    )


def test_borders_and_lane_offsets(tmp_path):
    right = lane(-1, '<border sOffset="0" a="3" b="0.01" c="0" d="0"/>') + lane(
        -2, '<border sOffset="0" a="5" b="0" c="0" d="0"/>', "shoulder"
    )
    offset = '<laneOffset s="0" a="1" b="0" c="0" d="0"/>'
    meshes = load(tmp_path, document(road(section(right=right), offset=offset)))
    corners = meshes["shoulder lane 1/-2"].vertices[:, :2].tolist()
    assert sorted(corners) == [[0, -4], [0, -2], [100, -4], [100, -3]]


def test_driving_lanes_are_on_top_in_junctions(tmp_path):
    lanes = lane(-1, width(4)) + lane(-2, width(4), "sidewalk") + lane(-3, width(4), "none")
    text = document(road(section(right=lanes))).replace('junction="-1"', 'junction="5"')
    meshes = load(tmp_path, text)
    heights = {name.split()[0]: mesh.vertices[:, 2].max() for name, mesh in meshes.items()}
    assert heights == {"driving": 0, "sidewalk": -0.002, "none": -0.005}


def test_lanes_that_end_have_no_empty_triangles(tmp_path):
    lanes = lane(-1, '<width sOffset="0" a="2" b="-0.02" c="0" d="0"/>') + lane(-2, width(0))
    meshes = load(tmp_path, document(road(section(right=lanes))))
    assert list(meshes) == ["driving lane 1/-1"]
    assert len(meshes["driving lane 1/-1"].faces) == 1


def mark(inside="", kind="solid", color="white", meters=0.2, s=0):
    head = f'<roadMark sOffset="{s}" type="{kind}" color="{color}" width="{meters}">'
    return f"{head}{inside}</roadMark>"


def painted(mesh):
    """Return the area of a mesh, and its bounds in plan."""
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    size = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    return size, mesh.bounds[:, :2].round(6).tolist()


@pytest.mark.parametrize(
    ("inside", "area", "bounds"),
    [
        (mark(), 20, [[0, -4.1], [100, -3.9]]),
        (mark(kind="broken"), 0.2 * (11 * 3 + 1), [[0, -4.1], [100, -3.9]]),
        (mark(kind="solid solid"), 40, [[0, -4.3], [100, -3.7]]),
        (mark(kind="none"), None, None),
        (mark() + mark(kind="none", s=40), 8, [[0, -4.1], [40, -3.9]]),
        (
            mark('<type name="x" width="0.1"><line length="2" space="3" sOffset="1" tOffset="0.5"/>'
                 "</type>", kind="broken"),
            0.1 * 40, [[1, -3.55], [98, -3.45]],
        ),
        (
            mark('<explicit><line sOffset="10" tOffset="0" length="5" width="0.3"/></explicit>'),
            1.5, [[10, -4.15], [15, -3.85]],
        ),
        (mark(kind="botts dots"), 0.1 * 0.1 * 77, [[0, -4.05], [98.9, -3.95]]),
    ],
)  # fmt: skip
def test_road_marks(tmp_path, inside, area, bounds):
    meshes = load(
        tmp_path, document(road(section(right=lane(-1, width(4) + inside)))), materials=True
    )
    if area is None:
        assert list(meshes) == ["driving lane 1/-1"]
        return
    marks = meshes["road mark 1"]
    size, extent = painted(marks)
    assert size == pytest.approx(area)
    assert extent == bounds
    np.testing.assert_allclose(marks.vertices[:, 2], 0.003, atol=1e-12)
    assert marks.materials.names == ("paint white",)


def test_marks_lie_on_the_triangles_of_banked_curves(tmp_path):
    bank = profile('<superelevation s="0" a="0" b="0.001" c="0" d="0"/>')
    hill = '<elevationProfile><elevation s="0" a="0" b="0.02" c="0.0005" d="0"/></elevationProfile>'
    lanes = section(right=lane(-1, width(4) + mark(kind="broken")) + lane(-2, width(3)))
    text = document(road(lanes, shape='<arc curvature="0.01"/>', profiles=hill + bank))
    meshes = load(tmp_path, text)
    marks = meshes["road mark 1"].vertices
    for number in (-1, -2):
        below = heights_below(meshes[f"driving lane 1/{number}"], marks[:, :2])
        gap = (marks[:, 2] - below)[np.isfinite(below)]
        assert len(gap) > 20
        assert 0.001 < gap.min() <= gap.max() < 0.005


def thing(kind, size, inside="", at='s="10" t="5"', more='zOffset="0.5"'):
    return (
        f'<objects><object type="{kind}" id="7" {at} {more} hdg="0" pitch="0" roll="0" {size}>'
        f"{inside}</object></objects>"
    )


def corners(kind, *points):
    return "<outline>" + "".join(f"<{kind} {point}/>" for point in points) + "</outline>"


@pytest.mark.parametrize(
    ("more", "name", "bounds"),
    [
        (
            thing("obstacle", 'length="2" width="1" height="3"'),
            "obstacle 1/7", [[9, 4.5, 0.5], [11, 5.5, 3.5]],
        ),
        (thing("pole", 'radius="0.5" height="3"'), "pole 1/7", [[9.5, 4.5, 0.5], [10.5, 5.5, 3.5]]),
        (
            thing("building", "", corners(
                "cornerLocal", 'u="0" v="0" z="0" height="4"', 'u="2" v="0" z="0" height="4"',
                'u="2" v="3" z="1" height="4"')),
            "building 1/7", [[10, 5, 0.5], [12, 8, 5.5]],
        ),
        (
            thing("trafficIsland", "", corners(
                "cornerRoad", 's="20" t="1" dz="0" height="0.1"',
                's="25" t="1" dz="0" height="0.1"', 's="25" t="3" dz="0" height="0.1"')),
            "trafficIsland 1/7", [[20, 1, 0], [25, 3, 0.1]],
        ),
        (
            thing("barrier", 'width="0.2" height="1"',
                  '<repeat s="10" length="30" distance="0" tStart="5" tEnd="6" widthStart="0.2" '
                  'widthEnd="0.2" heightStart="1" heightEnd="1" zOffsetStart="0" zOffsetEnd="0"/>'),
            "barrier 1/7", [[10, 4.9, 0], [40, 6.1, 1]],
        ),
        (
            thing("pole", 'radius="0.1" height="1"',
                  '<repeat s="10" length="30" distance="10" tStart="5" tEnd="8" heightStart="1" '
                  'heightEnd="4" zOffsetStart="0" zOffsetEnd="0"/>'),
            "pole 1/7/4", [[39.9, 7.9, 0], [40.1, 8.1, 4]],
        ),
        (
            '<objects><tunnel id="3" s="20" length="50" type="standard"/></objects>',
            "tunnel 1/3", [[20, -4.0, 0], [70, 0.5, 5]],
        ),
        (
            '<signals><signal id="9" s="50" t="-6" zOffset="2" orientation="+" type="274" '
            'country="de" height="1" width="1" dynamic="no"/></signals>',
            "traffic sign 1/9", [[49.99, -6.5, 0], [50.086, -5.5, 3]],
        ),
        (
            '<signals><signal id="9" s="50" t="-2" zOffset="5" orientation="-" type="1000001" '
            'height="0.9" width="0.3" dynamic="yes"/></signals>',
            "traffic light 1/9", [[49.875, -2.15, 5], [50.125, -1.85, 5.9]],
        ),
    ],
)  # fmt: skip
def test_objects_and_signals(tmp_path, more, name, bounds):
    meshes = load(tmp_path, document(road(more=more)))
    np.testing.assert_allclose(meshes[name].bounds, bounds, atol=1e-9)


def test_signs_face_the_traffic(tmp_path):
    for orientation, x in (("+", -1), ("-", 1)):
        signal = (
            f'<signals><signal id="9" s="50" t="-6" zOffset="2" orientation="{orientation}" '
            'type="274" country="de"/></signals>'
        )
        sign = load(tmp_path, document(road(more=signal)), materials=True)["traffic sign 1/9"]
        face = sign.faces[sign.materials.index == sign.materials.names.index("sign face")]
        a, b, c = sign.vertices[face].transpose(1, 0, 2)
        normals = np.cross(b - a, c - a)
        np.testing.assert_allclose(
            normals / np.linalg.norm(normals, axis=1)[:, None], [[x, 0, 0]] * 2, atol=1e-9
        )


def test_crosswalks_have_stripes(tmp_path):
    outline = corners(
        "cornerRoad",
        *(f's="{s}" t="{t}" dz="0"' for s, t in ((20, -4), (23, -4), (23, 4), (20, 4))),
    )
    crossing = load(tmp_path, document(road(more=thing("crosswalk", "", outline))), materials=True)
    size, _ = painted(crossing["crosswalk 1/7"])
    assert size == pytest.approx(3 * 8 / 2)
    assert crossing["crosswalk 1/7"].materials.names == ("paint white",)
    marking = (
        '<markings><marking width="0.5" color="yellow" lineLength="0.5" spaceLength="1.5" '
        'startOffset="1" '
        'stopOffset="0"><cornerReference id="0"/><cornerReference id="1"/></marking></markings>'
    )
    line = corners("cornerRoad", 's="20" t="-4" dz="0" id="0"', 's="20" t="4" dz="0" id="1"')
    crossing = load(
        tmp_path, document(road(more=thing("crosswalk", "", line + marking))), materials=True
    )
    size, _ = painted(crossing["crosswalk 1/7"])
    assert size == pytest.approx(4 * 0.25)
    assert crossing["crosswalk 1/7"].materials.names == ("paint yellow",)


@pytest.mark.parametrize("kind", ["crosswalk", "roadMark", "parkingSpace"])
@pytest.mark.parametrize(
    ("size", "expected"),
    [
        ("", None),
        ('length="3" width="8"', "paint"),
        ('length="3" width="8" height="0"', "paint"),
        ('length="3" width="0" height="0"', None),
        ('length="3" width="8" height="0.2"', "box"),
    ],
)
def test_paint_without_an_outline_is_its_area_or_a_box(tmp_path, kind, size, expected):
    mesh = load(tmp_path, document(road(more=thing(kind, size)))).get(f"{kind} 1/7")
    if expected is None or kind == "parkingSpace":
        assert mesh is None
        return
    last_stripe = 8.5 if kind == "crosswalk" and expected == "paint" else 9
    bottom, top = (0.5, 0.7) if expected == "box" else (0.503, 0.503)
    np.testing.assert_allclose(mesh.bounds, [[8.5, 1, bottom], [11.5, last_stripe, top]])
    area, _ = painted(mesh)
    assert area == pytest.approx({
        ("crosswalk", "paint"): 8 * 0.5 * 3, ("roadMark", "paint"): 8 * 3,
    }.get((kind, expected), 2 * (3 * 8 + 3 * 0.2 + 8 * 0.2)))  # fmt: skip


def test_classes_and_materials(tmp_path):
    lanes = lane(-1, width(4) + mark()) + lane(-2, width(2), "sidewalk")
    (tmp_path / "a.xodr").write_text(document(road(section(right=lanes))))
    scenario = {
        "scene": {"files": ["a.xodr"]},
        "materials": [
            {"material": "paint*", "reflectance": 0.5},
            {"objects": "*", "reflectance": "texture"},
        ],
        "cloud": {"columns": ["class", "material"]},
    }
    built = prepare(Scenario.from_data(scenario, folder=tmp_path))
    assert built.survey.classes == {11: "road surface", 64: "road mark", 65: "sidewalk"}
    assert {*built.scene.names} == {"driving lane 1/-1", "sidewalk lane 1/-2", "road mark 1"}
    assert {*built.scene.material_names} == {"asphalt", "concrete", "paint white"}
    heights = [pose.position[2] for pose in built.survey.poses]
    np.testing.assert_allclose(heights, [1, 2, 3], atol=0.01)  # above a road


@pytest.mark.parametrize(
    ("header", "note"),
    [
        ("<geoReference><![CDATA[+proj=utm +zone=32 +datum=WGS84]]></geoReference>", "EPSG:32632"),
        ("<geoReference>epsg:25833</geoReference>", "EPSG:25833"),
        ("<geoReference>+proj=tmerc +lat_0=48</geoReference>", "which was ignored"),
        (
            '<geoReference>EPSG:25833</geoReference><offset x="1000" y="-5" z="2" hdg="0"/>',
            "was not applied. To move the roads to EPSG:25833, use translation [1000, -5, 2]",
        ),
    ],
)
def test_notes_on_coordinate_systems(tmp_path, header, note):
    notes = []
    load(tmp_path, document(road(), header=f'<header revMajor="1">{header}</header>'), notes)
    assert len(notes) == 1
    assert note in notes[0]


def test_an_offset_that_the_roads_contain_is_not_advised(tmp_path):
    offset = '<offset x="691000" y="5336000" z="0" hdg="0"/>'
    header = f'<header revMajor="1"><geoReference>EPSG:25832</geoReference>{offset}</header>'
    notes = []
    load(tmp_path, document(road(at=(691_200, 5_335_500, 0)), header=header), notes)
    (note,) = notes
    assert "is already in EPSG:25832" in note
    assert "translation" not in note


@pytest.mark.skipif(find_spec("rasterio") is None, reason="rasterio is an extra")
@pytest.mark.parametrize("system", ["EPSG:3857", "+proj=merc +a=6378137 +b=6378137"])
def test_stretched_meters_are_noted_with_the_scale_that_helps(tmp_path, system):
    notes = []
    roads = road(at=(1e6, 6e6, 0))  # 47.35 degrees north
    header = f'<header revMajor="1"><geoReference><![CDATA[{system}]]></geoReference></header>'
    load(tmp_path, document(roads, header=header), notes)
    (note,) = notes
    assert "whose meter is 0.67" in note
    scale, again = re.search(r"here \(scale \[(0\.67\d+), (0\.67\d+), 1\] corrects", note).groups()
    assert scale == again and float(scale) == pytest.approx(0.678, abs=1e-3)
    assert "world.epsg" not in note


def test_unknown_elements_are_named_once(tmp_path):
    notes = []
    objects = "<objects><bridge s='1' length='2'/><bridge s='5' length='2'/></objects>"
    load(tmp_path, document(road(more=objects + "<railroad/>" + "<userData/>")), notes)
    assert [note.partition(" were skipped: ")[2] for note in notes] == ["1 railroad, 2 bridge."]


def test_what_is_left_out_is_counted_in_words(tmp_path):
    for count, words in ((1, "1 object without a size"), (3, "3 objects without a size")):
        notes = []
        things = "".join(f"<object id='{k}' s='1' t='0' type='pole'/>" for k in range(count))
        load(tmp_path, document(road(more=f"<objects>{things}</objects>")), notes)
        assert [note.partition(" were skipped: ")[2] for note in notes] == [f"{words}."]


TINY_DASHES = mark('<type name="x"><line length="1e-9" space="1e-9"/></type>', "broken")
LANES = section(right="".join(lane(-number, width(1)) for number in range(1, 101)))
BENDS = "".join(f'<laneOffset s="{s / 10}" a="0" b="0" c="0.01" d="0"/>' for s in range(700))
ENTITY = '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "c">]>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<A/>", "not an OpenDRIVE file"),
        (document(road(), header='<header revMajor="2"/>'), "OpenDRIVE 2, but only"),
        (document(road(length=-5)), "length -5, which must not be negative"),
        (document(road(length="nan")), "length 'nan', which is not a number"),
        (document(road(length="1e300")), "the road '1' with a length of 1e\\+300 m"),
        (document(road(shape="<circle/>")), "<geometry> with circle"),
        (
            document(road()).replace('length="100"', 'length="2000"', 1),
            "of 2,000 m, but its geometry ends at 100 m",
        ),
        (document(road()).replace("planView", "view"), "without geometry"),
        (document(road(shape='<arc curvature="1e99"/>')), "would unpack to"),
        (document(road(shape='<paramPoly3 pRange="normalized"/>')), "has zero length"),
        (document(road(section(right=lane(-1, width(4) + TINY_DASHES)))), "would unpack to"),
        # Its samples are more than its triangles, which would fit.
        (
            document(road(LANES, shape='<arc curvature="0.01"/>', offset=BENDS)),
            "would unpack to at least 2[67].* MiB",
        ),
        (document(road(section(right=lane(-1, width(4)) * 2))), "two lanes have the same id"),
        (document(road(section(right=lane(-1)))), "no triangles"),
        (ENTITY + "<OpenDRIVE/>", "declares the XML entity"),
        (document(road())[:-30], "is truncated: its XML ends inside an element in line"),
    ],
)  # fmt: skip
def test_broken_files(tmp_path, text, message):
    with pytest.raises(LidarError, match=message) as caught:
        load(tmp_path, text)
    assert "\n" not in str(caught.value)


def test_a_comment_before_the_declaration(tmp_path):
    assert load(tmp_path, "<!-- license -->\n" + document(road()))


def test_replaced_numbers_are_read_or_refused(tmp_path):
    lanes = section(lane(1, WIDTHS + mark(kind="broken")), lane(-1, width(3) + mark()))
    text = document(road(lanes, more=thing("pole", 'radius="0.5" height="3"')))
    spans = [match.span(1) for match in re.finditer(r'"([-\d.]+)"', text)]
    values = ("", "x", "nan", "-1", "0", "1e-12", "1e6", "1e300")
    refused = 0
    for k, (start, stop) in enumerate(spans):
        try:
            load(tmp_path, text[:start] + values[k % len(values)] + text[stop:])
        except LidarError as error:
            assert "\n" not in str(error)
            refused += 1
    assert 0.1 < refused / len(spans) < 0.8


@pytest.mark.extended
def test_garbled_files_are_read_or_refused(tmp_path):
    lanes = section(lane(1, WIDTHS + mark(kind="broken")), lane(-1, width(3) + mark()))
    text = document(road(lanes, more=thing("pole", 'radius="0.5" height="3"')))
    random = np.random.default_rng(7)
    data = np.frombuffer(text.encode(), np.uint8)
    path = tmp_path / "a.xodr"
    for _ in range(100):
        garbled = data.copy()
        places = random.integers(0, len(data), random.integers(1, 6))
        garbled[places] = random.choice(
            np.frombuffer(b'0123456789.-eE"<>/ a', np.uint8), len(places)
        )
        path.write_bytes(garbled.tobytes())
        try:
            load_meshes(path, report=[].append)
        except LidarError as error:
            assert "\n" not in str(error)
