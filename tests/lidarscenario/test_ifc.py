"""IFC: places, names, classes, storeys, openings, styles and units of elements."""

import io
import subprocess
import zipfile
from contextlib import closing, contextmanager
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pytest
from tests.fork_server import IFCOPENSHELL, ForkServer

from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes.files import child_process
from lidarscenes.files import ifc as reader
from lidarsim import LidarError, Scene, SceneInstance
from lidarsim.scene.files.meshfile import load_meshes, load_objects

needs_ifcopenshell = pytest.mark.skipif(
    find_spec("ifcopenshell") is None, reason="needs ifcopenshell, an extra"
)


@pytest.fixture(scope="module")
def server():
    if find_spec("ifcopenshell") is None:
        pytest.skip("needs ifcopenshell, an extra")
    with closing(ForkServer(IFCOPENSHELL)) as server:
        yield server


@pytest.fixture
def forked(server, monkeypatch):
    """Processes of a process that has imported ifcopenshell once."""
    names = {name: getattr(subprocess, name) for name in ("DEVNULL", "PIPE")}
    monkeypatch.setattr(child_process, "subprocess", SimpleNamespace(Popen=server, **names))


class Model:
    """A building of boxes.

    Parameters
    ----------
    schema
        Version of IFC.
    prefix
        Prefix of the unit, such as MILLI; None for meters, "" for no unit at all.
    """

    def __init__(self, schema="IFC4", prefix=None):
        import ifcopenshell

        self._new_id = ifcopenshell.guid.new
        self.file = ifcopenshell.file(schema=schema)
        create = self.file.create_entity
        self.frame = create("IfcAxis2Placement3D", Location=self.point(0, 0, 0))
        self.context = create(
            "IfcGeometricRepresentationContext",
            ContextType="Model",
            CoordinateSpaceDimension=3,
            Precision=1e-5,
            WorldCoordinateSystem=self.frame,
        )
        units = [create("IfcSIUnit", UnitType="PLANEANGLEUNIT", Name="RADIAN")]
        if prefix != "":
            units.append(create("IfcSIUnit", UnitType="LENGTHUNIT", Prefix=prefix, Name="METRE"))
        self.project = self.rooted(
            "IfcProject",
            "Project",
            RepresentationContexts=[self.context],
            UnitsInContext=create("IfcUnitAssignment", Units=units),
        )
        self.site = self.rooted("IfcSite", "Site", ObjectPlacement=self.placement(0, 0, 0))
        self.building = self.rooted("IfcBuilding", "House")
        self.aggregate(self.project, self.site)
        self.aggregate(self.site, self.building)

    def rooted(self, kind, name, **attributes):
        return self.file.create_entity(kind, GlobalId=self._new_id(), Name=name, **attributes)

    def point(self, *numbers):
        return self.file.create_entity("IfcCartesianPoint", Coordinates=[*map(float, numbers)])

    def placement(self, *at, relative=None):
        frame = self.file.create_entity("IfcAxis2Placement3D", Location=self.point(*at))
        return self.file.create_entity(
            "IfcLocalPlacement", PlacementRelTo=relative, RelativePlacement=frame
        )

    def aggregate(self, whole, *parts):
        self.rooted("IfcRelAggregates", None, RelatingObject=whole, RelatedObjects=parts)

    def storey(self, name, height):
        storey = self.rooted(
            "IfcBuildingStorey", name, ObjectPlacement=self.placement(0, 0, height)
        )
        self.aggregate(self.building, storey)
        return storey

    def solid(self, *size):
        """Return a representation of a box on its lower middle."""
        create = self.file.create_entity
        profile = create(
            "IfcRectangleProfileDef",
            ProfileType="AREA",
            Position=create("IfcAxis2Placement2D", Location=self.point(0, 0)),
            XDim=float(size[0]),
            YDim=float(size[1]),
        )
        item = create(
            "IfcExtrudedAreaSolid",
            SweptArea=profile,
            Position=self.frame,
            ExtrudedDirection=create("IfcDirection", DirectionRatios=(0.0, 0.0, 1.0)),
            Depth=float(size[2]),
        )
        return create(
            "IfcShapeRepresentation",
            ContextOfItems=self.context,
            RepresentationIdentifier="Body",
            RepresentationType="SweptSolid",
            Items=[item],
        )

    def element(self, kind, name, size=(1, 1, 1), at=(0, 0, 0), storey=None, solid=None, **more):
        """Add an element: a box on a storey, or in no storey."""
        below = None if storey is None else storey.ObjectPlacement
        element = self.rooted(
            kind,
            name,
            ObjectPlacement=self.placement(*at, relative=below),
            Representation=self.file.create_entity(
                "IfcProductDefinitionShape", Representations=[solid or self.solid(*size)]
            ),
            **more,
        )
        if storey is not None and kind != "IfcOpeningElement":
            self.rooted(
                "IfcRelContainedInSpatialStructure",
                None,
                RelatedElements=[element],
                RelatingStructure=storey,
            )
        return element

    def paint(self, element, name, color, transparency=0.0):
        create = self.file.create_entity
        shading = create(
            "IfcSurfaceStyleRendering",
            SurfaceColour=create("IfcColourRgb", None, *color),
            Transparency=transparency,
            ReflectanceMethod="FLAT",
        )
        style = create("IfcSurfaceStyle", Name=name, Side="BOTH", Styles=[shading])
        (item,) = element.Representation.Representations[0].Items
        create("IfcStyledItem", Item=item, Styles=[style])

    def write(self, path):
        self.file.write(str(path))
        return path


