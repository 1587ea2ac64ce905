"""OpenDRIVE: heights by closed forms within a millimeter, and steps of whatever is along a road."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.lidarscenario.test_opendrive import (
    document,
    lane,
    load,
    mark,
    profile,
    road,
    section,
    thing,
    width,
)

from lidarsim import LidarError
from lidarsim.scene.files.meshfile import load_meshes
from raybeam import RayCaster

LENGTH = 60.0
TOLERANCE_M = 1e-3


def cubic(tag, *coefficients, s=0, name="s"):
    """Return an element of a cubic."""
    numbers = " ".join(
        f'{key}="{value!r}"' for key, value in zip("abcd", coefficients, strict=True)
    )
    return f'<{tag} {name}="{s!r}" {numbers}/>'


def value(coefficients, x):
    return sum(c * x**power for power, c in enumerate(coefficients))


def slope(coefficients, x):
    return sum(power * c * x ** (power - 1) for power, c in enumerate(coefficients) if power)


def plan(kind, first, last, s):
    """Return x, y and headings at distances on a road that starts at the origin along x.

    `first` and `last` are the curvatures of lines, arcs and spirals, and twice the coefficients c
    and d of the offset to the left of other curves, whose lengths are integrated.
    """
    if kind in ("line", "arc", "spiral"):
        steps = np.linspace(0, LENGTH, 20_001)
        middles = (steps[1:] + steps[:-1]) / 2

        def heading(x):
            return (first + (last - first) / (2 * LENGTH) * x) * x

        x, y = (
            np.interp(s, steps, np.append(0, np.cumsum(turn(heading(middles))) * steps[1]))
            for turn in (np.cos, np.sin)
        )
        return x, y, heading(s)
    u = np.linspace(0, LENGTH * 1.01, 20_001)
    slopes = slope((0, 0, first / 2, last / 2), u)
    middles = (u[1:] + u[:-1]) / 2
    speeds = np.hypot(1, slope((0, 0, first / 2, last / 2), middles))
    u_at = np.interp(s, np.append(0, np.cumsum(speeds) * u[1]), u)
    return u_at, value((0, 0, first / 2, last / 2), u_at), np.arctan(np.interp(u_at, u, slopes))


def geometry(kind, first, last):
    """Return the element of a curve; see `plan`."""
    return {
        "line": "<line/>",
        "arc": f'<arc curvature="{first!r}"/>',
        "spiral": f'<spiral curvStart="{first!r}" curvEnd="{last!r}"/>',
        "poly3": cubic("poly3", 0.0, 0.0, first / 2, last / 2).replace(' s="0"', ""),
        "paramPoly3": f'<paramPoly3 aU="0" bU="1" cU="0" dU="0" aV="0" bV="0" cV="{first / 2!r}" '
        f'dV="{last / 2!r}" pRange="arcLength"/>',
    }[kind]


def surface(curve, elevation, roll, s, t):
    """Return points (k, 3) of a banked road in closed form."""
    x, y, heading = plan(*curve, s)
    pitch = np.arctan(slope(elevation, s))
    bank = value(roll, s)
    # To the left, level; and upright on the reference line.
    left = np.stack([-np.sin(heading), np.cos(heading), 0 * s])
    upright = np.stack(
        [-np.sin(pitch) * np.cos(heading), -np.sin(pitch) * np.sin(heading), np.cos(pitch)]
    )
    origin = np.stack([x, y, value(elevation, s)])
    return (origin + t * (np.cos(bank) * left + np.sin(bank) * upright)).T


def height_errors(meshes, points, *, up=0.5):
    """Return how far meshes are above points (k, 3), looked at from above; NaN beside them."""
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.concatenate(
        [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    )
    down = np.tile([0, 0, -1.0], (len(points), 1))
    distance = RayCaster(vertices, faces).cast(points + np.array([0, 0, up]), down).distance
    return np.where(np.isfinite(distance), up - distance, np.nan)


def lane_meshes(meshes):
    return [mesh for name, mesh in meshes.items() if " lane " in name]


coefficient = st.floats(-1, 1).map(lambda x: round(x, 3))


@pytest.mark.extended
@settings(max_examples=12)
@given(
    kind=st.sampled_from(["line", "arc", "spiral", "poly3", "paramPoly3"]),
    coefficients=st.lists(coefficient, min_size=16, max_size=16),
    seed=st.integers(0, 99),
)
def test_heights_are_those_of_the_closed_form(tmp_path_factory, kind, coefficients, seed):
    """A lane on each side; both are at most 5 m wide, and turn at a radius of 20 m or more."""
    curvatures, grade, banks, widths, offset = (
        part.tolist() for part in np.split(np.array(coefficients), [2, 5, 9, 12])
    )
    first, last = (0.05 * c for c in curvatures)
    if kind in ("poly3", "paramPoly3"):
        first, last = first / 2, last / 2000
    curve = (kind, first, last if kind != "arc" else first)
    curve = ("line", 0.0, 0.0) if kind == "line" else curve
    elevation = (7.0, 0.3 * grade[0], 0.004 * grade[1], 5e-5 * grade[2])
    roll = (0.1 * banks[0], 4e-3 * banks[1], 6e-5 * banks[2], 1e-6 * banks[3])
    lane_width = (3.5, 0.02 * widths[0], 3e-4 * widths[1], 4e-6 * widths[2])
    shift = (offset[0], 0.02 * offset[1], 3e-4 * offset[2], 4e-6 * offset[3])
    lanes = [lane(k, cubic("width", *lane_width, name="sOffset")) for k in (1, -1)]
    text = document(
        road(
            section(*lanes),
            length=LENGTH,
            shape=geometry(*curve),
            profiles=f"<elevationProfile>{cubic('elevation', *elevation)}</elevationProfile>"
            + profile(cubic("superelevation", *roll)),
            offset=cubic("laneOffset", *shift),
        )
    )
    meshes = load(tmp_path_factory.mktemp("road"), text)
    random = np.random.default_rng(seed)
    s = random.uniform(0.1, LENGTH - 0.1, 2000)
    reach = value(lane_width, s) - 0.02  # the edge is within 10 mm
    t = value(shift, s) + random.uniform(-1, 1, len(s)) * reach
    errors = height_errors(lane_meshes(meshes), surface(curve, elevation, roll, s, t))
    assert np.isfinite(errors).mean() > 0.99
    assert np.nanmax(np.abs(errors)) <= TOLERANCE_M


def test_slopes_of_curves_cost_what_they_need(tmp_path):
    """Level curves need 10 mm in plan, and parts of sloped curves shrink with slope and width."""
    counts = {}
    for grade, meters in ((0, 3.5), (0.02, 3.5), (0.2, 3.5), (0.2, 7)):
        lanes = section(lane(1, width(meters)), lane(-1, width(meters)))
        up = f"<elevationProfile>{cubic('elevation', 0.0, grade, 0.0, 0.0)}</elevationProfile>"
        text = document(road(lanes, shape='<arc curvature="0.02"/>', profiles=up))
        meshes = load(tmp_path, text)
        counts[grade, meters] = len(meshes["driving lane 1/1"].faces) // 2
    level = 100 / np.sqrt(8 * 0.01 * (50 + 3.5))  # chords of the outer edge
    assert level < counts[0, 3.5] < 1.2 * level
    assert counts[0.02, 3.5] == counts[0, 3.5]
    # The twist of the inner lane, of a width w at a radius R - w / 2, on parts of a length d.
    for meters in (3.5, 7):
        twist = 0.2 * meters / 50 / (1 - meters / 2 / 50) / 4 * 100 / TOLERANCE_M
        assert twist < counts[0.2, meters] < 1.4 * twist


STEP = 20.0


def entries(tag, before, after, name="s"):
    """Return two entries of a constant, of which the second starts at the step."""
    return cubic(tag, before, 0.0, 0.0, 0.0, name=name) + cubic(
        tag, after, 0.0, 0.0, 0.0, s=STEP, name=name
    )


def stepped(**parts):
    """Return a straight road of two lanes on the right, with parts that step at 20 m."""
    inner = parts.get("inner", width(4.0))
    outer = parts.get("outer", width(2.0))
    lanes = section(right=lane(-1, inner) + lane(-2, outer, "shoulder"))
    elevation = f"<elevationProfile>{parts.get('elevation', '')}</elevationProfile>"
    profiles = elevation + profile(parts.get("lateral", ""))
    return document(
        road(
            parts.get("sections", lanes),
            length=50,
            profiles=profiles,
            offset=parts.get("offset", ""),
            more=parts.get("more", ""),
        )
    )


def seen_from_above(meshes, x, y):
    """Return the heights and the names of the meshes at positions; NaN and None beside them."""
    names = [name for name in meshes if " lane " in name]
    starts = np.cumsum([0, *(len(meshes[name].faces) for name in names)])
    vertices = np.concatenate([meshes[name].vertices[meshes[name].faces] for name in names])
    faces = np.arange(3 * len(vertices)).reshape(-1, 3)
    x, y = np.broadcast_arrays(np.asarray(x, float), y)
    origins = np.stack([x, y, 0 * x + 50], axis=1)
    hits = RayCaster(vertices.reshape(-1, 3), faces).cast(
        origins, np.tile([0, 0, -1.0], (len(x), 1))
    )
    rows = np.searchsorted(starts, hits.triangle, "right") - 1
    heights = np.where(np.isfinite(hits.distance), 50 - hits.distance, np.nan)
    return heights, [
        names[row] if hit else None for row, hit in zip(rows, np.isfinite(heights), strict=True)
    ]


AROUND = np.array([0.1, 6.0, 15.0, STEP - 1e-3, STEP + 1e-3, 40.0])
IS_AFTER = AROUND > STEP
HEIGHTS = '<height sOffset="0" inner="0" outer="0"/><height sOffset="20" inner="1" outer="1"/>'


@pytest.mark.parametrize(
    ("parts", "before", "after"),
    [
        ({"elevation": entries("elevation", 1.0, 3.0)}, 1, 3),
        ({"lateral": entries("superelevation", 0.0, 0.1)}, 0, -1.7 * np.tan(0.1)),
        ({"lateral": entries("crossfall", 0.0, 0.1)}, 0, -1.7 * np.tan(0.1)),
        ({"inner": width(4) + HEIGHTS}, 0, 1),
        # Two pieces whose starts differ by less than what is one station.
        (
            {
                "elevation": entries("elevation", 1.0, 3.0).replace('"20.0"', '"20.0000004"'),
                "offset": entries("laneOffset", 0.0, 0.5),
            },
            1,
            3,
        ),
        ({"elevation": cubic("elevation", 1.0, 0.1, 0.0, 0.0) + cubic(
            "elevation", 1.0, 0.0, 0.0, 0.0, s=STEP)}, 1 + 0.1 * AROUND[~IS_AFTER], 1),
    ],
)  # fmt: skip
def test_heights_step_where_a_piece_starts(tmp_path, parts, before, after):
    meshes = load(tmp_path, stepped(**parts))
    heights, names = seen_from_above(meshes, AROUND, -1.7)
    assert {*names} == {"driving lane 1/-1"}
    np.testing.assert_allclose(heights[~IS_AFTER], before, atol=1e-6)
    np.testing.assert_allclose(heights[IS_AFTER], after, atol=1e-6)


@pytest.mark.extended
@pytest.mark.parametrize(
    ("parts", "before", "after"),
    [
        ({"inner": entries("width", 4.0, 1.0, name="sOffset")}, (0, 4, 6), (0, 1, 3)),
        ({"inner": entries("border", 4.0, 5.0, name="sOffset")}, (0, 4, 6), (0, 5, 7)),
        ({"offset": entries("laneOffset", 0.0, 1.5)}, (0, 4, 6), (-1.5, 2.5, 4.5)),
        ({"outer": entries("width", 2.0, 0.0, name="sOffset")}, (0, 4, 6), (0, 4, 4)),
    ],
)  # fmt: skip
def test_borders_step_where_a_piece_starts(tmp_path, parts, before, after):
    meshes = load(tmp_path, stepped(**parts))
    for x in AROUND:
        edges = -np.array(after if x > STEP else before)
        y = np.concatenate([edges + 1e-3, edges - 1e-3])
        heights, names = seen_from_above(meshes, x, y)
        lanes = [
            None
            if at > edges[0] or at < edges[2]
            else "driving lane 1/-1"
            if at > edges[1]
            else "shoulder lane 1/-2"
            for at in y
        ]
        assert names == lanes
        np.testing.assert_allclose(np.nan_to_num(heights), 0, atol=1e-9)


def test_a_step_has_a_wall(tmp_path):
    meshes = load(tmp_path, stepped(elevation=entries("elevation", 1.0, 3.0)))
    road_lane = meshes["driving lane 1/-1"]
    origins = np.array([[5, -2, z] for z in (1.01, 2, 2.99, 3.01)])
    hits = RayCaster(road_lane.vertices, road_lane.faces).cast(
        origins, np.tile([1.0, 0, 0], (4, 1))
    )
    np.testing.assert_allclose(hits.distance[:3], 15, atol=1e-6)
    assert np.isinf(hits.distance[3])
    a, b, c = road_lane.vertices[road_lane.faces[hits.triangle[:3]]].transpose(1, 0, 2)
    assert (np.cross(b - a, c - a)[:, 0] < 0).all()  # towards the lower part
    assert len(road_lane.faces) == 6
    # Where only borders step there is none.
    plain = load(tmp_path, stepped(inner=entries("width", 4.0, 1.0, name="sOffset")))
    assert len(plain["driving lane 1/-1"].faces) == 4


@pytest.mark.parametrize("start", [0.0, 20.0])
def test_a_road_steps_where_a_lane_section_starts(tmp_path, start):
    """The wall is part of the second section, whose lanes are not drawn with old offsets."""
    kerb = lane(-2, width(2) + '<height sOffset="0" inner="0.2" outer="0.2"/>', "sidewalk")
    sections = section(right=lane(-1, width(4)) + kerb) + section(
        right=lane(-1, width(4)) + kerb, s=20
    )
    text = stepped(
        sections=sections,
        elevation=entries("elevation", 1.0, 3.0).replace('"20.0"', f'"{start}"'),
        offset=entries("laneOffset", 0.0, 1.0),
    )
    meshes = load(tmp_path, text)
    heights, _ = seen_from_above(meshes, AROUND, -1.7)
    np.testing.assert_allclose(heights, np.where(start < AROUND, 3, 1), atol=1e-6)
    # Along the old border of the sidewalk nothing is above the lane of the second section.
    vertices = meshes["sidewalk lane 1/-2"].vertices
    assert vertices[vertices[:, 0] > 20.0001, 1].max() == pytest.approx(-3)
    at_step = vertices[np.abs(vertices[:, 0] - 20) < 1e-9]
    assert sorted({*at_step[:, 1].round(6)}) == [-6, -5, -4, -3]
    walls = meshes["driving lane 1/-1"]
    a, b, c = walls.vertices[walls.faces].transpose(1, 0, 2)
    steep = np.abs(np.cross(b - a, c - a)[:, 2]) < 1e-9
    assert steep.sum() == (2 if start else 0)


def test_pieces_that_start_at_the_end_change_nothing(tmp_path):
    end = entries("elevation", 0.0, 9.0).replace('"20.0"', '"50"')
    bank = entries("superelevation", 0.0, 0.3).replace('"20.0"', '"50"')
    meshes = load(tmp_path, stepped(elevation=end, lateral=bank))
    assert not meshes["driving lane 1/-1"].vertices[:, 2].any()


def test_reference_lines_step_where_their_geometries_do(tmp_path):
    """Geometries whose ends do not meet: neither is bent towards the other."""
    text = stepped().replace(
        '<geometry s="0" x="0" y="0" hdg="0" length="50"><line/></geometry>',
        '<geometry s="0" x="0" y="0" hdg="0" length="20"><line/></geometry>'
        '<geometry s="20" x="20" y="0.5" hdg="0" length="30"><line/></geometry>',
    )
    meshes = load(tmp_path, text)
    for x, shift in zip(AROUND, 0.5 * IS_AFTER, strict=True):
        _, names = seen_from_above(meshes, x, np.array([1e-3, -1e-3, -5.999, -6.001]) + shift)
        assert names == [None, "driving lane 1/-1", "shoulder lane 1/-2", None]


@pytest.mark.parametrize("kind", ["solid", "broken"])
def test_marks_step_with_the_road(tmp_path, kind):
    inner = width(4) + mark(kind=kind)
    text = stepped(inner=inner, elevation=entries("elevation", 1.0, 3.0))
    paint = load(tmp_path, text)["road mark 1"]
    assert {*paint.vertices[:, 2].round(9)} == {1.003, 3.003}
    heights = paint.vertices[paint.faces][..., 2]
    assert (heights == heights[:, :1]).all()  # none on the wall
    x = paint.vertices[:, 0]
    assert x[heights_are(paint, 1.003)].max() <= STEP <= x[heights_are(paint, 3.003)].min()
    a, b, c = paint.vertices[paint.faces].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert area == pytest.approx(0.2 * 50 if kind == "solid" else 0.2 * (5 * 3 + 3))


def heights_are(mesh, meters):
    return np.abs(mesh.vertices[:, 2] - meters) < 1e-9


def test_a_dash_over_a_step_has_two_parts(tmp_path):
    """Dashes of 3 m every 9 m: the third is from 18 m to 21 m."""
    inner = width(4) + mark(kind="broken")
    meshes = load(tmp_path, stepped(inner=inner, elevation=entries("elevation", 1.0, 3.0)))
    paint = meshes["road mark 1"]
    centers = paint.vertices[paint.faces].mean(axis=1)
    third = centers[(centers[:, 0] > 17) & (centers[:, 0] < 22)]
    assert sorted({*third[:, 2].round(6)}) == [1.003, 3.003]
    x = paint.vertices[(paint.vertices[:, 0] > 17) & (paint.vertices[:, 0] < 22), 0]
    assert sorted({*x.round(9)}) == [18, 20, 21]


REPEAT = (
    '<repeat s="0" length="50" distance="0" tStart="5" tEnd="5" widthStart="0.2" widthEnd="0.2" '
    'heightStart="1" heightEnd="1" zOffsetStart="0" zOffsetEnd="0"/>'
)


def test_rails_step_with_the_road(tmp_path):
    rail = thing("barrier", 'width="0.2" height="1"', REPEAT)
    text = stepped(elevation=entries("elevation", 1.0, 3.0), more=rail)
    mesh = load(tmp_path, text)["barrier 1/7"]
    origins = np.stack([AROUND, 0 * AROUND + 5, 0 * AROUND + 50], axis=1)
    tops = (
        50
        - RayCaster(mesh.vertices, mesh.faces).cast(origins, np.tile([0, 0, -1.0], (6, 1))).distance
    )
    np.testing.assert_allclose(tops, np.where(IS_AFTER, 4, 2), atol=1e-6)
    # Two closed solids.
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(0.2 * 1 * 50)


def test_rails_and_tunnels_keep_to_the_tolerance(tmp_path):
    """On a banked, sloped arc with a crest."""
    curve = ("arc", 0.03, 0.03)
    elevation = (0.0, 0.2, -0.004, 0.0)
    roll = (0.05, 0.001, 0.0, 0.0)
    rail = REPEAT.replace('"50"', '"60"').replace('tEnd="5"', 'tEnd="8"')
    tunnel = '<tunnel id="3" s="0" length="60" type="standard"/>'
    more = thing("barrier", 'width="0.2" height="1"', rail).replace(
        "</object>", f"</object>{tunnel}"
    )
    text = document(
        road(
            section(right=lane(-1, cubic("width", 3.0, 0.05, 0.0, 0.0, name="sOffset"))),
            length=LENGTH,
            shape=geometry(*curve),
            profiles=f"<elevationProfile>{cubic('elevation', *elevation)}</elevationProfile>"
            + profile(cubic("superelevation", *roll)),
            more=more,
        )
    )
    meshes = load(tmp_path, text)
    random = np.random.default_rng(0)
    s = random.uniform(0.1, LENGTH - 0.1, 2000)
    pitch = np.arctan(slope(elevation, s))
    _, _, heading = plan(*curve, s)
    bank = value(roll, s)
    left = np.stack([-np.sin(heading), np.cos(heading), 0 * s])
    upright = np.stack(
        [-np.sin(pitch) * np.cos(heading), -np.sin(pitch) * np.sin(heading), np.cos(pitch)]
    )
    up = (np.cos(bank) * upright - np.sin(bank) * left).T
    across = random.uniform(-0.08, 0.08, len(s))
    top = surface(curve, elevation, roll, s, 5 + 3 * s / LENGTH + across) + up
    errors = height_errors([meshes["barrier 1/7"]], top)
    assert np.isfinite(errors).mean() > 0.95
    assert np.nanmax(np.abs(errors)) <= TOLERANCE_M
    t = -3.4 - 0.05 * s + random.uniform(0.1, 0.9, len(s)) * (3.9 + 0.05 * s)
    ceiling = surface(curve, elevation, roll, s, t) + 5 * up
    errors = height_errors([meshes["tunnel 1/3"]], ceiling)
    assert np.isfinite(errors).all()
    assert np.abs(errors).max() <= TOLERANCE_M


def test_tunnels_step_and_follow_the_lanes(tmp_path):
    tunnel = '<objects><tunnel id="3" s="10" length="30" type="standard"/></objects>'
    text = stepped(
        inner=entries("width", 4.0, 6.0, name="sOffset"),
        elevation=entries("elevation", 1.0, 3.0),
        more=tunnel,
    )
    mesh = load(tmp_path, text)["tunnel 1/3"]
    for x, height, edge in ((19.99, 6, -6.5), (20.01, 8, -8.5)):
        origins = np.array(
            [[x, edge + 0.01, 50], [x, edge - 0.01, 50], [x, 0.49, 50], [x, 0.51, 50]]
        )
        down = np.tile([0, 0, -1.0], (4, 1))
        tops = 50 - RayCaster(mesh.vertices, mesh.faces).cast(origins, down).distance
        np.testing.assert_allclose(tops, [height, -np.inf] * 2, atol=1e-6)


def test_crossfall_has_its_kink_inside_a_lane(tmp_path):
    """The middle moves from one side of the reference line to the other."""
    fall = 0.05
    text = stepped(
        lateral=cubic("crossfall", fall, 0.0, 0.0, 0.0),
        offset=cubic("laneOffset", 0.0, 0.08, 0.0, 0.0),
    )
    meshes = load(tmp_path, text)
    random = np.random.default_rng(0)
    x = random.uniform(0, 50, 3000)
    y = 0.08 * x - random.uniform(0.02, 5.98, len(x))
    heights, _ = seen_from_above(meshes, x, y)
    np.testing.assert_allclose(heights, -np.abs(y) * np.tan(fall), atol=TOLERANCE_M)


def test_shapes_have_kinks_curves_and_steps_inside_a_lane(tmp_path):
    shapes = "".join(
        f'<shape s="{s}" t="{t}" a="{a}" b="{b}" c="{c}" d="{d}"/>'
        for s, t, a, b, c, d in (
            (0, -9, 0, 0.1, 0, 0), (0, -5, 0.2, 0.05, 0.06, -0.01), (0, -1, 0, 0, 0, 0),
            (50, -9, 0, 0.2, 0, 0), (50, -3, 0.2, 0.05, 0.06, -0.01),
        )
    )  # fmt: skip

    def first(t):
        x = t + 5
        middle = 0.2 + 0.05 * x + 0.06 * x**2 - 0.01 * x**3
        return np.where(t < -5, 0.1 * (t + 9), np.where(t < -1, middle, 0))

    def last(t):
        x = t + 3
        return np.where(t < -3, 0.2 * (t + 9), 0.2 + 0.05 * x + 0.06 * x**2 - 0.01 * x**3)

    meshes = load(tmp_path, stepped(lateral=shapes))
    random = np.random.default_rng(0)
    x = random.uniform(0, 50, 3000)
    y = -random.uniform(0.01, 5.99, len(x))
    y[:600] = random.choice([-5, -1, -3], 600) + random.choice([-1e-4, 1e-4], 600)
    heights, _ = seen_from_above(meshes, x, y)
    expected = first(y) + x / 50 * (last(y) - first(y))
    np.testing.assert_allclose(heights, expected, atol=TOLERANCE_M)


def test_a_shape_steps_at_a_border(tmp_path):
    """A kerb by a lateral shape, just where a lane starts."""
    shapes = '<shape s="0" t="-9" a="0.2" b="0" c="0" d="0"/><shape s="0" t="-4" a="0"/>'
    meshes = load(tmp_path, stepped(lateral=shapes))
    heights, names = seen_from_above(meshes, 25 + 0 * AROUND[:4], [-0.5, -3.999, -4.001, -5.5])
    np.testing.assert_allclose(heights, [0, 0, 0.2, 0.2], atol=1e-6)
    assert names == ["driving lane 1/-1"] * 2 + ["shoulder lane 1/-2"] * 2


def test_lanes_end_where_their_widths_turn_negative(tmp_path):
    """A width of 2 m that shrinks by 8 cm a meter, on a road of a single piece."""
    outer = cubic("width", 2.0, -0.08, 0.0, 0.0, name="sOffset")
    meshes = load(tmp_path, stepped(outer=outer))
    for x in (5, 20, 24.9, 25.1, 40):
        edge = -4 - max(2 - 0.08 * x, 0)
        _, names = seen_from_above(meshes, x, np.array([edge + 1e-3, edge - 1e-3]))
        assert names[0] == ("shoulder lane 1/-2" if x < 25 else "driving lane 1/-1")
        assert names[1] is None


def test_lanes_with_slopes_of_their_own_widen_in_parts(tmp_path):
    """A ramp across a lane that widens is a twisted surface on a straight road."""
    ramp = cubic("width", 1.0, 0.06, 0.0, 0.0, name="sOffset")
    ramp += '<height sOffset="0" inner="0" outer="0.3"/>'
    meshes = load(tmp_path, stepped(inner=ramp))
    random = np.random.default_rng(0)
    x = random.uniform(0, 50, 2000)
    share = random.uniform(0.001, 0.999, len(x))
    heights, _ = seen_from_above(meshes, x, -share * (1 + 0.06 * x))
    np.testing.assert_allclose(heights, 0.3 * share, atol=TOLERANCE_M)


def test_samples_of_large_files_are_refused_before_they_are_taken(tmp_path):
    """Thousands of pieces along many lanes: 100 times the size of the file is the limit."""
    pieces = "".join(f'<elevation s="{k / 100}" a="0" b="0" c="1e-9" d="0"/>' for k in range(1500))
    lanes = "".join(lane(-k, width(0.1)) for k in range(1, 300))
    with pytest.raises(LidarError, match="would unpack to"):
        load(tmp_path, stepped(sections=section(right=lanes), elevation=pieces))


def test_roads_that_turn_inside_their_lanes_are_read(tmp_path):
    """A lane that reaches over the center of its arc is folded, and takes no more than others."""
    lanes = section(lane(1, width(4)) + lane(2, width(6), "none"), lane(-1, width(4)))
    up = f"<elevationProfile>{cubic('elevation', 0.0, 0.05, 0.0, 0.0)}</elevationProfile>"
    text = document(road(lanes, length=12, shape='<arc curvature="0.125"/>', profiles=up))
    path = tmp_path / "a.xodr"
    path.write_text(text)
    assert sum(len(mesh.faces) for mesh in load_meshes(path, report=[].append)) < 5000


def test_a_road_continues_straight_beyond_the_end_of_its_cubic(tmp_path):
    # At a parameter of 60, the cubic has reached (27, 36), 45 m from its start.
    shape = (
        '<paramPoly3 aU="0" bU="0.45" cU="0" dU="0" aV="0" bV="0.6" cV="0" dV="0" '
        'pRange="arcLength"/>'
    )
    mesh = lane_meshes(load(tmp_path, document(road(length=60, shape=shape))))[0]
    along = mesh.vertices[:, :2] @ [0.6, 0.8]
    across = mesh.vertices[:, :2] @ [-0.8, 0.6]
    assert along.min() == pytest.approx(0, abs=TOLERANCE_M)
    assert along.max() == pytest.approx(60, abs=TOLERANCE_M)
    assert across.min() == pytest.approx(-3.5, abs=TOLERANCE_M), "the lane to the right"
    assert across.max() == pytest.approx(0, abs=TOLERANCE_M)
