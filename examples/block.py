"""Create the files for block.yaml: a city block (OpenUSD), hills (GeoTIFF) and 100 cars.

    python block.py [FOLDER]

It requires the `usd` and `geo` extras.
"""

from __future__ import annotations

import gzip
import sys
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from PIL import Image
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt
from rasterio.transform import from_origin

from lidarscenes.procedural.plants import SPECIES, tree

Array = NDArray[np.float64]

# Center of the block in EPSG:25832.
EAST = 691_000.0
NORTH = 5_334_000.0
# Dimensions of the street around the block, in meters.
HALF = 100.0
CORNER = 14.0
WIDTH = 8.0
LIFT = 0.04  # height of the street above the hills
TREES = 500
CARS = 100
SECONDS = 12
STREET_AT = 0.5  # time step of the traffic file, seconds


def height(x: Array, y: Array) -> Array:
    """Return the height of the terrain."""
    return np.asarray(512 + 1.6 * np.sin(x / 47) + 1.1 * np.cos(y / 39))


def ring(distance_m: Array, aside: Array | float = 0.0) -> tuple[Array, Array, Array]:
    """Return the x, y and heading of points on the center line in counterclockwise order."""
    straight = 2 * (HALF - CORNER)
    arc = np.pi / 2 * CORNER
    side, along_side = np.divmod(distance_m % (4 * (straight + arc)), straight + arc)
    arc_angle = np.clip((along_side - straight) / CORNER, 0, np.pi / 2)
    straight_m = np.minimum(along_side, straight) - straight / 2
    x = straight_m + (CORNER + aside) * np.sin(arc_angle)
    y = -HALF + CORNER - (CORNER + aside) * np.cos(arc_angle)
    # Each side is a rotated copy of the first side.
    angle = side * np.pi / 2
    c = np.cos(angle)
    s = np.sin(angle)
    return c * x - s * y, s * x + c * y, angle + arc_angle


LENGTH = 4 * (2 * (HALF - CORNER) + np.pi / 2 * CORNER)


def raster(path: Path) -> None:
    """Write the hills as a raster of 200 x 200 pixels with a pixel size of 2 m."""
    coordinates = np.arange(-199.0, 200, 2)
    heights = height(coordinates[None, :], coordinates[::-1, None])
    transform = from_origin(EAST - 200, NORTH + 200, 2, 2)
    with rasterio.open(
        path, "w", driver="GTiff", width=200, height=200, count=1, dtype="float32",
        crs="EPSG:25832", transform=transform, compress="deflate", predictor=3,
    ) as file:  # fmt: skip
        file.write(heights.astype("float32"), 1)