def two_storeys():
    """Return a house of two storeys, with a door in a wall of the lower storey."""
    model = Model()
    ground = model.storey("Ground floor", 0)
    upper = model.storey("Upper floor", 3)
    model.element("IfcSlab", "Floor", (6, 4, 0.2), (0, 0, -0.2), ground)
    wall = model.element("IfcWall", "South", (6, 0.3, 3), (0, -2, 0), ground)
    opening = model.element("IfcOpeningElement", "Hole", (1, 1, 2), (1, -2, 0), ground)
    model.rooted(
        "IfcRelVoidsElement", None, RelatingBuildingElement=wall, RelatedOpeningElement=opening
    )
    door = model.element("IfcDoor", "Door", (1, 0.05, 2), (1, -2, 0))
    model.rooted(
        "IfcRelFillsElement", None, RelatingOpeningElement=opening, RelatedBuildingElement=door
    )
    model.element("IfcSpace", "Kitchen", (5, 3, 3), (0, 0, 0))
    model.element("IfcAnnotation", "Note", (1, 1, 1), (0, 0, 0), ground)
    model.element("IfcWall", "North", (6, 0.3, 2), (0, 2, 0), upper)
    model.paint(wall, "Brick", (0.6, 0.2, 0.2))
    model.paint(door, "Glass", (0.0, 0.5, 1.0), 0.9)
    return model


def named(path, **options):
    return {mesh.name: mesh for mesh in load_meshes(path, report=[].append, **options)}


@pytest.fixture(scope="module")
def house(tmp_path_factory):
    pytest.importorskip("ifcopenshell")
    return two_storeys().write(tmp_path_factory.mktemp("house") / "house.ifc")


def test_elements_are_objects_where_the_file_places_them(house, forked):
    meshes = named(house)
    assert [*meshes] == ["IfcSlab Floor", "IfcWall South", "IfcDoor Door", "IfcWall North"]
    assert meshes["IfcSlab Floor"].bounds == pytest.approx(
        np.array([(-3, -2, -0.2), (3, 2, 0)]), abs=1e-9
    )
    assert meshes["IfcWall North"].bounds == pytest.approx(
        np.array([(-3, 1.85, 3), (3, 2.15, 5)]), abs=1e-9
    )


