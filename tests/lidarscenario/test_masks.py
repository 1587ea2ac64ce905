"""Masks of transparent materials: rays pass where the image of a file lets them."""

import io
import json
import logging

import numpy as np
import pytest
import trimesh
from PIL import Image
from tests.lidarsim.test_gltf import glb
from tests.meshes import write

from lidarscenes.writers.scene_file import write_scene
from lidarsim import Actor, LidarError, Pose, Scanner, Scene, SceneInstance, SceneMesh, Sensor
from lidarsim.io import allowance
from lidarsim.scene.files.meshfile import load_meshes
from lidarsim.scene.scene_mesh import Cutout

BACKENDS = ["numpy", "tiles"]
# No row or column is another's, reversed or not.
MASK = np.array([[1, 0, 0, 1], [0, 0, 1, 1], [1, 1, 0, 1], [0, 1, 0, 0]], bool)
CORNERS = np.array([[5, -2, 2], [5, 2, 2], [5, 2, -2], [5, -2, -2]], "<f4")
UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], "<f4")
FACES = np.array([0, 1, 2, 0, 2, 3], "<u2")


def image(mask=MASK, kind="png", mode="RGBA"):
    """An image that is opaque where the mask is true."""
    alpha = Image.fromarray(np.repeat(np.repeat(mask, 8, 0), 8, 1).astype(np.uint8) * 255)
    whole = alpha
    if mode == "RGBA":
        whole = Image.new("RGB", alpha.size, (40, 200, 60))
        whole.putalpha(alpha)
    out = io.BytesIO()
    whole.save(out, kind, **({"lossless": True} if kind == "webp" else {}))
    return out.getvalue()


