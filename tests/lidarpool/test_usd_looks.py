"""Colours and masks of OpenUSD scenes: what rays hit is what its materials say."""

import zipfile

import numpy as np
import pytest
from PIL import Image
from tests.lidarpool.test_usd import METRES, QUAD, prim, told, with_library, write

from lidarpool import Pose, Scanner, Scene, Sensor
from lidarpool.columns.table import COLOURS
from lidarpool.scene.colours import LINEAR, as_srgb

pytestmark = with_library

SENSOR = Sensor.grid(rays_per_revolution=4, layers=1, vertical_fov_deg=10, step_deg=90)
# Four places on the quad: lower left, lower right, upper left, upper right.
SPOTS = [(0.5, 0.75), (1.5, 0.75), (0.5, 2.25), (1.5, 2.25)]
RED, GREEN, BLUE, DARK, GREY = [200, 0, 0], [0, 200, 0], [0, 0, 200], [90, 90, 90], [188] * 3
PIXELS = np.array([[[*RED, 255], [*GREEN, 0]], [[*BLUE, 255], [*DARK, 0]]], np.uint8)
PICTURE = [BLUE, DARK, RED, GREEN]  # at the spots

BIND = 'prepend apiSchemas = ["MaterialBindingAPI"]'
ST = """texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (interpolation = "vertex")
rel material:binding = </M>
"""
IMAGE = "color3f inputs:diffuseColor.connect = </M/T.outputs:rgb>\n"
HOLES = "float inputs:opacity.connect = </M/T.outputs:a>\nfloat inputs:opacityThreshold = 0.5\n"


def material(inputs, image="", place="", name="M", kind="UsdPreviewSurface"):
    """A material whose texture T has coordinates from P, or from X, which takes them from P."""
    shaders = f"""
    token outputs:surface.connect = </{name}/S.outputs:surface>
    def Shader "S" {{
        uniform token info:id = "{kind}"
        token outputs:surface
        {inputs}
    }}
    def Shader "T" {{
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @./picture.png@
        float2 inputs:st.connect = </M/{"X" if place else "P"}.outputs:result>
        {image}
        float3 outputs:rgb
        float outputs:a
    }}
    def Shader "P" {{
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname = "st"
        float2 outputs:result
    }}
    def Shader "X" {{
        uniform token info:id = "UsdTransform2d"
        float2 inputs:in.connect = </M/P.outputs:result>
        {place}
        float2 outputs:result
    }}
    """
    return prim(name, "Material", shaders)


def seen(path, **options):
    """Colours below the spots, None where light passes; and notes."""
    objects, lines = told(path, colours=True, up_axis="z", **options)
    scanner = Scanner(Scene.from_meshes(objects), SENSOR, columns=list(COLOURS), backend="numpy")
    found = []
    for x, y in SPOTS:
        cloud = scanner.sweep(Pose((x, y, 5), pitch_deg=90))
        colour = np.stack([cloud[name] for name in COLOURS], axis=1).tolist()
        found.append(colour[0] if colour else None)
    return found, lines


@pytest.fixture
def folder(tmp_path):
    Image.fromarray(PIXELS).save(tmp_path / "picture.png")
    return tmp_path


def shifted(light):
    return as_srgb(np.clip(light, 0, 1)).tolist()