def test_openings_are_cut_out_of_walls(house, forked):
    wall = named(house)["IfcWall South"]
    a, b, c = (wall.vertices[wall.faces[:, k]] for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(0.3 * (6 * 3 - 1 * 2))


def test_storeys_are_selected_by_name(house, forked, tmp_path):
    lower = named(house, storeys=["Ground floor"])
    assert [*lower] == ["IfcSlab Floor", "IfcWall South", "IfcDoor Door"]  # the door by its hole
    scene = Scene.load(house, storeys=["Upper floor"])
    assert scene.names == ("IfcWall North",)
    with pytest.raises(
        LidarError, match=r"has no storey 'Attic'\. Its storeys are 'Ground floor', 'Upper floor'"
    ):
        Scene.load(house, storeys=["Upper floor", "Attic"])
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(LidarError, match=r"storeys \(an option of \.ifc \.ifczip\)\. Remove"):
        Scene.load(tmp_path / "a.obj", storeys=["Upper floor"])


def test_a_scenario_takes_a_storey_and_has_classes(house, forked):
    data = {
        "scene": {"files": [{"file": str(house), "storeys": ["Ground floor"]}]},
        "sensor": {"model": "velodyne/vlp16"},
        "poses": [[0, 0, 1.5]],
        "cloud": {"columns": ["class"]},
    }
    built = prepare(Scenario.from_data(data))
    assert built.scene.names == ("IfcSlab Floor", "IfcWall South", "IfcDoor Door")
    assert built.survey.classes == {73: "wall", 74: "slab", 78: "door"}


def test_styles_are_colors_and_materials(house, forked):
    notes = []
    objects = load_objects(house, colors=True, materials=True, report=notes.append)
    meshes = {mesh.name: mesh for mesh in objects.static}
    wall = meshes["IfcWall South"]
    assert wall.materials.names == ("Brick",)
    assert wall.colors.images[0].tolist() == [[[153, 51, 51]]]
    assert meshes["IfcSlab Floor"].colors is None
    [note] = notes
    assert "has transparent materials without holes, which are treated as opaque: Glass" in note


@pytest.mark.parametrize(("schema", "prefix", "unit_m"), [
    ("IFC2X3", "MILLI", 1e-3), ("IFC4", None, 1), ("IFC4X3_ADD2", "DECI", 0.1), ("IFC4", "", 1),
])  # fmt: skip
def test_units_are_those_of_the_project(forked, tmp_path, schema, prefix, unit_m):
    model = Model(schema, prefix)
    wall = model.element("IfcWall", "W", (2 / unit_m, 1, 1), (5 / unit_m, 0, 0))
    material = model.file.create_entity("IfcMaterial", Name="Concrete")
    model.rooted("IfcRelAssociatesMaterial", None, RelatedObjects=[wall], RelatingMaterial=material)
    notes = []
    path = model.write(tmp_path / "a.ifc")
    (mesh,) = load_meshes(path, materials=True, report=notes.append)
    assert mesh.bounds[:, 0] == pytest.approx([4, 6])
    assert mesh.materials.names == ("Concrete",)
    assert ["does not specify a length unit" in note for note in notes] == [True] * (prefix == "")


@pytest.mark.parametrize(
    ("east", "north", "is_placed"),
    [(691_000, 5_336_000, True), (690_100, 5_337_500, True), (0, 0, False), (691_000, 0, False)],
)
@pytest.mark.parametrize(("unit", "unit_m"), [("METRE", 1.0), (None, 0.001)])
def test_a_map_conversion_of_a_placed_building_is_not_advised(
    forked, tmp_path, east, north, is_placed, unit, unit_m
):
    model = Model(prefix="MILLI")
    model.element("IfcWall", "W", at=(1000 * east, 1000 * north, 500_000))
    create = model.file.create_entity
    stated = unit and create("IfcSIUnit", UnitType="LENGTHUNIT", Name=unit)
    create(
        "IfcMapConversion",
        SourceCRS=model.context,
        TargetCRS=create("IfcProjectedCRS", Name="EPSG:25832", MapUnit=stated),
        Eastings=691_000.0 / unit_m,
        Northings=5_336_000.0 / unit_m,
        OrthogonalHeight=500.0 / unit_m,
        Scale=0.001 if unit else None,
    )
    notes = []
    load_meshes(model.write(tmp_path / "a.ifc"), report=notes.append)
    (note,) = notes
    assert ("is already in EPSG:25832" in note) == is_placed
    assert ("use translation [691000, 5336000, 500]" in note) != is_placed
    assert ("must not be applied again" in note) == is_placed


def test_a_map_conversion_is_noted_and_not_applied(forked, tmp_path):
    model = Model(prefix="MILLI")
    model.element("IfcWall", "W")
    create = model.file.create_entity
    system = create(
        "IfcProjectedCRS",
        Name="EPSG:25832",
        MapUnit=create("IfcSIUnit", UnitType="LENGTHUNIT", Name="METRE"),
    )
    conversion = create(
        "IfcMapConversion",
        SourceCRS=model.context,
        TargetCRS=system,
        Eastings=691000.5,
        Northings=5336000.25,
        OrthogonalHeight=500.0,
        XAxisAbscissa=0.0,
        XAxisOrdinate=1.0,
        Scale=0.001,
    )
    path = tmp_path / "a.ifc"
    notes = []
    load_meshes(model.write(path), report=notes.append)
    assert notes == [
        f"{path} contains a map conversion, which was not applied. To move the building to "
        "EPSG:25832, use translation [691000.5, 5336000.25, 500] and rotation_deg [0, 0, 90]."
    ]
    system.Name = "EPSG:3857"
    load_meshes(model.write(path), report=notes.append)
    if find_spec("rasterio") is not None:
        assert "to EPSG:3857, whose meter is 0.72" in notes[1]
        assert "long on the ground here, unlike the meter of the building, use" in notes[1]
    system.Name = "EPSG:25832"
    del notes[1]
    conversion.Scale = 0.5
    load_meshes(model.write(path), report=notes.append)
    assert notes[1].endswith(
        "cannot be used because its scale, 500, is not consistent with its units."
    )
    model.file.remove(conversion)
    model.site.RefLatitude = (48, 8, 15, 600_000)
    model.site.RefLongitude = (-11, -34, -30, -600_000)
    load_meshes(model.write(path), report=notes.append)
    assert notes[2].endswith("a site position, 48.1377° N, 11.5752° W, which was ignored.")


def with_map_sets(model, owner, system, conversion, names=("ePSet_MapConversion",)):
    """Add the property sets of a map conversion to an object."""
    create = model.file.create_entity
    for name, values in ((names[0], conversion), ("ePset_ProjectedCRS", system)):
        properties = [
            create(
                "IfcPropertySingleValue",
                Name=key,
                NominalValue=create("IfcLabel" if isinstance(value, str) else "IfcReal", value),
            )
            for key, value in values.items()
        ]
        group = model.rooted("IfcPropertySet", name, HasProperties=properties)
        model.rooted(
            "IfcRelDefinesByProperties",
            None,
            RelatedObjects=[owner],
            RelatingPropertyDefinition=group,
        )


def map_note(model, path):
    notes = []
    model.element("IfcWall", "W")
    load_meshes(model.write(path), report=notes.append)
    (note,) = notes
    return note.removeprefix(f"{path} ")


PLACE = {"Eastings": 2_600_000.0, "Northings": 1_200_000.0, "OrthogonalHeight": 500.0}


@needs_ifcopenshell
@pytest.mark.parametrize(("schema", "prefix", "unit", "scale", "translation"), [
    ("IFC2X3", "MILLI", "METRE", {}, "[2600000, 1200000, 500]"),
    ("IFC2X3", "MILLI", "METRE", {"Scale": 0.001}, "[2600000, 1200000, 500]"),
    ("IFC2X3", "MILLI", None, {"Scale": 0.001}, "[2600000, 1200000, 500]"),
    ("IFC2X3", "MILLI", None, {}, "[2600, 1200, 0.5]"),
    ("IFC2X3", "MILLI", "MILLIMETRE", {}, "[2600, 1200, 0.5]"),
    ("IFC2X3", None, "US survey foot", {}, "[792481.584963, 365760.731521, 152.400305]"),
    ("IFC4", "MILLI", "meter", {"Scale": 0.001}, "[2600000, 1200000, 500]"),
])  # fmt: skip
def test_the_map_unit_of_property_sets_counts(
    forked, tmp_path, schema, prefix, unit, scale, translation
):
    model = Model(schema, prefix)
    system = {"Name": "EPSG:2056"} | ({"MapUnit": unit} if unit else {})
    with_map_sets(model, model.project, system, PLACE | scale)
    note = map_note(model, tmp_path / "a.ifc")
    assert (
        "To move the building to EPSG:2056" in note and f", use translation {translation}" in note
    )


@needs_ifcopenshell
@pytest.mark.parametrize("name", ["ePSet_MapConversion", "EPset_MapConversion"])
@pytest.mark.parametrize("owner", ["project", "site", "building"])
def test_property_sets_of_a_map_are_found_wherever_they_are(forked, tmp_path, owner, name):
    model = Model("IFC2X3")
    numbers = {key: str(value) for key, value in PLACE.items()}
    with_map_sets(model, getattr(model, owner), {"Name": "EPSG:2056"}, numbers, [name])
    note = map_note(model, tmp_path / "a.ifc")
    assert "to EPSG:2056, use translation [2600000, 1200000, 500]. Alternatively" in note


@needs_ifcopenshell
@pytest.mark.parametrize(("system", "conversion", "reason"), [
    ({"MapUnit": "furlong"}, PLACE, "its map unit 'furlong' is not a known length unit"),
    ({}, PLACE | {"Northings": "1.2e6 m"}, "Northings is '1.2e6 m', which is not a number"),
])  # fmt: skip
def test_a_map_conversion_that_is_not_understood_is_noted(
    forked, tmp_path, system, conversion, reason
):
    model = Model("IFC2X3")
    with_map_sets(model, model.site, system, conversion)
    note = map_note(model, tmp_path / "a.ifc")
    assert note == f"contains a map conversion that cannot be used because {reason}."


@needs_ifcopenshell
def test_map_conversions_that_differ_are_noted(forked, tmp_path):
    model = Model("IFC2X3")
    for owner, height in ((model.site, 0.0), (model.building, 3.0)):
        with_map_sets(model, owner, {}, PLACE | {"OrthogonalHeight": height})
    note = map_note(model, tmp_path / "a.ifc")
    assert note.endswith("because the file contains 2 property sets with different values for it.")


@needs_ifcopenshell
def test_a_map_scale_of_1_between_units_is_ignored(forked, tmp_path):
    model = Model("IFC2X3", "MILLI")
    with_map_sets(model, model.site, {"MapUnit": "METRE"}, PLACE | {"Scale": 1.0})
    note = map_note(model, tmp_path / "a.ifc")
    assert "use translation [2600000, 1200000, 500]. Alternatively" in note
    assert note.endswith("The scale was ignored, and the units were used instead.")


@needs_ifcopenshell
def test_map_scales_of_axes_and_angles_are_told_apart(forked, tmp_path):
    model = Model("IFC4X3_ADD2")
    create = model.file.create_entity
    system = create("IfcProjectedCRS", Name="EPSG:2056")
    scaled = create(
        "IfcMapConversionScaled",
        SourceCRS=model.context,
        TargetCRS=system,
        **PLACE,
        FactorX=0.9996,
        FactorY=0.9996,
        FactorZ=1.0,
    )
    path = tmp_path / "a.ifc"
    assert (
        "to EPSG:2056, use translation [2600000, 1200000, 500] and scale [0.9996, 0.9996, 1]."
        in map_note(model, path)
    )
    model.file.remove(scaled)
    create(
        "IfcRigidOperation",
        SourceCRS=model.context,
        TargetCRS=create("IfcGeographicCRS", Name="EPSG:4326"),
        FirstCoordinate=create("IfcPlaneAngleMeasure", 47.0),
        SecondCoordinate=create("IfcPlaneAngleMeasure", 8.0),
    )
    note = map_note(model, path)
    assert note.endswith("because it is in longitude and latitude instead of meters.")


def test_equal_shapes_are_shared(forked, tmp_path, monkeypatch):
    monkeypatch.setattr("lidarsim.scene.files.scene_graph.SHARED_TRIANGLES", 12)
    model = Model()
    solid = model.solid(1, 1, 1)
    for number in range(3):
        model.element("IfcColumn", f"C{number}", at=(2 * number, 0, 0), solid=solid)
    columns = load_objects(model.write(tmp_path / "a.ifc")).static
    assert all(isinstance(column, SceneInstance) for column in columns)
    assert [column.matrix[0, 3] for column in columns] == [0, 2, 4]


def test_shapes_after_a_shared_shape_are_their_own(forked, tmp_path):
    model = Model()
    solid = model.solid(1, 1, 1)
    for number in range(2):
        model.element("IfcColumn", f"C{number}", at=(2 * number, 0, 0), solid=solid)
    model.element("IfcWall", "W", (5, 6, 7))
    meshes = named(model.write(tmp_path / "a.ifc"))
    assert np.ptp(meshes["IfcWall W"].bounds, axis=0) == pytest.approx([5, 6, 7])
    assert np.ptp(meshes["IfcColumn C1"].bounds, axis=0) == pytest.approx([1, 1, 1])


def geometric_set(model, *outlines):
    """Return a representation of a line and of plane surfaces inside outlines."""
    create = model.file.create_entity
    line, *rings = (
        create("IfcPolyline", Points=[model.point(*point) for point in points])
        for points in (((0, 0, 0), (1, 0, 0), (1, 1, 0)), *outlines)
    )
    surfaces = [
        create(
            "IfcCurveBoundedPlane",
            BasisSurface=create("IfcPlane", Position=model.frame),
            OuterBoundary=ring,
            InnerBoundaries=[],
        )
        for ring in rings
    ]
    return create(
        "IfcShapeRepresentation",
        ContextOfItems=model.context,
        RepresentationIdentifier="Body",
        RepresentationType="GeometricSet",
        Items=[create("IfcGeometricSet", Elements=[line, *surfaces])],
    )


def test_styles_of_edges_are_not_styles_of_triangles(forked, tmp_path):
    model = Model()
    shape = geometric_set(model, ((0, 0), (3, 0), (3, 4), (0, 0)))
    model.paint(model.element("IfcBeam", "B", solid=shape), "Steel", (0.2, 0.4, 0.6))
    (mesh,) = load_meshes(
        model.write(tmp_path / "a.ifc"), colors=True, materials=True, report=[].append
    )
    assert len(mesh.faces) == 1
    assert mesh.bounds == pytest.approx(np.array([(0, 0, 0), (3, 4, 0)]))
    assert mesh.materials.names == ("Steel",)
    assert mesh.colors.images[0].tolist() == [[[51, 102, 153]]]


def test_a_shape_of_edges_with_styles_is_noted(forked, tmp_path):
    model = Model()
    model.element("IfcWall", "W")
    flat = geometric_set(model, ((0, 0), (1, 0), (2, 0), (0, 0)))
    model.paint(model.element("IfcBeam", "Line", solid=flat), "Steel", (0.2, 0.4, 0.6))
    notes = []
    (mesh,) = load_meshes(model.write(tmp_path / "a.ifc"), materials=True, report=notes.append)
    assert mesh.name == "IfcWall W"
    [note] = notes
    assert "1 element that ifcopenshell cannot convert to triangles: 'IfcBeam Line'" in note


def test_elements_that_openings_take_away_are_noted(forked, tmp_path):
    model = Model()
    model.element("IfcWall", "W")
    beam = model.element("IfcBeam", "Gone")
    model.paint(beam, "Steel", (0.2, 0.4, 0.6))
    opening = model.element("IfcOpeningElement", "Hole")
    model.rooted(
        "IfcRelVoidsElement", None, RelatingBuildingElement=beam, RelatedOpeningElement=opening
    )
    notes = []
    path = model.write(tmp_path / "a.ifc")
    (mesh,) = load_meshes(path, materials=True, report=notes.append)
    assert mesh.name == "IfcWall W"
    [note] = notes
    assert "1 element that ifcopenshell cannot convert to triangles: 'IfcBeam Gone'" in note


@pytest.mark.parametrize(
    ("schema", "layout", "suffix"),
    [
        ("IFC4X3", "IFC4X3_ADD2", ".ifc"), ("IFC4X3_ADD1", "IFC4X3_ADD2", ".ifczip"),
        ("IFC4X3_TC1", "IFC4X3_ADD2", ".ifc"), ("Ifc4x3 ", "IFC4X3_ADD2", ".ifczip"),
        ("IFC4_ADD2_TC1", "IFC4", ".ifc"), (" IFC2X3", "IFC2X3", ".ifc"),
    ],
)  # fmt: skip
def test_schemas_with_the_layout_of_another_are_read(forked, tmp_path, schema, layout, suffix):
    model = Model(layout)
    model.element("IfcWall", "W", (2, 1, 1))
    path = tmp_path / f"a{suffix}"
    write_text(path, in_schema(model.file.to_string(), layout, schema))
    notes = []
    (mesh,) = load_meshes(path, report=notes.append)
    assert np.ptp(mesh.bounds, axis=0) == pytest.approx([2, 1, 1])
    assert not notes


def test_triangulated_faces_of_ifc4x3_are_read(forked, tmp_path):
    """Closed stands before Normals there, and map conversions have two scales more."""
    model = Model("IFC4X3_ADD2")
    create = model.file.create_entity
    corners = [(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, 1.0, 0.0)]
    faces = create(
        "IfcTriangulatedFaceSet",
        Coordinates=create("IfcCartesianPointList3D", CoordList=corners),
        Closed=False,
        CoordIndex=[(1, 2, 3)],
    )
    shape = create(
        "IfcShapeRepresentation",
        ContextOfItems=model.context,
        RepresentationIdentifier="Body",
        RepresentationType="Tessellation",
        Items=[faces],
    )
    model.element("IfcWall", "W", solid=shape)
    text = in_schema(model.file.to_string(), "IFC4X3_ADD2", "IFC4X3")
    assert ",$,.F.,((1,2,3))" in text
    (tmp_path / "a.ifc").write_text(text.replace(",$,.F.,((1,2,3))", ",.F.,$,((1,2,3))"))
    (mesh,) = load_meshes(tmp_path / "a.ifc", report=[].append)
    assert sorted(mesh.vertices[mesh.faces][0].tolist()) == sorted(map(list, corners))


@pytest.mark.parametrize(
    ("schema", "suffix"), [("IFC4X3_RC4", ".ifc"), ("IFC2X2_FINAL", ".ifczip"), ("", ".ifc")]
)
def test_errors_name_the_schemas_that_are_read(house, forked, tmp_path, schema, suffix):
    path = tmp_path / f"a{suffix}"
    write_text(path, in_schema(house.read_text(), "IFC4", schema))
    with pytest.raises(LidarError) as caught:
        load_meshes(path)
    assert str(caught.value) == (
        f"{path} uses the IFC schema {schema!r}, but only IFC2X3, IFC2X3_FINAL, IFC2X3_TC1, IFC4, "
        "IFC4X3, IFC4X3_ADD1, IFC4X3_ADD2, IFC4X3_TC1, IFC4_ADD1, IFC4_ADD2, IFC4_ADD2_TC1 are "
        "supported. Export it with one of these schemas."
    )


def in_schema(text, schema, wanted):
    """Return a file that states another schema."""
    assert f"FILE_SCHEMA(('{schema}'))" in text
    return text.replace(f"FILE_SCHEMA(('{schema}'))", f"FILE_SCHEMA (( '{wanted}'))")


def write_text(path, text):
    """Write a building, packed if its suffix says so."""
    if path.suffix == ".ifc":
        path.write_text(text)
        return
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("house.ifc", text)


def test_elements_without_triangles_are_noted(forked, tmp_path):
    model = Model()
    model.element("IfcWall", "W")
    model.element("IfcBeam", "Thin", (1, 1, 0))
    notes = []
    load_meshes(model.write(tmp_path / "a.ifc"), report=notes.append)
    [note] = notes
    assert note.endswith(
        "was read without 1 element that ifcopenshell cannot convert to triangles: 'IfcBeam Thin'."
    )


def test_packed_files_are_read(house, forked, tmp_path):
    path = tmp_path / "house.ifczip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(house, "house.ifc")
    assert [*named(path)] == [*named(house)]
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("zeros.ifc", bytes(5 * 10**6))
    with pytest.raises(LidarError, match="unpacks to more than"):
        load_meshes(path)


def test_broken_files_are_refused_in_a_line(house, forked, tmp_path):
    text = house.read_text()
    path = tmp_path / "a.ifc"
    for broken, reason in (
        ("solid ice", "it does not start with ISO-10303-21"),
        (text[: len(text) // 2], "the end of the file is missing"),
        (text.replace("'IFC4'", "'IFC9'"), "IFC9"),
        (two_storeys_without_elements(text), "contains no elements with geometry"),
    ):
        path.write_text(broken)
        with pytest.raises(LidarError) as caught:
            load_meshes(path)
        assert reason in str(caught.value)
        assert "\n" not in str(caught.value)


def two_storeys_without_elements(text):
    """Return a file whose products have no shapes."""
    return "\n".join(
        line for line in text.splitlines() if not any(
            kind in line for kind in ("IFCSLAB(", "IFCWALL(", "IFCDOOR(")
        )
    )  # fmt: skip


def test_unknown_entities_are_noted(house, forked, tmp_path):
    path = tmp_path / "a.ifc"
    path.write_text(house.read_text().replace("IFCSLAB(", "IFCSLEB("))
    notes = []
    assert len(load_meshes(path, report=notes.append)) == 3
    assert any("that ifcopenshell ignored" in n and "IFCSLEB" in n for n in notes)


@pytest.mark.slow
def test_garbled_files_are_read_or_refused(house, forked, tmp_path):
    random = np.random.default_rng(7)
    data = np.frombuffer(house.read_bytes(), np.uint8)
    path = tmp_path / "a.ifc"
    for _ in range(40):
        garbled = data.copy()
        rows = random.integers(0, len(data), random.integers(1, 6))
        garbled[rows] = random.choice(np.frombuffer(b"0123456789.-#$*(),;'E", np.uint8), len(rows))
        path.write_bytes(garbled.tobytes())
        notes = []
        try:
            load_meshes(path, report=notes.append)
        except LidarError as error:
            notes.append(str(error))
        assert not any("\n" in note for note in notes)


@pytest.mark.extended
@needs_ifcopenshell
def test_a_process_that_wants_too_much_ends_itself_only(house, monkeypatch):
    monkeypatch.setattr(reader, "MIN_MEMORY_BYTES", 60 * 2**20)
    with pytest.raises(
        LidarError, match=r"ifcopenshell exited with .*, possibly because it needs more than"
    ):
        load_meshes(house)


@pytest.mark.extended
def test_without_ifcopenshell_a_line_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setattr(reader, "find_spec", lambda name: None)
    path = tmp_path / "a.ifc"
    path.write_text("ISO-10303-21;\nEND-ISO-10303-21;\n")
    with pytest.raises(
        LidarError, match=r"ifcopenshell. Install it with `pip install -e \"\.\[ifc\]\""
    ):
        load_meshes(path)


@pytest.mark.extended
@pytest.mark.parametrize("cut", [10, 60])
def test_a_process_that_dies_within_a_frame_is_reported(tmp_path, monkeypatch, cut):
    output = b'{"what": "shape", "arrays": [["<f8", [4, 3]]]}\n' + bytes(96)

    @contextmanager
    def dying(command, **options):
        yield SimpleNamespace(stdout=io.BytesIO(output[:cut]), wait=lambda: -11, kill=lambda: None)

    library = SimpleNamespace(Popen=dying, DEVNULL=None, PIPE=None)
    monkeypatch.setattr(child_process, "subprocess", library)
    monkeypatch.setattr(reader, "find_spec", lambda name: True)
    path = tmp_path / "a.ifc"
    path.write_text("ISO-10303-21;\nEND-ISO-10303-21;\n")
    with pytest.raises(LidarError, match="ifcopenshell exited with SIGSEGV"):
        load_meshes(path)