def card(texture=None, *, uv=UV, faces=FACES, mode=4, info=None, sampler=None, **material):
    """Header and buffer of a .glb with a card at x = 5, four meters wide and high."""
    texture = image() if texture is None else texture
    pieces = [CORNERS.tobytes(), uv.tobytes(), faces.tobytes(), texture]
    starts = np.cumsum([0, *(-(-len(piece) // 4) * 4 for piece in pieces)]).tolist()
    body = b"".join(piece + bytes(-len(piece) % 4) for piece in pieces)
    coordinates = {"float32": 5126, "uint8": 5121, "uint16": 5123}[uv.dtype.name]
    attributes = {"POSITION": 0, "TEXCOORD_0": 1}
    pbr = {"baseColorTexture": {"index": 0} | (info or {})}
    header = {
        "asset": {"version": "2.0"},
        "nodes": [{"name": "Leaves", "mesh": 0}],
        "meshes": [{"primitives": [
            {"attributes": attributes, "indices": 2, "material": 0, "mode": mode}
        ]}],
        "materials": [
            {"name": "Leaf", "alphaMode": "MASK", "pbrMetallicRoughness": pbr} | material
        ],
        "textures": [{"source": 0} | ({"sampler": 0} if sampler else {})],
        "samplers": [sampler or {}],
        "images": [{"bufferView": 3, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": coordinates, "count": 4, "type": "VEC2",
             "normalized": uv.dtype.kind == "u"},
            {"bufferView": 2, "componentType": 5123, "count": len(faces), "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": len(piece)}
            for start, piece in zip(starts, pieces, strict=False)
        ],
        "buffers": [{"byteLength": len(body)}],
    }  # fmt: skip
    return header, body


def load(path, header, body, **options):
    write(path, glb(header, body))
    return Scene.load(path, up_axis="z", **options)


def seen(scene, backend="numpy"):
    """Points of a sweep, millimeters."""
    sensor = Sensor.grid(360, 31, 60.0)
    cloud = Scanner(scene, sensor, backend=backend, precision_m=1e-4).sweep(Pose((0.0, 0.0, 0.0)))
    return np.asarray(cloud.positions, np.float64)


def check(scene, solid, stops, backend="numpy"):
    """Check that of the hits of a solid scene those remain where `stops(u, v)` says so."""
    want = seen(solid, backend)
    got = seen(scene, backend)
    u = (want[:, 1] + 2) / 4
    v = (2 - want[:, 2]) / 4
    near = np.abs(np.column_stack([u, v]) * 24 % 1 - 0.5).max(axis=1) > 0.49  # of an edge
    kept = stops(u, v) | near
    left = stops(u, v) & ~near
    found = {tuple(point) for point in got.round(3)}
    assert found <= {tuple(point) for point in want[kept].round(3)}
    assert {tuple(point) for point in want[left].round(3)} <= found
    assert 0.1 * len(want) < left.sum() < 0.9 * len(want) and len(want) > 500


def texel(u, v, mask=MASK):
    rows, columns = mask.shape
    return mask[np.floor(v * rows).astype(int) % rows, np.floor(u * columns).astype(int) % columns]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("kind", ["png", "webp"])
def test_a_card_of_leaves_lets_through_what_it_should(tmp_path, backend, kind):
    header, body = card(image(kind=kind))
    if kind == "webp":
        header["textures"] = [{"extensions": {"EXT_texture_webp": {"source": 0}}}]
    scene = load(tmp_path / "m.glb", header, body)
    solid = load(tmp_path / "m.glb", header, body, opacity="ignore")
    check(scene, solid, texel, backend)
    assert (scene.masked_objects, solid.masked_objects) == (("Leaves",), ())
    assert solid.instances is None


def continued(x, wrap):
    at = np.floor(x * 4).astype(int)
    if wrap == 33071:
        return np.clip(at, 0, 3)
    return at % 4 if wrap == 10497 else np.where(at % 8 < 4, at % 4, 3 - at % 4)


@pytest.mark.parametrize("wraps", [(10497, 10497), (33648, 33071), (33071, 33648), (33648, 33648)])
def test_what_is_beyond_the_image(tmp_path, wraps):
    header, body = card(
        uv=3 * UV - np.float32([1, 1.25]), sampler=dict(zip(("wrapS", "wrapT"), wraps, strict=True))
    )
    scene = load(tmp_path / "m.glb", header, body)

    def stops(u, v):
        return MASK[continued(3 * v - 1.25, wraps[1]), continued(3 * u - 1, wraps[0])]

    check(scene, load(tmp_path / "m.glb", header, body, opacity="ignore"), stops)


def test_a_transformed_texture(tmp_path):
    # The example of KHR_texture_transform: the lower left quarter, rotated.
    moved = {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5], "texCoord": 0}
    header, body = card(info={"texCoord": 7, "extensions": {"KHR_texture_transform": moved}})
    scene = load(tmp_path / "m.glb", header, body)
    solid = load(tmp_path / "m.glb", header, body, opacity="ignore")
    check(scene, solid, lambda u, v: texel(v / 2, 1 - u / 2))


@pytest.mark.parametrize("backend", BACKENDS)
def test_mirrored_instances_and_many_places(tmp_path, backend):
    header, body = card()
    header["nodes"] = [
        {"mesh": 0},
        {"mesh": 0, "name": "Mirrored", "translation": [-1, 0, 0], "scale": [1, -1, 1]},
        {"mesh": 0, "name": "Behind", "translation": [2, 0, 0], "scale": [1, 2, 2]},
    ]
    scene = load(tmp_path / "m.glb", header, body)
    assert len(scene.instances.mesh_parts) == 1 and len(scene.instances) == 3
    solid = load(tmp_path / "m.glb", header, body, opacity="ignore")
    want = seen(solid, backend)
    got = seen(scene, backend)
    assert set(want[:, 0].round(2)) == {4, 7}  # nearest of three, and beside it
    assert set(got[:, 0].round(2)) == {4, 5, 7}
    first = got[np.isclose(got[:, 0], 4)]
    inside = np.abs(np.column_stack([first[:, 1], first[:, 2]]) % 1 - 0.5).max(axis=1) < 0.49
    u = (2 - first[inside, 1]) / 4
    v = (2 - first[inside, 2]) / 4
    assert texel(u, v).all() and inside.sum() > 100


def test_copies_of_a_node(tmp_path):
    header, body = card()
    rows = np.array([[0, 0, 0], [0, 10, 0], [0, 20, 0]], "<f4")
    turns = np.array([[0, 0, 0, 127], [0, 0, 127, 0], [0, 0, 90, 90]], "<i1")
    start = len(body)
    body += (
        rows.tobytes() + turns.tobytes() + np.array([[1, 1, 1]] * 2 + [[0] * 3], "<f4").tobytes()
    )
    for size in (36, 12, 36):
        header["bufferViews"].append({"buffer": 0, "byteOffset": start, "byteLength": size})
        start += size
    for view, component, kind in ((4, 5126, "VEC3"), (5, 5120, "VEC4"), (6, 5126, "VEC3")):
        header["accessors"].append(
            {"bufferView": view, "componentType": component, "count": 3, "type": kind,
             "normalized": component == 5120}
        )  # fmt: skip
    header["buffers"][0]["byteLength"] = len(body)
    copies = {"EXT_mesh_gpu_instancing": {"attributes": {
        "TRANSLATION": 3, "ROTATION": 4, "SCALE": 5, "_ID": 3
    }}}  # fmt: skip
    header["nodes"] = [
        {"children": [1], "translation": [0, 0, 100]},
        {"name": "Tree", "mesh": 0, "children": [2], "extensions": copies, "scale": [2, 2, 2]},
        {"name": "Leaf", "mesh": 0},
    ]
    header["extensionsRequired"] = [*copies]
    path = write(tmp_path / "m.glb", glb(header, body))
    notes = []
    found = load_meshes(path, up_axis="z", report=notes.append)
    assert [one.name for one in found] == ["Tree", "Tree", "Leaf"]
    assert notes == [f"{path} has objects without an area, which were skipped: Tree."]
    bounds = [one.flat().bounds for one in found]
    np.testing.assert_allclose(bounds[0], [[10, -4, 96], [10, 4, 104]], atol=1e-6)
    np.testing.assert_allclose(bounds[1], [[-10, 16, 96], [-10, 24, 104]], atol=1e-6)
    np.testing.assert_allclose(bounds[2], [[10, -4, 96], [10, 4, 104]], atol=1e-6)

    header["accessors"][3]["count"] = 2
    with pytest.raises(LidarError, match=r"have \[2, 3, 3\]"):
        load(path, header, body)
    for accessor in header["accessors"][3:]:
        accessor["count"] = 1_000_000
    with pytest.raises(LidarError, match="places a mesh 1,000,000 times with EXT_mesh_gpu"):
        load(path, header, body)


GLASS = (
    "without holes, which are treated as opaque: Leaf. For glass, use "
    'Material(…, transparent="pass")'
)


@pytest.mark.parametrize(
    ("edit", "says"),
    [
        (lambda h: h["materials"][0].update(alphaMode="OPAQUE"), ""),
        (lambda h: h["materials"][0].update(alphaCutoff=0), ""),
        (lambda h: h["materials"][0].update(alphaMode="BLEND", pbrMetallicRoughness={}), ""),
        (
            lambda h: h["materials"][0].update(
                alphaMode="BLEND", pbrMetallicRoughness={"baseColorFactor": [1, 1, 1, 0.2]}
            ),
            GLASS,
        ),
        (
            lambda h: (
                h["materials"][0].update(alphaMode="BLEND"),
                h["materials"][0]["pbrMetallicRoughness"].update(baseColorFactor=[1, 1, 1, 0.4]),
            ),
            GLASS,
        ),
        (
            lambda h: h["materials"][0].update(
                alphaMode="OPAQUE",
                extensions={"KHR_materials_transmission": {"transmissionFactor": 0.9}},
            ),
            GLASS,
        ),
        (lambda h: h["images"].clear(), "Leaf (it is invalid)"),
        (lambda h: h["images"][0].update(bufferView=0), "Leaf (its image is not a PNG"),
        (lambda h: h["bufferViews"][3].update(byteLength=120), "Leaf (its image cannot be dec"),
        (lambda h: h["images"].__setitem__(0, {"uri": "x.png"}), "'x.png' does not exist"),
        (lambda h: h["images"].__setitem__(0, {"uri": "../x.png"}), "only files in its own"),
        (lambda h: h["images"].__setitem__(0, {"uri": "a\0b.png"}), "does not exist"),
        (lambda h: h["textures"][0].pop("source"), "in a format that cannot be read"),
        (lambda h: h["meshes"][0]["primitives"][0].update(material=9), ("material 9 (it is "
            "invalid)")),
        (lambda h: h["meshes"][0]["primitives"][0]["attributes"].pop("TEXCOORD_0"),
         "Leaf (texture coordinates are missing)"),
        (lambda h: h["accessors"][1].update(count=3), "coordinates are missing"),
        (lambda h: h["accessors"][1].update(type="VEC3"), "Leaf ("),
        (lambda h: h["materials"][0].update(alphaCutoff="half"), "Leaf (it is invalid)"),
        (lambda h: h["materials"][0].update(name=["\x1b[31m"]), ""),
    ],
)  # fmt: skip
def test_triangles_are_read_whatever_is_broken_in_their_material(tmp_path, caplog, edit, says):
    header, body = card()
    edit(header)
    scene = load(tmp_path / "m.glb", header, body)
    assert scene.triangles == 2
    assert (says in caplog.text) if says else not caplog.messages
    if says:
        assert not scene.masked_objects and len(caplog.messages) == 1
        assert caplog.records[0].levelno == logging.WARNING


@pytest.mark.extended
def test_an_image_beside_is_read_and_too_large_ones_are_not(tmp_path, monkeypatch, caplog):
    header, body = card()
    (tmp_path / "a b").mkdir()
    write(tmp_path / "a b" / "leaf.png", image())
    for uri in ("a%20b/leaf.png", "a b/leaf.png"):
        header["images"] = [{"uri": uri}]
        assert load(tmp_path / "m.glb", header, body).masked_objects == ("Leaves",)
    write(tmp_path / "leaf.tga", image(kind="tga"))
    header["images"] = [{"uri": "leaf.tga"}]
    assert load(tmp_path / "m.glb", header, body).masked_objects == ("Leaves",)

    def bomb(path, side):
        whole = np.zeros((side, side, 4), np.uint8)
        Image.fromarray(whole).save(path)
        return path

    header["images"] = [{"uri": bomb(tmp_path / "large.png", 3000).name}]
    monkeypatch.setattr(allowance, "MIN_LIMIT_BYTES", 1000)
    assert not load(tmp_path / "m.glb", header, body).masked_objects
    assert "Leaf (large.png has too many pixels)" in caplog.text
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    assert not load(tmp_path / "m.glb", header, body).masked_objects


def test_draco(tmp_path):
    draco = pytest.importorskip("DracoPy", reason="the decoder of packed glTF is an extra")
    packed = draco.encode(
        CORNERS, FACES.reshape(-1, 3).astype(np.uint32), tex_coord=UV.astype(np.float64)
    )
    header, body = card()
    numbers = {one["attribute_type"]: one["unique_id"] for one in draco.decode(packed).attributes}
    header["bufferViews"].append({"buffer": 0, "byteOffset": len(body), "byteLength": len(packed)})
    body += packed
    header["buffers"][0]["byteLength"] = len(body)
    header["meshes"][0]["primitives"][0]["extensions"] = {
        "KHR_draco_mesh_compression": {
            "bufferView": 4, "attributes": {"POSITION": numbers[0], "TEXCOORD_0": numbers[3]}
        }
    }  # fmt: skip
    for accessor in header["accessors"]:
        del accessor["bufferView"]
    scene = load(tmp_path / "m.glb", header, body)
    check(scene, load(tmp_path / "m.glb", header, body, opacity="ignore"), texel)


OBJ = """mtllib {library}
v 5 -2 2
v 5 2 2
v 5 2 -2
v 5 -2 -2
v 9 -2 -2
vt 0 1
vt 1 1
vt 1 0
vt 0 0
o Fence
usemtl post
f 1 2 5
usemtl wire
{face}
"""


def obj(tmp_path, material, face="f 1/1 2/2 3/3 4/4", library="m.mtl", **options):
    write(tmp_path / "m.mtl", f"newmtl post\nKd 1 1 1\nnewmtl wire\nd 0.1\n{material}\n")
    return Scene.load(write(tmp_path / "m.obj", OBJ.format(library=library, face=face)), **options)


@pytest.mark.extended(every=5)
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("lines", "face"),
    [
        ("map_d mask.png", "f 1/1 2/2 3/3 4/4"),
        ("map_Kd bark.jpg\nmap_d mask.png", "f -5/-4/1 -4/-3/1 -3/-2/1 -2/-1/1"),
        ("map_Kd leaf.png", "f 4/4 1/1 2/2\nf 4/4 2/2 3/3"),
        ("map_Kd leaf.png\nmap_d leaf.png", "f 1/1 2/2 3/3 4/4"),
        ("map_d -s 1 1 1 -o 1 0 -imfchan l -clamp off C:\\tex\\mask.png", "f 1/1 2/2 3/3 4/4"),
        ("map_d -mm 1 -1 inverse.png", "f 1/1 2/2 3/3 4/4"),
    ],
)  # fmt: skip
def test_obj(tmp_path, backend, lines, face):
    write(tmp_path / "leaf.png", image())
    write(tmp_path / "mask.png", image(mode="L"))
    write(tmp_path / "inverse.png", image(~MASK, mode="L"))
    (tmp_path / "bark.jpg").write_bytes(b"not read")
    scene, solid = (obj(tmp_path, lines, face, opacity=one) for one in ("mask", "ignore"))
    assert (scene.masked_objects, scene.names, scene.triangles) == (("Fence",), ("Fence",), 3)
    flat = [Scene.from_meshes(one.meshes()[-1:]) for one in (scene, solid)]
    check(flat[0], flat[1], texel, backend)


@pytest.mark.parametrize(
    ("lines", "face", "says"),
    [
        ("map_d gone.png", "f 1/1 2/2 3/3", "wire (its image 'gone.png' does not exist)"),
        ("map_d ../x.png", "f 1/1 2/2 3/3", "wire (takes data from '../x.png', but only"),
        ("map_d broken.png", "f 1/1 2/2 3/3", "wire (broken.png cannot be decoded)"),
        ("map_d mask.png", "f 1 2 3", "wire (texture coordinates are missing)"),
        ("map_d mask.png", "f 1/9 2/2 3/3", "wire (texture coordinates are missing)"),
        ("map_d mask.png", f"f 1/{'9' * 30} 2/-9 3/x", "wire (texture coordinates are"),
        ("map_d mask.png", "vt nan 1\nf 1/5 2/2 3/3", "wire (texture coordinates are infinite"),
        ("map_d mask.png", "vt\nf 1/5 2/2 3/3", "wire (texture coordinates are infinite"),
        ("map_d -mm x y mask.png", "f 1/1 2/2 3/3", "wire (it is invalid)"),
        ("map_Kd clear.png", "f 1/1 2/2 3/3", "treated as opaque: wire."),
        ("map_Kd photo.jpg\nmap_d photo.jpg", "f 1/1 2/2 3/3", ""),
        ("map_d", "f 1/1 2/2 3/3", ""),
    ],
)
def test_obj_with_broken_materials_is_solid(tmp_path, caplog, lines, face, says):
    write(tmp_path / "mask.png", image(mode="L"))
    write(tmp_path / "broken.png", image()[:120])
    write(tmp_path / "clear.png", image(np.zeros((2, 2), bool)))
    Image.new("RGB", (8, 8)).save(tmp_path / "photo.jpg")
    caplog.set_level(logging.WARNING)
    scene = obj(tmp_path, lines, face)
    assert (scene.triangles, scene.masked_objects) == (2, ())
    assert (says in caplog.text) if says else not caplog.messages


def test_a_library_that_is_not_there_is_told(tmp_path, caplog):
    caplog.set_level(logging.WARNING)
    assert obj(tmp_path, "", library="gone.mtl").triangles == 3
    assert "refers to materials in gone.mtl, which cannot be read" in caplog.text
    caplog.clear()
    write(tmp_path / "mask.png", image(mode="L"))
    write(tmp_path / "other.mtl", "")
    assert obj(tmp_path, "map_d mask.png", library="other.mtl m.mtl").masked_objects
    assert not caplog.messages


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply"])
def test_scenes_with_masks_are_written(tmp_path, suffix):
    uv = UV[FACES].reshape(2, 3, 2)
    corners = CORNERS.astype(np.float64)
    faces = FACES.reshape(2, 3).astype(np.int64)
    both = np.concatenate([[[0, 1, 2]], faces])
    tree = SceneMesh("Tree", corners, both, (Cutout(MASK, uv[:1]), Cutout(~MASK, uv[1:])))
    moves = [np.eye(4), np.diag([1.0, -1, 1, 1]), np.diag([-1.0, 1, 2, 1])]
    moves[1][:3, 3] = 0, 4, 1
    card = SceneMesh("Card", corners - [10, 0, 0], faces, (Cutout(MASK, uv),))
    made = Scene.from_meshes([card, *(SceneInstance(tree, move) for move in moves)])
    read = Scene.load(write_scene(tmp_path / f"m{suffix}", made))
    assert read.triangles == made.triangles
    if suffix == ".ply":
        return
    assert read.names == made.names == ("Card", "Tree", "Tree.2", "Tree.3")
    if suffix == ".glb":
        assert read.masked_objects == made.masked_objects == made.names
        np.testing.assert_allclose(seen(read), seen(made), atol=2e-4)
        assert (
            len({id(part.mask) for part in read.instances.mesh_parts if part.mask is not None}) == 2
        )
        # Another reader finds the same, Y-up.
        other = trimesh.load(tmp_path / "m.glb", force="scene")
        materials = [getattr(shape.visual, "material", None) for shape in other.geometry.values()]
        assert [getattr(one, "alphaMode", "") for one in materials].count("MASK") == 3
        low, high = made.bounds[:, [0, 2, 1]] * [1, 1, -1]
        np.testing.assert_allclose(other.bounds, np.sort([low, high], axis=0), atol=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_actors_have_opaque_and_masked_parts(backend):
    ends = np.concatenate([CORNERS, CORNERS * [-1, 1, 1]]).astype(np.float64)
    faces = np.concatenate([FACES.reshape(2, 3), FACES.reshape(2, 3) + 4]).astype(np.int64)
    uv = UV[FACES].reshape(2, 3, 2)
    mesh = SceneMesh("Tree", ends, faces, cutouts=(Cutout(np.ones((2, 2), bool), uv),))
    ground = SceneMesh("Ground", CORNERS - [0, 0, 50.0], faces[:2])
    scene = Scene.from_meshes([ground]).with_actors([Actor(mesh)])
    sensor = Sensor.grid(rays_per_revolution=4, layers=1, step_deg=90)
    found = Scanner(scene, sensor, backend=backend).ranges(Pose((0.0, 0.1, 0.2)))
    np.testing.assert_allclose(found.reshape(-1), [5, np.inf, 5, np.inf], rtol=1e-6)


def test_a_scenario_ignores_masks_if_told(tmp_path):
    from lidarscenario.prepare import prepare
    from lidarscenario.scenario import Scenario

    header, body = card()
    write(tmp_path / "m.glb", glb(header, body))
    path = tmp_path / "s.yaml"
    for opacity, masked in (("mask", ("Leaves",)), ("ignore", ())):
        write(path, json.dumps({"scene": {"files": [{"file": "m.glb", "opacity": opacity}]}}))
        assert prepare(Scenario.load(path)).scene.masked_objects == masked
    write(path, json.dumps({"scene": {"files": [{"file": "m.glb", "opacity": "glass"}]}}))
    with pytest.raises(LidarError, match="opacity"):
        Scenario.load(path)
