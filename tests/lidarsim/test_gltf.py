"""glTF files: all instances and all ways to store triangles; what is not read says what it is."""

import base64
import json
import struct

import numpy as np
import pytest
from tests.meshes import write

from lidarsim import LidarError, SceneInstance
from lidarsim.scene.files import scene_graph
from lidarsim.scene.files.meshfile import load_meshes
from lidarsim.scene.transform import Transform

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()


def glb(header, body=b""):
    text = json.dumps(header).encode()
    text += b"\0" * (-len(text) % 4)  # as some programs have it; the standard has spaces
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    if body:
        chunks += struct.pack("<II", len(body), 0x004E4942) + body
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def triangle(body=CORNERS, **accessor):
    """A glTF of one node 'Sign' with a mesh 'panel' of two primitives, one triangle each."""
    primitive = {"attributes": {"POSITION": 0}}
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "Sign", "mesh": 0}],
        "meshes": [{"name": "panel", "primitives": [primitive, dict(primitive)]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"} | accessor
        ],
        "bufferViews": [{"buffer": 0, "byteLength": len(body)}],
        "buffers": [{"byteLength": len(body)}],
    }


def load(tmp_path, header, body=CORNERS):
    """Meshes in the file's own axes."""
    return load_meshes(write(tmp_path / "m.glb", glb(header, body)), up_axis="z")


def test_materials_do_not_split_objects_and_nodes_without_names_are_called_as_their_mesh(tmp_path):
    header = triangle()
    header["nodes"].append({"mesh": 0, "translation": [5, 0, 0]})
    header["scenes"][0]["nodes"] = [0, 1]
    header["extensionsRequired"] = ["KHR_materials_unlit", "EXT_texture_webp"]
    meshes = load(tmp_path, header)
    assert [(mesh.name, len(mesh.faces)) for mesh in meshes] == [("Sign", 2), ("panel", 2)]


def test_a_node_with_several_parents_stands_in_each_also_below_a_camera(tmp_path):
    header = triangle()
    header["cameras"] = [{"perspective": {"yfov": 1, "znear": 1, "aspectRatio": 1}}]
    header["nodes"] += [{"children": [0], "translation": [2 * i, 0, 0]} for i in range(4)]
    header["nodes"][1]["camera"] = 0
    header["scenes"][0]["nodes"] = [1, 2, 3, 4]
    meshes = load(tmp_path, header)
    assert [mesh.vertices[:, 0].min() for mesh in meshes] == [0, 2, 4, 6]


def test_nodes_that_contain_each_other_end(tmp_path, monkeypatch):
    monkeypatch.setattr("lidarsim.scene.files.scene_graph.MAX_NODES", 2_000)
    header = triangle()
    header["nodes"] = [{"mesh": 0, "children": [1]}, {"children": [0]}]
    with pytest.raises(LidarError, match="contain each other"):
        load(tmp_path, header)


def test_turned_and_scaled_nodes_of_a_file_without_scenes(tmp_path):
    header = triangle()
    half = np.sqrt(0.5)
    header["nodes"][0] |= {"rotation": [0, 0, half, half], "scale": [2, 2, -2]}
    header["nodes"] += [{"children": [0], "matrix": [*np.eye(4).ravel()[:12], 7, 8, 9, 1]}]
    del header["scenes"], header["scene"]
    (mesh,) = load(tmp_path, header)
    corners = mesh.vertices[mesh.faces[0]]
    np.testing.assert_allclose(corners[::-1], [[7, 8, 9], [7, 10, 9], [5, 8, 9]], atol=1e-6)


def test_a_node_scaled_to_nothing_is_skipped_and_said(tmp_path, caplog):
    header = triangle()
    header["nodes"].append({"name": "Hidden", "mesh": 0, "scale": [0, 0, 0]})
    header["scenes"][0]["nodes"] = [0, 1]
    path = write(tmp_path / "m.glb", glb(header, CORNERS))
    assert [mesh.name for mesh in load_meshes(path)] == ["Sign"]
    assert "without an area, which were skipped: Hidden" in caplog.text
    header["scenes"][0]["nodes"] = [1]
    with pytest.raises(LidarError, match="only triangles without an area"):
        load(tmp_path, header)


