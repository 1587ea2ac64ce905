"""Colors of meshes: what a ray hits is what other programs read from the same file."""

from __future__ import annotations

import io
import logging
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from tests.lidarscenario.test_masks import card
from tests.lidarsim.test_gltf import glb
from tests.meshes import write
from trimesh.visual import TextureVisuals
from trimesh.visual.color import uv_to_color
from trimesh.visual.material import PBRMaterial

from lidarscenario.scenario import Scenario
from lidarsim import (
    Actor,
    Column,
    LidarError,
    Material,
    Noise,
    Pose,
    Returns,
    Scanner,
    Scene,
    SceneInstance,
    SceneMesh,
    Sensor,
    Track,
)
from lidarsim.columns.table import COLORS
from lidarsim.media.materials import DARKEST, reflectances
from lidarsim.scene import masks
from lidarsim.scene.colors import (
    GRAY,
    LINEAR,
    WEIGHTS,
    Colors,
    as_srgb,
    colors_summary,
    luminance,
    pack_colors,
    unpack_colors,
)

EXAMPLES = Path(__file__).parents[2] / "examples"
RNG = np.random.default_rng(7)
BLOCKS = RNG.integers(0, 256, (6, 9, 3), dtype=np.uint8)  # 32 pixels wide and high each
PICTURE = BLOCKS.repeat(32, axis=0).repeat(32, axis=1)
SENSOR = Sensor.grid(rays_per_revolution=240, layers=24, vertical_fov_deg=140)
HERE = Pose((0.3, -0.2, 1.5), yaw_deg=20)


def hills():
    """Vertices, faces and texture coordinates of a bumpy ground around the sensor."""
    at = np.linspace(-5, 5, 9)
    x, y = (a.ravel() for a in np.meshgrid(at, at))
    first = (np.arange(8)[:, None] * 9 + np.arange(8)).ravel()
    faces = np.concatenate(
        [np.stack([first, first + 1, first + 10], 1), np.stack([first, first + 10, first + 9], 1)]
    )
    vertices = np.stack([x, y, 0.3 * np.sin(x) * np.cos(y)], axis=1)
    return vertices, faces, RNG.uniform(0, 1, (81, 2))


def png(colors=PICTURE):
    out = io.BytesIO()
    Image.fromarray(colors).save(out, "png")
    return out.getvalue()


def sweep(scene, *columns, sensor=SENSOR, pose=HERE, **options):
    """A sweep, and the colors (n, 3) of its points."""
    names: list[str | Column] = [*COLORS, "triangle", *columns]
    scanner = Scanner(scene, sensor, columns=names, precision_m=1e-6, backend="numpy", **options)
    cloud = scanner.sweep(pose)
    assert len(cloud) > 500
    return cloud, np.stack([cloud[name] for name in COLORS], axis=1)


def weights(cloud, vertices, faces):
    """Barycentric coordinates (n, 3) of points, by trimesh."""
    corners = vertices[faces[cloud["triangle"]]]
    return trimesh.triangles.points_to_barycentric(corners, cloud.positions.astype(float))


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_images_are_looked_up_as_trimesh_does(tmp_path, suffix):
    vertices, faces, uv = hills()
    picture = Image.fromarray(PICTURE)
    looks = PBRMaterial(baseColorTexture=picture) if suffix == ".glb" else None
    visual = TextureVisuals(uv, material=looks, image=None if looks else picture)
    path = tmp_path / f"hills{suffix}"
    trimesh.Trimesh(vertices, faces, visual=visual, process=False).export(path)
    scene = Scene.load(path, up_axis="z", colors=True)
    assert colors_summary([scene.colors]) == "1 texture"
    cloud, found = sweep(scene)
    at = (weights(cloud, vertices, faces)[:, :, None] * uv[faces[cloud["triangle"]]]).sum(axis=1)
    # trimesh's elements are half a pixel off, which shows at the edges of blocks alone.
    assert (found == uv_to_color(at, picture)[:, :3]).all(axis=1).mean() > 0.97


