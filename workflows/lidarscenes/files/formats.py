"""List the mesh formats that lidarscenes adds to lidarsim.

`mesh_formats` in lidarsim finds this table.
"""

from __future__ import annotations

from lidarsim.scene.files.mesh_formats import MeshFormat

CITYJSON = (".json", ".cityjson", ".jsonl")
ROBOTS = (".urdf", ".xacro")  # `urdf` refuses .xacro files with advice
WORLDS = (".sdf", ".world")  # Gazebo worlds
MODELS = (".xml",)  # MuJoCo models

_USD = "lidarscenes.files.usd:read_usd"
_RASTER = "lidarscenes.files.rasters:read_raster"
_RASTER_OPTIONS = "lidarscenes.files.rasters:RasterOptions"
_IFC = "lidarscenes.files.ifc:read_ifc"
_IFC_OPTIONS = "lidarscenes.files.ifc:IfcOptions"
_GAZEBO = "lidarscenes.gazebo.world"
_ROADS = "lidarscenes.roads.opendrive"
_MUJOCO = "lidarscenes.mujoco.model_file"
_ZIP = b"PK\x03\x04"
_CRATE = b"PXR-USDC"  # binary OpenUSD
_USD_TEXT = b"#usda "

MESH_FORMATS = (
    MeshFormat((".dae",), "lidarscenes.files.dae:read_dae"),
    MeshFormat((".3mf",), "lidarscenes.files.threemf:read_3mf", signatures=(_ZIP,)),
    MeshFormat((".vox",), "lidarscenes.files.vox:read_vox"),
    MeshFormat((".usd",), _USD, animated=True, signatures=(_CRATE, _USD_TEXT)),
    MeshFormat((".usda",), _USD, animated=True, signatures=(_USD_TEXT,)),
    MeshFormat((".usdc",), _USD, animated=True, signatures=(_CRATE,)),
    MeshFormat((".usdz",), _USD, animated=True, signatures=(_ZIP,)),
    MeshFormat(CITYJSON, "lidarscenes.files.cityjson:read_cityjson"),
    MeshFormat(
        (".tif", ".tiff"),
        _RASTER,
        from_path=True,
        options=_RASTER_OPTIONS,
        signatures=(b"II*\0", b"MM\0*"),
    ),
    MeshFormat(
        (".asc", ".hgt", ".img", ".dem", ".dt0", ".dt1", ".dt2"),
        _RASTER,
        from_path=True,
        options=_RASTER_OPTIONS,
    ),
    MeshFormat(WORLDS, f"{_GAZEBO}:read_sdf", options=f"{_GAZEBO}:GazeboOptions"),
    MeshFormat((".xodr",), f"{_ROADS}:read_xodr", options=f"{_ROADS}:RoadOptions"),
    MeshFormat(MODELS, f"{_MUJOCO}:read_mjcf", options=f"{_MUJOCO}:MujocoOptions"),
    MeshFormat(
        (".ifc",), _IFC, from_path=True, options=_IFC_OPTIONS, signatures=(b"ISO-10303-21;",)
    ),
    MeshFormat((".ifczip",), _IFC, from_path=True, options=_IFC_OPTIONS, signatures=(_ZIP,)),
    MeshFormat(
        ROBOTS, advice="it describes a robot. Read it with load_robot, or add it to a scenario"
    ),
)