@pytest.mark.parametrize("mode", [5, 6])
def test_strips_and_fans(tmp_path, mode):
    order = {5: [0, 1, 3, 2], 6: [0, 1, 2, 3]}[mode]
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4")[order].tobytes()
    header = triangle(square, count=4)
    header["meshes"][0]["primitives"] = [{"attributes": {"POSITION": 0}, "mode": mode}]
    (mesh,) = load(tmp_path, header, square)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    np.testing.assert_array_equal(np.cross(b - a, c - a), [[0, 0, 1]] * 2)


def test_normalized_and_interleaved_positions(tmp_path):
    rows = np.zeros((3, 5), "<i2")
    rows[:, 2:] = [[0, 0, 0], [32767, 0, 0], [0, -32768, 0]]
    header = triangle(rows.tobytes(), componentType=5122, normalized=True, byteOffset=4)
    header["bufferViews"][0]["byteStride"] = 10
    header["extensionsRequired"] = ["KHR_mesh_quantization"]
    (mesh,) = load(tmp_path, header, rows.tobytes())
    np.testing.assert_array_equal(mesh.vertices[:3], [[0, 0, 0], [1, 0, 0], [0, -1, 0]])


@pytest.mark.parametrize("base", [True, False])
def test_sparse_positions(tmp_path, base):
    body = CORNERS + struct.pack("<2H6f", 0, 1, 1, 2, 3, 9, 8, 7)
    header = triangle(body)
    header["bufferViews"] = [
        {"buffer": 0, "byteLength": 36},
        {"buffer": 0, "byteOffset": 36, "byteLength": 4},
        {"buffer": 0, "byteOffset": 40, "byteLength": 24},
    ]
    header["accessors"][0]["sparse"] = {
        "count": 2,
        "indices": {"bufferView": 1, "componentType": 5123},
        "values": {"bufferView": 2},
    }
    if not base:
        del header["accessors"][0]["bufferView"]
    (mesh,) = load(tmp_path, header, body)
    np.testing.assert_array_equal(
        mesh.vertices[:3], [[1, 2, 3], [9, 8, 7], [0, 1, 0] if base else [0, 0, 0]]
    )


@pytest.mark.parametrize("where", ["nodes", "meshes"])
def test_morph_targets_have_their_weights(tmp_path, where):
    header = triangle()
    header["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": 0}, {"POSITION": 0}]
    header[where][0]["weights"] = [0.0, 0.5]
    (mesh,) = load(tmp_path, header)
    corners = np.frombuffer(CORNERS, "<f4").reshape(3, 3)
    np.testing.assert_array_equal(mesh.vertices, [*(1.5 * corners), *corners])