def traffic(path: Path) -> None:
    """Write vehicle positions in SUMO's format.

    Two lanes run in opposite directions, and no vehicles collide.
    """
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', "<fcd-export>"]
    cars = np.arange(CARS)
    ahead = cars % 2 == 0
    begin = (cars // 2) * LENGTH / (CARS / 2)
    speed = np.where(ahead, 1.5, -1.2)  # slow, because the traffic is dense
    for time in np.arange(0, SECONDS + STREET_AT, STREET_AT):
        lines.append(f'  <timestep time="{time:.2f}">')
        # Cars drive on the right, so cars that go counterclockwise are in the outer lane.
        x, y, yaw = ring(begin + speed * time, np.where(ahead, WIDTH / 4, -WIDTH / 4))
        yaw = np.where(ahead, yaw, yaw + np.pi)
        for car in cars:
            kind = "van" if car % 9 == 4 else "car"
            angle = (90 - np.degrees(yaw[car])) % 360
            lines.append(
                f'    <vehicle id="{kind}.{car}" x="{x[car] + EAST:.2f}" '
                f'y="{y[car] + NORTH:.2f}" angle="{angle:.2f}" type="{kind}" slope="0"/>'
            )
        lines.append("  </timestep>")
    lines.append("</fcd-export>\n")
    path.write_bytes(gzip.compress("\n".join(lines).encode(), mtime=0))


def street_image() -> Image.Image:
    """Draw 12 m of the street at 2 cm per pixel, with edge lines and a dashed center line."""
    image = np.random.default_rng(1).choice([78.0, 86.0, 94.0], (400, 600), p=[0.1, 0.8, 0.1])
    for edge in (14, 380):
        image[edge : edge + 6] = 235
    image[196:204, :200] = 235
    return Image.fromarray(image.astype(np.uint8))


def crossing_image() -> Image.Image:
    """Draw a crosswalk with stripes that are 0.5 m wide."""
    image = np.full((400, 200), 84, np.uint8)
    for begin in range(20, 380, 50):
        image[begin : begin + 25, 15:185] = 238
    return Image.fromarray(image)


def facade_image() -> Image.Image:
    """Draw a window and the surrounding wall, 3 x 3 m in total."""
    rng = np.random.default_rng(2)
    image = (
        np.array([176, 128, 100]) + rng.choice([-14, 0, 10], (150, 150, 1), p=[0.15, 0.7, 0.15])
    ).clip(0, 255)
    image[::8] = image[::8] * 0.8
    image[40:110, 45:105] = (205, 205, 200)
    image[46:104, 51:99] = (52, 66, 84)
    return Image.fromarray(image.astype(np.uint8))


class Block:
    """OpenUSD stage with meshes, textures and point instancers.

    The unit is meters, and z points up.
    """

    def __init__(self, path: Path) -> None:
        self.stage = Usd.Stage.CreateInMemory()
        self.path = path
        UsdGeom.SetStageMetersPerUnit(self.stage, 1)
        UsdGeom.SetStageUpAxis(self.stage, UsdGeom.Tokens.z)
        self.stage.SetDefaultPrim(UsdGeom.Xform.Define(self.stage, "/Block").GetPrim())

    def mesh(self, name: str, points: Array, corners: Array, uv: Array | None = None) -> Usd.Prim:
        """Add polygons (n, k) with points (p, 3), and optionally texture coordinates (p, 2)."""
        mesh = UsdGeom.Mesh.Define(self.stage, f"/Block/{name}")
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
        mesh.CreateFaceVertexIndicesAttr(corners.ravel().tolist())
        mesh.CreateFaceVertexCountsAttr([corners.shape[1]] * len(corners))
        mesh.CreateSubdivisionSchemeAttr("none")
        if uv is not None:
            st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
                "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex
            )
            st.Set(Vt.Vec2fArray.FromNumpy(uv.astype(np.float32)))
        return mesh.GetPrim()

    def color(self, prim: Usd.Prim, colors: list[tuple[float, ...]]) -> None:
        """Set the linear RGB color of a mesh, either for the whole mesh or for each polygon."""
        primvar = UsdGeom.Gprim(prim).CreateDisplayColorPrimvar(
            UsdGeom.Tokens.uniform if len(colors) > 1 else UsdGeom.Tokens.constant
        )
        table = sorted(set(colors))
        primvar.Set([Gf.Vec3f(*color) for color in table])
        primvar.SetIndices([table.index(color) for color in colors])

    def texture(self, prim: Usd.Prim, image: Image.Image, name: str) -> None:
        """Apply an image to a mesh as a texture, and save the image next to the scene."""
        image.save(self.path.with_name(name), optimize=True)
        base = f"/Block/Looks/{Path(name).stem.replace('-', '_')}"
        material = UsdShade.Material.Define(self.stage, base)
        shaders = {
            part: UsdShade.Shader.Define(self.stage, f"{base}/{part}")
            for part in ("surface", "image", "uv")
        }
        reads = {"surface": "UsdPreviewSurface", "image": "UsdUVTexture"}
        for part, shader in shaders.items():
            shader.CreateIdAttr(reads.get(part, "UsdPrimvarReader_float2"))
        shaders["uv"].CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
        shaders["image"].CreateInput("file", Sdf.ValueTypeNames.Asset).Set(f"./{name}")
        for side in ("wrapS", "wrapT"):
            shaders["image"].CreateInput(side, Sdf.ValueTypeNames.Token).Set("repeat")
        shaders["image"].CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(
            shaders["uv"].CreateOutput("result", Sdf.ValueTypeNames.Float2)
        )
        shaders["surface"].CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(
            shaders["image"].CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
        )
        material.CreateSurfaceOutput().ConnectToSource(
            shaders["surface"].CreateOutput("surface", Sdf.ValueTypeNames.Token)
        )
        UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)

    def strip(self, name: str, begin: float, end: float, step: float, lift: float) -> Usd.Prim:
        """Add a section of the street.

        The texture of `Street` repeats every 12 m.
        """
        distance_m, aside = np.meshgrid(
            np.arange(begin, end + step / 2, step), np.linspace(-WIDTH / 2, WIDTH / 2, 5),
            indexing="ij",
        )  # fmt: skip
        x, y, _ = ring(distance_m, -aside)
        points = np.stack([x, y, height(x, y) + lift], axis=-1).reshape(-1, 3)
        indices = np.arange(distance_m.size).reshape(distance_m.shape)
        corners = np.stack(
            [indices[:-1, :-1], indices[1:, :-1], indices[1:, 1:], indices[:-1, 1:]], axis=-1
        )
        length = 12.0 if name == "Street" else end - begin
        uv = np.stack([(distance_m - begin) / length, aside / WIDTH + 0.5], axis=-1).reshape(-1, 2)
        return self.mesh(name, points, corners.reshape(-1, 4), uv)


def building(corner: Array, size: Array) -> tuple[Array, Array, Array]:
    """Return the points, faces and texture coordinates of a house with a window every 3 m."""
    x, y, z = size
    outline = np.array([[0, 0], [x, 0], [x, y], [0, y], [0, 0]])
    points = []
    corners = []
    uv = []
    for side in range(4):
        a = outline[side]
        b = outline[side + 1]
        windows = round(float(np.linalg.norm(b - a)) / 3)
        first = len(points)
        points += [(*a, -4), (*b, -4), (*b, z), (*a, z)]
        uv += [(0, -4 / 3), (windows, -4 / 3), (windows, z / 3), (0, z / 3)]
        corners.append(np.arange(first, first + 4))
    first = len(points)
    points += [(*p, z) for p in outline[:4]]
    uv += [(0.02, 0.98)] * 4
    corners.append(np.arange(first, first + 4))
    return np.array(points, np.float64) + corner, np.array(corners), np.array(uv)