@pytest.mark.parametrize(
    ("image", "place", "expected"),
    [
        ("", "", PICTURE),
        # Half the image to the right: what is beyond repeats, is black, or goes on.
        ('token inputs:wrapS = "repeat"', "float2 inputs:translation = (0.5, 0)",
         [DARK, BLUE, GREEN, RED]),
        ("", "float2 inputs:translation = (0.5, 0)", [DARK, [0] * 3, GREEN, [0] * 3]),
        ('token inputs:wrapS = "clamp"', "float2 inputs:translation = (0.5, 0)",
         [DARK, DARK, GREEN, GREEN]),
        ('token inputs:wrapS = "mirror"', "float2 inputs:translation = (1, 0)",
         [DARK, BLUE, GREEN, RED]),
        ('token inputs:wrapS = "repeat"\ntoken inputs:wrapT = "repeat"',
         "float inputs:rotation = 90", [DARK, GREEN, BLUE, RED]),
        ('token inputs:sourceColorSpace = "raw"', "",
         [shifted(np.array(c) / 255) for c in PICTURE]),
        ("float4 inputs:scale = (0.5, 1, 1, 1)\nfloat4 inputs:bias = (0, 0.1, 0, 0)", "",
         [shifted(LINEAR[c] * [0.5, 1, 1] + [0, 0.1, 0]) for c in PICTURE]),
    ],
)  # fmt: skip
def test_images_are_where_texture_coordinates_put_them(folder, image, place, expected):
    path = write(folder / "m.usda", material(IMAGE, image, place), prim("Q", text=QUAD + ST))
    assert seen(path) == (expected, [])


def test_masks_let_light_pass(folder):
    quad = prim("Q", text=QUAD + ST, meta=BIND)
    path = write(folder / "m.usda", material(IMAGE + HOLES), quad)
    assert seen(path) == ([BLUE, None, RED, None], [])
    assert seen(path, opacity="ignore")[0] == PICTURE
    assert Scene.load(path).masked == ("Q",)  # also where no colours are asked for
    assert not Scene.load(path, opacity="ignore").instances
    glass = write(folder / "m.usda", material("float inputs:opacity = 0.2"), quad)
    assert "without holes, taken as solid: M;" in seen(glass)[1][0]


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ('= [(0.2, 0.4, 0.6)] (interpolation = "constant")', [(0.2, 0.4, 0.6)] * 4),
        ('= [(1, 0, 0), (0, 0, 1)] (interpolation = "uniform")',
         [(1, 0, 0), (1, 0, 0), (0, 0, 1), (0, 0, 1)]),
        ('= [(0, 0, 0), (0.8, 0, 0)] (interpolation = "vertex")\n'
         "int[] primvars:displayColor:indices = [0, 1, 1, 0, 1, 0]",
         [(0.2, 0, 0), (0.6, 0, 0)] * 2),
        (f"= [{'(0, 0, 0), ' * 5} (0.8, 0, 0), (0.8, 0, 0), (0, 0, 0)]"
         '(interpolation = "faceVarying")', [(0, 0, 0)] * 2 + [(0.2, 0, 0), (0.6, 0, 0)]),
    ],
)  # fmt: skip
def test_display_colours_are_linear_light(tmp_path, values, expected):
    halves = QUAD.replace("[4]", "[4, 4]").replace("[0, 1, 2, 3]", "[0, 1, 4, 5, 5, 4, 2, 3]")
    halves = halves.replace("(0, 3, 0)]", "(0, 3, 0), (2, 1.5, 0), (0, 1.5, 0)]")
    quad = prim("Q", text=halves + f"color3f[] primvars:displayColor {values}\n")
    found, lines = seen(write(tmp_path / "m.usda", quad))
    np.testing.assert_allclose(found, [shifted(light) for light in expected], atol=1)
    assert lines == []