@pytest.mark.parametrize("name", ["a.ply", "text.ply", "a.obj", "a.off"])
def test_colors_of_vertices_are_interpolated_in_linear_light(tmp_path, name):
    vertices, faces, _ = hills()
    colors = RNG.integers(0, 256, (81, 3), dtype=np.uint8)
    path = tmp_path / name
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)
    if name == "a.off":
        rows = [
            f"{' '.join(map(str, [*v, *c]))} 255" for v, c in zip(vertices, colors, strict=True)
        ]
        rows += [f"3 {a} {b} {c}" for a, b, c in faces]
        write(path, "\n".join([f"COFF\n81 {len(faces)} 0", *rows]))
    else:
        mesh.export(path, **({"encoding": "ascii"} if name == "text.ply" else {}))
    scene = Scene.load(path, up_axis="z", colors=True)
    assert colors_summary([scene.colors]) == "vertex colors"
    cloud, found = sweep(scene)
    light = LINEAR[colors[faces[cloud["triangle"]]]]
    want = as_srgb((weights(cloud, vertices, faces)[:, :, None] * light).sum(axis=1))
    np.testing.assert_allclose(found.astype(int), want.astype(int), atol=1)
    assert Scene.load(path, up_axis="z").colors is None  # unless asked for


PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
{0}element face 1
property list uchar int vertex_indices
end_header
"""


@pytest.mark.parametrize(
    ("kind", "rgb"),
    [
        ("obj", "255 128 0"),
        ("obj", "1 0.502 0"),
        ("uchar", "255 128 0"),
        ("ushort", "65535 32896 0"),
        ("int", "255 128 0"),
        ("float", "255 128 0"),
        ("float", "1 0.502 0"),
    ],
)
def test_colors_of_vertices_are_bytes_or_shares(tmp_path, kind, rgb):
    rows = [f"{place} {rgb}\n" for place in ("0 0 0", "1 0 0", "0 1 0")]
    if kind == "obj":
        path = tmp_path / "m.obj"
        text = "".join(f"v {row}" for row in rows) + "f 1 2 3\n"
    else:
        names = "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
        path = tmp_path / "m.ply"
        text = PLY.format(names) + "".join(rows) + "3 0 1 2\n"
    write(path, text)
    assert Scene.load(path, colors=True).colors.mean_colors().tolist() == [[255, 128, 0]]


EFFECTS = """
 <library_images><image id="i"><init_from>file:///C:/pictures/a%20b.png</init_from></image>
 </library_images>
 <library_effects>
  <effect id="e"><profile_COMMON>
   <newparam sid="f"><surface type="2D"><init_from>i</init_from></surface></newparam>
   <newparam sid="s"><sampler2D><source>f</source></sampler2D></newparam>
   <technique sid="c"><lambert><diffuse><texture texture="s" texcoord="UV"/></diffuse></lambert>
   </technique></profile_COMMON></effect>
  <effect id="plain"><profile_COMMON><technique sid="c"><phong>
   <diffuse><color>1 0.5 0 1</color></diffuse></phong></technique></profile_COMMON></effect>
 </library_effects>
 <library_materials><material id="m"><instance_effect url="#e"/></material>
  <material id="n"><instance_effect url="#plain"/></material></library_materials>"""


def test_collada_has_images_and_colors(tmp_path):
    def numbers(kind, values, width):
        text = " ".join(map(str, values.ravel().tolist()))
        return (
            f'<source id="{kind}"><float_array id="{kind}a" count="{values.size}">{text}'
            f'</float_array><technique_common><accessor source="#{kind}a" count="{len(values)}" '
            f'stride="{width}"/></technique_common></source>'
        )

    def triangles(symbol, faces):
        p = " ".join(f"{n} {n}" for n in faces.ravel())
        return (
            f'<triangles material="{symbol}" count="{len(faces)}"><input semantic="VERTEX" '
            'source="#v" offset="0"/><input semantic="TEXCOORD" source="#t" offset="1" set="0"/>'
            f"<p>{p}</p></triangles>"
        )

    vertices, faces, uv = hills()
    bound = "".join(f'<instance_material symbol="{s}" target="#{s}"/>' for s in "mn")
    write(tmp_path / "a b.png", png())
    write(
        tmp_path / "m.dae",
        '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">'
        f"<asset><up_axis>Z_UP</up_axis></asset>{EFFECTS}"
        f'<library_geometries><geometry id="g"><mesh>{numbers("p", vertices, 3)}'
        f'{numbers("t", uv, 2)}<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>'
        f"{triangles('m', faces[:64])}{triangles('n', faces[64:])}</mesh></geometry>"
        '</library_geometries><library_visual_scenes><visual_scene id="s"><node>'
        f'<instance_geometry url="#g"><bind_material><technique_common>{bound}</technique_common>'
        "</bind_material></instance_geometry></node></visual_scene></library_visual_scenes>"
        "</COLLADA>",
    )
    scene = Scene.load(tmp_path / "m.dae", colors=True)
    cloud, found = sweep(scene)
    at = (weights(cloud, vertices, faces)[:, :, None] * uv[faces[cloud["triangle"]]]).sum(axis=1)
    own = cloud["triangle"] < 64
    want = uv_to_color(at, Image.fromarray(PICTURE))[:, :3]
    assert (found == want).all(axis=1)[own].mean() > 0.97
    assert (found[~own] == [255, 128, 0]).all() and not own.all()


def opaque(texture=None, **changes):
    """Header and buffer of a card with an image of 4 x 4 blocks, without a mask."""
    header, body = card(png(BLOCKS[:4, :4]) if texture is None else texture, **changes)
    header["materials"][0].pop("alphaMode")
    return header, body


def on_card(tmp_path, header, body):
    """Colors of hits of a card, and u and v of each."""
    write(tmp_path / "m.glb", glb(header, body))
    scene = Scene.load(tmp_path / "m.glb", up_axis="z", colors=True)
    cloud, found = sweep(scene, sensor=Sensor.grid(720, 61, 60.0), pose=Pose((0.0, 0.0, 0.0)))
    return found, (cloud.positions[:, 1] + 2) / 4, (2 - cloud.positions[:, 2]) / 4


def test_factors_and_colors_of_vertices_multiply_light(tmp_path):
    header, body = opaque()
    header["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [0.5, 0.25, 1, 1]
    header["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = 3
    header["accessors"].append(
        {
            "bufferView": len(header["bufferViews"]),
            "componentType": 5126,
            "count": 4,
            "type": "VEC3",
        }
    )
    light = np.full((4, 3), [0.5, 1, 0.1], "<f4").tobytes()
    header["bufferViews"].append({"buffer": 0, "byteOffset": len(body), "byteLength": len(light)})
    header["buffers"][0]["byteLength"] += len(light)
    found, u, v = on_card(tmp_path, header, body + light)
    texels = BLOCKS[np.floor(v * 4).astype(int).clip(0, 3), np.floor(u * 4).astype(int).clip(0, 3)]
    near = np.abs(np.column_stack([u, v]) * 4 % 1 - 0.5).max(axis=1) > 0.499
    want = LINEAR[texels] * [0.25, 0.25, 0.1]
    np.testing.assert_allclose(LINEAR[found][~near], want[~near], atol=0.012)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"texture": b"junk"}, "its image is not a PNG"),
        ({"texture": png()[:300]}, "its image cannot be decoded"),
        ({"uv": np.full((4, 2), np.nan, "<f4")}, "infinite or too large"),
        ({"info": {"texCoord": 3}}, "texture coordinates are missing"),
        ({"info": {"index": 7}}, "it is invalid"),
        ({"pbrMetallicRoughness": {"baseColorFactor": "red"}}, "it is invalid"),
        ({"pbrMetallicRoughness": {"baseColorFactor": [1, 0]}}, "its factor is not red"),
        ({"pbrMetallicRoughness": 3}, "it is invalid"),
    ],
)
def test_what_cannot_be_read_is_a_note_and_gray(tmp_path, caplog, change, why):
    header, body = opaque(**change)
    with caplog.at_level(logging.WARNING):
        found, _, _ = on_card(tmp_path, header, body)
    assert why in caplog.text and "have no color: Leaf" in caplog.text
    assert (found == GRAY[0, 0]).all()


def test_files_that_name_missing_images_are_read_all_the_same(tmp_path, caplog):
    write(tmp_path / "m.mtl", "newmtl a\nmap_Kd gone.png\nnewmtl b\nKd nan 2 -1\nnewmtl c\nKd x\n")
    ground = "v -9 -9 0\nv 9 -9 0\nv 9 9 0\nv -9 9 0\nmtllib m.mtl\n"
    write(tmp_path / "m.obj", f"{ground}usemtl a\nf 1 2 3\nusemtl b\nf 1 3 4\nusemtl c\nf 3 4 1\n")
    scene = Scene.load(tmp_path / "m.obj", colors=True)
    assert "its image 'gone.png' does not exist" in caplog.text
    _, found = sweep(scene)
    assert {*map(tuple, found.tolist())} == {(188, 188, 188), (0, 255, 0)}


def test_faces_without_a_material_may_precede_those_with_one(tmp_path):
    write(tmp_path / "m.mtl", "\ufeffnewmtl b\nKd 0 1 0\n")  # as some editors begin files
    ground = "v -9 -9 0\nv 9 -9 0\nv 9 9 0\nv -9 9 0\nmtllib m.mtl\n"
    write(tmp_path / "m.obj", f"{ground}usemtl \nf 1 2 3\nusemtl b\nf 1 3 4\n")
    _, found = sweep(Scene.load(tmp_path / "m.obj", colors=True))
    assert {*map(tuple, found.tolist())} == {(188, 188, 188), (0, 255, 0)}


def test_large_images_are_made_smaller(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(masks, "MAX_SIDE_PIXELS", 36)
    header, body = opaque(png())
    write(tmp_path / "m.glb", glb(header, body))
    (picture,) = Scene.load(tmp_path / "m.glb", colors=True).colors.images
    assert picture.shape == (24, 36, 3)
    assert (
        "has images of 288 x 192 pixels, which are reduced to at most 36 pixels per side"
    ) in caplog.text


def textured():
    """A mesh of the hills with an image and colors of vertices."""
    vertices, faces, uv = hills()
    image = (RNG.random(len(faces)) < 0.3).astype(np.int32)
    corners = RNG.integers(100, 256, (len(faces), 3, 3), dtype=np.uint8)
    corners[::2] = 255
    plain = np.array([[[250, 40, 10]]], np.uint8)
    colors = Colors((PICTURE, plain), image, uv[faces].astype(np.float32), corners)
    return SceneMesh("Hills", vertices, faces, colors=colors)


def test_instances_and_actors_have_the_colors_of_their_mesh():
    mesh = textured()
    turn = trimesh.transformations.rotation_matrix(0.7, [0, 0, 1], [1, 2, 0])
    turn[:3, :3] @= np.diag([1.1, -0.9, 1.2])  # mirrored
    flat = Scene.from_meshes([SceneInstance(mesh, turn).flat()])
    cloud, want = sweep(flat)
    assert len(np.unique(want, axis=0)) > 30
    shared = Scene.from_meshes([SceneInstance(mesh, turn), SceneInstance(mesh, Pose((50, 0, 0)))])
    other, found = sweep(shared)
    np.testing.assert_array_equal(other.positions, cloud.positions)
    assert (found == want).all(axis=1).mean() > 0.99
    pose = Pose((1.0, 0.5, 0.1), 50)
    half = np.radians(25)
    way = Track([0, 10], [pose.position] * 2, [[0, 0, np.sin(half), np.cos(half)]] * 2)
    far = SceneMesh("Far", mesh.vertices, mesh.faces).affine_transform(
        "Far", np.eye(3), np.array([0, 0, -90])
    )
    moving = Scene.from_meshes([far]).with_actors([Actor(mesh, way)])
    _, want = sweep(Scene.from_meshes([SceneInstance(mesh, pose), far]))
    _, found = sweep(moving)
    assert (found == want).all(axis=1).mean() > 0.99


def test_an_image_is_sent_once_whatever_shares_it():
    mesh = textured()
    many = [SceneMesh(str(n), mesh.vertices, mesh.faces, colors=mesh.colors) for n in range(20)]
    alone, all_of = (len(pickle.dumps(Scene.from_meshes(some))) for some in (many[:1], many))
    assert all_of < 20 * alone - 15 * PICTURE.nbytes
    assert len(Scene.from_meshes(many).colors.images) == 2


def test_textures_are_the_reflectance(caplog):
    bare = SceneMesh("Bare", *hills()[:2]).affine_transform("Bare", np.eye(3), np.array([0, 9, 0]))
    scene = Scene.from_meshes([textured(), bare])
    materials = [Material("Hills", "texture", scale=0.8), Material("*", 0.4)]
    cloud, found = sweep(scene, "reflectance", "intensity", materials=materials)
    plain, _ = sweep(scene, "reflectance", materials=[Material("*", 1.0)])
    share = np.clip(0.8 * LINEAR[found] @ WEIGHTS, DARKEST, 1)
    share[cloud["object"] == 1] = 0.4
    np.testing.assert_allclose(cloud["reflectance"], share * plain["reflectance"], rtol=1e-5)
    # What has no color has the luminance of the default.
    gray, found = sweep(Scene.from_meshes([SceneMesh("Bare", *hills()[:2])]), "intensity",
                        materials=[Material("*", "texture")])  # fmt: skip
    usual, _ = sweep(Scene.from_meshes([SceneMesh("Bare", *hills()[:2])]), "intensity")
    assert (found == 188).all() and "the scene has no colors" in caplog.text
    np.testing.assert_allclose(gray["intensity"], usual["intensity"], rtol=0.01)


def test_each_sub_ray_has_the_light_of_its_own_hit():
    """Of a chequered ground, wide beams return the mean of black and white."""
    chequers = np.indices((64, 64)).sum(axis=0) % 2
    image = (chequers[..., None] * np.full(3, 255)).astype(np.uint8)
    corners = np.array([[-8, -8, 0], [8, -8, 0], [8, 8, 0], [-8, 8, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uv = (corners[faces][..., :2] / 16).astype(np.float32)
    colors = Colors((image,), np.zeros(2, np.int32), uv)
    scene = Scene.from_meshes([SceneMesh("Ground", corners, faces, colors=colors)])
    materials = [Material("*", "texture")]
    options = {"materials": materials, "pose": Pose((0.05, 0.1, 3.0))}
    one, _ = sweep(scene, "reflectance", **options)
    wide = Returns("strongest", 61, divergence_mrad=200.0)
    many, color = sweep(scene, "reflectance", returns=wide, **options)
    assert np.isin(color, [0, 255]).all()
    spread = [np.std(cloud["reflectance"][cloud["reflectance"] > 0.0]) for cloud in (one, many)]
    assert spread[1] < 0.4 * spread[0]
    # Noise of angles, and of ranges, moves hits and points.
    noisy, _ = sweep(scene, "reflectance", noise=Noise(0.05, angle_deg=0.01), **options)
    assert np.std(noisy["reflectance"]) == pytest.approx(spread[0], rel=0.1)


def test_colors_that_do_not_fit_are_refused():
    vertices, faces, _ = hills()
    for colors in (
        Colors.plain(GRAY, 3),
        Colors((GRAY,), np.ones(128, np.int32)),
        Colors((PICTURE,), np.zeros(128, np.int32)),
        Colors((PICTURE,), np.zeros(128, np.int32), np.full((128, 3, 2), np.nan, np.float32)),
        Colors((GRAY.astype(float),), np.zeros(128, np.int32)),
    ):
        with pytest.raises(LidarError, match="do not match its 128 faces"):
            SceneMesh("Hills", vertices, faces, colors=colors)


@pytest.mark.extended
@given(st.lists(st.tuples(*[st.integers(0, 255)] * 3), min_size=1, max_size=20))
def test_light_and_bytes_are_one_another(rows):
    colors = np.array(rows, np.uint8)
    np.testing.assert_array_equal(as_srgb(LINEAR[colors]), colors)
    np.testing.assert_array_equal(unpack_colors(pack_colors(colors)), colors)
    np.testing.assert_allclose(luminance(pack_colors(colors)), LINEAR[colors] @ WEIGHTS)


def test_a_material_has_the_reflectance_of_the_nearer_wavelength():
    scene = Scene.from_meshes([SceneMesh("Ground", *hills()[:2])])
    snow = Material("*", spectrum="snow, melting")
    white = Material("*", 1.0)
    for nm, share in ((850.0, 0.70), (1064.0, 0.70), (1550.0, 0.01), (1600.0, 0.01)):
        sensor = replace(SENSOR, optics=replace(SENSOR.optics, wavelength_nm=nm))
        found, full = (
            sweep(scene, "intensity", sensor=sensor, materials=[one])[0]["intensity"]
            for one in (snow, white)
        )
        np.testing.assert_allclose(found, share * full, rtol=1e-5)


def test_a_gloss_adds_to_diffuse_light_and_replaces_that_of_metals():
    scene = Scene.from_meshes([SceneMesh("Ground", *hills()[:2])])
    columns = "reflectance", Column("cosine", "float64", "", "of incidence", "cosine")

    def returned(**arguments):
        cloud, _ = sweep(scene, *columns, materials=[Material("*", **arguments)])
        return cloud["cosine"], cloud["reflectance"]

    cosine, matt = returned(reflectance=0.3)
    np.testing.assert_allclose(matt, 0.3 * cosine, rtol=1e-5)
    for roughness, metalness in ((0.2, 0.0), (0.5, 0.5), (1.0, 1.0)):
        _, found = returned(reflectance=0.3, roughness=roughness, metalness=metalness)
        # Cook and Torrance's D F G / (4 cos² θ), for light and receiver in one direction.
        a = roughness**2
        front = 0.04 * (1 - metalness) + 0.3 * metalness
        d = a**2 / (np.pi * (cosine**2 * (a**2 - 1) + 1) ** 2)
        tangent = np.sqrt(1 - cosine**2) / cosine
        g = 1 / (1 + 2 * (np.sqrt(1 + (a * tangent) ** 2) - 1) / 2)
        want = np.pi * cosine * d * front * g / (4 * cosine**2) + (1 - metalness) * matt
        np.testing.assert_allclose(found, want, rtol=1e-4)
    for wrong in ({"metalness": 0.5}, {"roughness": 0.5, "retro": True}, {"roughness": 0.0}):
        with pytest.raises(LidarError):
            Material("*", **wrong)


def test_names_of_materials_are_looked_up_and_contradictions_refused():
    for arguments, why in (
        ({"spectrum": "asfalt, dry"}, "Did you mean 'asphalt, dry'"),
        (
            {"spectrum": "Asphalt"},
            ("Available spectra: asphalt shingle, red; asphalt, dry; asphaltic"),
        ),
        ({"spectrum": "limestone rock"}, "Did you mean 'limestone'"),
        ({"spectrum": "muddy"}, "Available spectra: water, muddy.$"),
        ({"spectrum": "tar"}, "Available spectra: aluminum, weathered; asphalt"),
        (
            {"spectrum": "asphalt, dry", "reflectance": 0.2},
            ("spectrum and reflectance cannot be combined"),
        ),
        ({"reflectance": "texture", "transparent": "pass"}, "set reflectance to a number"),
        ({"scale": 2.0}, "requires reflectance: texture"),
        ({"reflectance": "textures"}, "must be a number from 0 to 1, 'texture' or None"),
    ):
        with pytest.raises(LidarError, match=why):
            Material("*", **arguments)
    with pytest.raises(LidarError, match=r"\[0\].reflectance must .* but is 'white'"):
        Scenario.from_data({"materials": [{"objects": "*", "reflectance": "white"}]})
    wrong = {"objects": "*", "spectrum": "asphalt, dry", "reflectance": 0.2}
    with pytest.raises(
        LidarError,
        match=(
            r"^scenario: materials\[1\]: spectrum and "
            r"reflectance cannot"
        ),
    ):
        Scenario.from_data({"materials": [{"objects": "*"}, wrong]})
    table = reflectances()
    assert len(table) >= 30
    assert all(0 < share < 1 for one in table.values() for share in one.shares)
    assert all(one.library and one.sample for one in table.values())
    page = (EXAMPLES.parent / "docs" / "how-to" / "materials.md").read_text("utf-8")
    for name, (shares, library, sample) in table.items():
        row = f"| `{name}` | {shares[0]:.2f} | {shares[1]:.2f} | {library}: {sample} |"
        assert row in page


def test_colors_of_vertices_with_too_few_numbers_are_a_note(tmp_path, caplog):
    header, body = opaque()
    attributes = header["meshes"][0]["primitives"][0]["attributes"]
    attributes["COLOR_0"] = attributes["TEXCOORD_0"]
    found, _, _ = on_card(tmp_path, header, body)
    assert "its COLOR_0 is not red" in caplog.text and (found == GRAY[0, 0]).all()