def block(path: Path) -> None:
    """Write the city block, with the origin at the center of the square inside the street."""
    stage = Block(path)
    stage.texture(stage.strip("Street", 0, LENGTH, 1.0, LIFT), street_image(), "block-street.png")
    for number in range(4):
        begin = number * LENGTH / 4 + 20
        crossing = stage.strip(f"Crossing_{number + 1}", begin, begin + 4, 1.0, 2 * LIFT)
        stage.texture(crossing, crossing_image(), "block-crossing.png")
    rng = np.random.default_rng(3)
    occupied = []
    for number, (x, y) in enumerate((x, y) for x in (-84, -40, 4, 56) for y in (-84, -48, 16, 60)):
        size = np.array([*(3 * rng.integers(5, 9, 2)), 3 * rng.integers(3, 7)], np.float64)
        corner = np.array([x, y, float(height(np.array(x), np.array(y)))])
        points, corners, uv = building(corner, size)
        house = stage.mesh(f"House_{number + 1}", points, corners, uv)
        stage.texture(house, facade_image(), "block-facade.png")
        occupied.append((x - 4, y - 4, x + size[0] + 4, y + size[1] + 4))
    for number, (yaw_deg, aside) in enumerate([(0, 16), (90, 20), (180, 18), (270, 22)]):
        # Houses on the other side of the street.
        points, corners, uv = building(np.zeros(3), np.array([90, 12, 9 + 3 * number]))
        angle = np.radians(yaw_deg)
        x = points[:, 0] - 45
        y = points[:, 1] - HALF - aside - 12
        points[:, 0] = np.cos(angle) * x - np.sin(angle) * y
        points[:, 1] = np.sin(angle) * x + np.cos(angle) * y
        points[:, 2] += 512
        house = stage.mesh(f"Row_{number + 1}", points, corners, uv)
        stage.texture(house, facade_image(), "block-facade.png")
    trees(stage, rng, occupied)
    stage.stage.GetRootLayer().Export(str(path))


def trees(stage: Block, rng: np.random.Generator, occupied: list[tuple[float, ...]]) -> None:
    """Add rows of trees on both sides of the street, and a park between the houses."""
    instancer = UsdGeom.PointInstancer.Define(stage.stage, "/Block/Trees")
    maple = maple_tree(stage)
    x, y = np.array(tree_positions(rng, occupied)).T
    points = np.column_stack([x, y, height(x, y)]).astype(np.float32)
    instancer.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(points))
    instancer.CreateProtoIndicesAttr([0] * TREES)
    half_yaws = rng.uniform(0, np.pi, TREES).tolist()
    instancer.CreateOrientationsAttr([Gf.Quath(np.cos(t), 0, 0, np.sin(t)) for t in half_yaws])
    sizes = rng.uniform(0.6, 1.1, TREES).tolist()
    instancer.CreateScalesAttr([Gf.Vec3f(size, size, size) for size in sizes])
    instancer.CreatePrototypesRel().SetTargets([maple.GetPath()])


def maple_tree(stage: Block) -> Usd.Prim:
    """Add the mesh of a maple with brown wood and green leaves."""
    shape = tree(next(species for species in SPECIES if species.name == "Maple"), seed=1)
    maple = stage.mesh("Trees/Maple", shape.vertices, shape.faces)
    wood = len(shape.faces) - 13 * 10 * 40
    brown = (0.10, 0.06, 0.04)
    green = (0.09, 0.22, 0.04)
    stage.color(maple, [brown] * wood + [green] * (len(shape.faces) - wood))
    return maple


def tree_positions(
    rng: np.random.Generator, occupied: list[tuple[float, ...]]
) -> list[tuple[float, float]]:
    """Return x and y of all trees, first along the street and then at random free positions."""
    distance_m = np.arange(0, LENGTH, LENGTH / 80)
    avenue = [ring(distance_m, side)[:2] for side in (WIDTH / 2 + 3.5, -WIDTH / 2 - 3.5)]
    avenue_x, avenue_y = (np.concatenate(axis) for axis in zip(*avenue, strict=True))
    positions = list(zip(avenue_x.tolist(), avenue_y.tolist(), strict=True))
    while len(positions) < TREES:
        x, y = rng.uniform(-195, 195, 2).tolist()
        inside = max(abs(x), abs(y)) < HALF - 14
        outside = max(abs(x), abs(y)) > HALF + 45
        free = not any(a < x < c and b < y < d for a, b, c, d in occupied)
        if (outside or (inside and free and abs(y) < 14)) and len(positions) < TREES:
            positions.append((x, y))
    return positions


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    raster(folder / "block-hills.tif")
    traffic(folder / "block-traffic.xml.gz")
    block(folder / "block.usdc")