def test_materials_of_subsets_parents_collections_and_instances(folder):
    plain = "color3f inputs:diffuseColor = (0, 1, 0)"
    halves = QUAD.replace("[4]", "[3, 3]").replace("[0, 1, 2, 3]", "[0, 1, 2, 0, 2, 3]")
    subset = prim(
        "Part", "GeomSubset",
        "uniform token elementType = \"face\"\nuniform token familyName = \"materialBind\"\n"
        "int[] indices = [1]\nrel material:binding = </G>", BIND,
    )  # fmt: skip
    two = [material(IMAGE), material(plain, name="G")]
    path = write(folder / "m.usda", *two, prim("Q", text=halves + ST + subset, meta=BIND))
    lower, upper = seen(path)[0][1], seen(path)[0][2]
    assert (lower, upper) == (DARK, [0, 255, 0])
    world = f"rel material:binding = </G>\n{prim('Q')}"
    assert seen(write(folder / "m.usda", *two, prim("W", "Xform", world, BIND)))[0][0] == upper
    bound = (
        'prepend apiSchemas = ["MaterialBindingAPI", "CollectionAPI:some"]\n) {\n'
        "rel collection:some:includes = </W/Q>\n"
        "rel material:binding:collection:some = [</W.collection:some>, </G>]\n"
    )
    text = f'def Xform "W" ({bound}{prim("Q")}}}\n'
    assert seen(write(folder / "m.usda", *two, text))[0][0] == upper
    # Instances share a mesh, and have the colours that are bound outside of them.
    write(folder / "quad.usda", prim("A", "Xform", prim("Q")), stage=METRES + '\ndefaultPrim = "A"')
    place = "double3 xformOp:translate = ({}, 0, 0)\nuniform token[] xformOpOrder = "
    place += '["xformOp:translate"]\n'
    meta = "references = @./quad.usda@\ninstanceable = true\n"
    one = prim("I", "Xform", place.format(0) + "rel material:binding = </G>", meta + BIND)
    other = prim("J", "Xform", place.format(9), meta)
    objects, _ = told(write(folder / "m.usda", *two, one, other), colours=True)
    colours = [one.colours and one.colours.images[0].ravel().tolist() for one in objects]
    assert colours == [upper, None]


def test_packed_images_and_shapes(folder):
    sphere = prim(
        "Ball", "Cube", "double size = 10\nrel material:binding = </M>", BIND
    )  # its colour is even
    red = material("color3f inputs:diffuseColor = (1, 0, 0)")
    assert seen(write(folder / "ball.usda", red, sphere))[0] == [[255, 0, 0]] * 4
    main = write(folder / "main.usda", material(IMAGE), prim("Q", text=QUAD + ST, meta=BIND))
    path = folder / "m.usdz"
    with zipfile.ZipFile(path, "w") as archive:
        for file in (main, folder / "picture.png"):
            info = zipfile.ZipInfo(file.name)  # content begins at multiples of 64 bytes
            pad = -(archive.fp.tell() + 34 + len(file.name)) % 64
            info.extra = b"\x99\x99" + pad.to_bytes(2, "little") + bytes(pad)
            archive.writestr(info, file.read_bytes())
    main.unlink(), (folder / "picture.png").unlink()
    assert seen(path) == (PICTURE, [])


@pytest.mark.parametrize(
    ("inputs", "image", "kind", "colour", "why"),
    [
        (IMAGE, "asset inputs:file = @no.png@", "UsdPreviewSurface", GREY, "'no.png' is not there"),
        (IMAGE, "asset inputs:file = @m.usda@", "UsdPreviewSurface", GREY, "is no PNG"),
        (IMAGE, "asset inputs:file = @no.png@\nfloat4 inputs:fallback = (1, 0, 0, 1)",
         "UsdPreviewSurface", [255, 0, 0], "is not there"),
        (IMAGE, "asset inputs:file = @../out.png@", "UsdPreviewSurface", GREY,
         "is not in the scene's folder, see assets in scene.files"),
        (IMAGE, "asset inputs:file = @t.<UDIM>.png@", "UsdPreviewSurface", GREY, "several tiles"),
        ("", "", "MyShader", GREY, "M (its shader is MyShader)"),
        (IMAGE.replace("T.outputs:rgb", "X.outputs:result"), "", "UsdPreviewSurface", GREY,
         "computed by UsdTransform2d"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_noted(folder, inputs, image, kind, colour, why):
    Image.fromarray(PIXELS).save(folder.parent / "out.png")
    text = material(inputs, image, kind=kind)
    if image:
        text = text.replace("asset inputs:file = @./picture.png@", "")
    path = write(folder / "m.usda", text, prim("Q", text=QUAD + ST, meta=BIND))
    found, lines = seen(path)
    assert found == [colour] * 4 and len(lines) == 1 and why in lines[0]
    assert told(path)[1] == []  # colours are not asked for
    if "out.png" in image:
        assert seen(path, assets=folder.parent) == (PICTURE, [])