def skinned():
    """A bar of two triangles with a joint at each end; the upper one is turned by a quarter."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [1, 2, 0]], "<f4")
    joints = np.array([[0, 0, 0, 0]] * 2 + [[1, 0, 0, 0]] * 2, "u1")
    weights = np.array([[1, 0, 0, 0]] * 2 + [[1, 0, 0, 0], [0.5, 0.5, 0, 0]], "<f4")
    bound = np.tile(np.eye(4, dtype="<f4"), (2, 1, 1))
    bound[1, 3, :3] = 0, -2, 0  # columns
    faces = np.array([0, 1, 2, 1, 3, 2], "<u2")
    arrays = corners, joints, weights, bound, faces
    header = triangle(corners.tobytes())
    kinds = [(5126, "VEC3", 4), (5121, "VEC4", 4), (5126, "VEC4", 4), (5126, "MAT4", 2),
             (5123, "SCALAR", 6)]  # fmt: skip
    begins = np.cumsum([0, *(array.nbytes for array in arrays)]).tolist()
    header["bufferViews"] = [
        {"buffer": 0, "byteOffset": begin, "byteLength": array.nbytes}
        for begin, array in zip(begins, arrays, strict=False)
    ]
    header["accessors"] = [
        {"bufferView": k, "componentType": part, "type": kind, "count": count}
        for k, (part, kind, count) in enumerate(kinds)
    ]
    header["buffers"][0]["byteLength"] = begins[-1]
    turned = {"translation": [0, 2, 0], "rotation": [0, 0, 0.5**0.5, 0.5**0.5]}
    header["nodes"] = [
        {"children": [1], "translation": [10, 0, 0]},  # which does not count
        {"name": "Bar", "mesh": 0, "skin": 0, "scale": [3, 3, 3]},
        {"children": [3], "translation": [0, 0, 5]},
        turned,
    ]
    header["scenes"][0]["nodes"] = [0, 2]
    header["skins"] = [{"joints": [2, 3], "inverseBindMatrices": 3}]
    named = {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2}
    header["meshes"][0]["primitives"] = [{"attributes": named, "indices": 4}]
    return header, b"".join(array.tobytes() for array in arrays)


def test_skins_are_bent_by_their_joints_as_they_stand(tmp_path):
    header, body = skinned()
    header["animations"] = [{"channels": [], "samplers": []}]
    notes = []
    path = write(tmp_path / "m.glb", glb(header, body))
    (bar,) = load_meshes(path, up_axis="z", report=notes.append)
    # The first two follow the lower joint, the third the upper one, the last is between them.
    upper = np.array([0, 2, 5]), np.array([0, 3, 5])
    expected = [[0, 0, 5], [1, 0, 5], upper[0], (upper[1] + [1, 2, 5]) / 2]
    np.testing.assert_allclose(bar.vertices, expected, atol=1e-6)
    assert notes == [
        f"{path} has 1 animation with 1 deformed mesh. Animations are not played in the static "
        "scene. To play one, set `animation: NAME` on an actor."
    ]
    header["nodes"][3]["children"] = [2]
    with pytest.raises(LidarError, match="nodes contain each other"):
        load(tmp_path, header, body)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda h: h.update(asset={"version": "1.0"}), "glTF 1.0"),
        (lambda h: h.update(nodes={"root": {}}), "glTF 1.0"),
        (
            lambda h: h.update(extensionsRequired=["EXT_meshopt_compression"]),
            "EXT_meshopt",
        ),
        (lambda h: h["nodes"][0].update(skin=0), "skins"),
        (lambda h: h["nodes"][0].update(translation=[1e999, 0, 0]), "with a matrix"),
        (lambda h: h["nodes"][0].update(mesh=-1), "but is -1"),
        (lambda h: h["accessors"][0].update(count=9), "9 elements .* has only 36 bytes"),
        (lambda h: h["accessors"][0].update(count=-3), "but is -3"),
        (lambda h: h["accessors"][0].pop("bufferView"), "accessor 0"),
    ],
)
def test_what_cannot_be_read_says_what_it_is(tmp_path, edit, message):
    header = triangle()
    edit(header)
    with pytest.raises(LidarError, match=message):
        load(tmp_path, header)


@pytest.mark.parametrize("shared", [True, False], ids=["instances", "copies"])
def test_a_node_that_is_too_far_away_is_left_out(tmp_path, monkeypatch, shared):
    """Of instances and of copies, also where a placement moves them there."""
    monkeypatch.setattr(scene_graph, "SHARED_TRIANGLES", 1 if shared else 1000)
    header = triangle()
    header["nodes"] += [
        {"name": "Fallen", "mesh": 0, "translation": [0, -7.5e8, 0]},
        {"name": "Near", "mesh": 0, "translation": [0, 3, 0]},
    ]
    header["scenes"][0]["nodes"] = [0, 1, 2]
    notes = []
    path = write(tmp_path / "m.glb", glb(header, CORNERS))
    meshes = load_meshes(path, up_axis="z", report=notes.append)
    assert [mesh.name for mesh in meshes] == ["Sign", "Near"]
    assert all(isinstance(mesh, SceneInstance) == shared for mesh in meshes)
    assert len(notes) == 1 and "(7.5e+08 m from the origin), which were skipped: Fal" in notes[0]
    wide = Transform.from_parts(scale=3e7)
    (sign,) = load_meshes(path, up_axis="z", transform=wide, report=notes.append)
    assert sign.name == "Sign"


def hidden(visible=False):
    return {"extensions": {"KHR_node_visibility": {"visible": visible}}}


@pytest.mark.parametrize("where", ["extensionsUsed", "extensionsRequired", "nowhere"])
def test_hidden_nodes_are_left_out_with_all_below(tmp_path, where):
    """Also visible nodes below, whether the extension is used or required."""
    header = triangle()
    header["nodes"] = [
        {"name": "Sign", "mesh": 0, **hidden(True)},
        {"name": "Hidden", "mesh": 0, "children": [2, 3], **hidden()},
        {"name": "Below", "mesh": 0},
        {"name": "Group", "children": [4], **hidden(True)},
        {"name": "Deep", "mesh": 0, **hidden(True)},
        {"name": "Shown", "children": [6, 7], "translation": [5, 0, 0]},
        {"name": "Post", "mesh": 0},
        {"mesh": 0, **hidden()},
    ]
    header["scenes"][0]["nodes"] = [0, 1, 5]
    header[where] = ["KHR_node_visibility"]
    notes = []
    path = write(tmp_path / "m.glb", glb(header, CORNERS))
    meshes = load_meshes(path, up_axis="z", report=notes.append)
    assert [mesh.name for mesh in meshes] == ["Sign", "Post"]
    assert notes == [
        f"{path} has 2 hidden nodes (KHR_node_visibility). Hidden nodes and their descendants were "
        "skipped: Hidden, node 7."
    ]


def test_a_file_that_is_hidden_altogether_or_unclear_is_refused(tmp_path):
    header = triangle()
    header["nodes"][0] |= hidden()
    with pytest.raises(LidarError, match=r"no readable triangles, because it has 1 hidden node"):
        load(tmp_path, header)
    header["nodes"][0] |= hidden("no")
    with pytest.raises(LidarError, match=r"read: KHR_node_visibility\.visible"):
        load(tmp_path, header)


def test_extensions_that_are_used_and_not_read_are_noted_once(tmp_path):
    header = triangle()
    known = ["KHR_materials_ior", "KHR_lights_punctual", "KHR_xmp_json_ld", "EXT_mesh_features"]
    header["extensionsUsed"] = [*known, "MSFT_lod", "ACME_tilt", "MSFT_lod"]
    header["nodes"][0]["extensions"] = {"ACME_tilt": {}, "MSFT_lod": {"ids": [0]}}
    notes = []
    path = write(tmp_path / "m.glb", glb(header, CORNERS))
    assert len(load_meshes(path, up_axis="z", report=notes.append)) == 1
    (note,) = notes
    assert note.endswith("not supported and were ignored: MSFT_lod, ACME_tilt.")
    header["extensionsUsed"] = known
    load(tmp_path, header)
    header["meshes"][0]["primitives"] = [{"attributes": {"POSITION": 0}, "mode": 0}]
    header["extensionsUsed"] = ["KHR_gaussian_splatting"]
    with pytest.raises(LidarError, match=r"were ignored: KHR_gaussian_splat"):
        load(tmp_path, header)


def test_buffers_with_escaped_names_and_in_the_text(tmp_path):
    header = triangle()
    (tmp_path / "sub dir").mkdir()
    buffer = write(tmp_path / "sub dir" / "50%.bin", CORNERS)
    path = tmp_path / "m.gltf"
    text = base64.b64encode(CORNERS).decode()
    for name in (
        "sub%20dir/50%25.bin",
        "sub dir/50%.bin",
        f"data:application/octet-stream;base64,{text}",
    ):
        header["buffers"][0]["uri"] = name
        assert len(load_meshes(write(path, "\ufeff" + json.dumps(header)))) == 1
    header["buffers"][0]["uri"] = "sub dir/50%.bin"
    write(path, json.dumps(header))
    write(buffer, CORNERS[:-1])
    with pytest.raises(LidarError, match=r"50%.*truncated to 35"):
        load_meshes(path)
    buffer.unlink()
    with pytest.raises(LidarError, match=r"50%.*export the"):
        load_meshes(path)


@pytest.mark.parametrize(
    "uri",
    ["../a.bin", "%2e%2e/a.bin", "/etc/passwd", "file:///etc/passwd", "http://127.0.0.1:9/x", "l"],
)
def test_only_files_beside_are_read(tmp_path, uri):
    (tmp_path / "inner").mkdir()
    write(tmp_path / "a.bin", CORNERS)
    (tmp_path / "inner" / "l").symlink_to(tmp_path / "a.bin")
    header = triangle()
    header["buffers"][0]["uri"] = uri
    with pytest.raises(
        LidarError, match=r"only files in its own folder|this file to the folder of the model"
    ):
        load_meshes(write(tmp_path / "inner" / "m.gltf", json.dumps(header)))
