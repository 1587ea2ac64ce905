"""Lidar simulation in the calling process.

A `Survey` describes sensors, poses, noise and weather, and a `Scanner` simulates individual sweeps.
This package imports neither Dask nor Open3D. To run thousands of surveys on a Dask cluster, use the
`lidarpool` package.
"""

from .environment.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "._version": "__version__",
        ".columns.cloud": "Cloud",
        ".columns.table": "Column",
        ".errors": "LidarError",
        ".media.materials": "Material",
        ".motion.navigation": "Gnss Imu Navigation",
        ".motion.trajectory": "Pose Track",
        ".motion.trajectory_files": "load_trajectory",
        ".packets.sweep_packets": "Packets",
        ".scene.actors": "Actor box",
        ".scene.scene": "Scene",
        ".scene.scene_instances": "SceneInstance",
        ".scene.scene_mesh": "SceneMesh",
        ".sensor": "Beams Noise Optics Returns Sensor Spin",
        ".sensor.export": "export_sensor",
        ".sensor.models": "load_sensor",
        ".simulator": "Scanner",
        ".survey.faults": "Fault",
        ".survey.survey": "Mounted ScanSpec Survey",
        ".worlds": "MujocoScanner NewtonScanner",
        ".worlds.follower": "Follower",
    },
)
