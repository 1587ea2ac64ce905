"""Lidar surveys of triangle scenes on a partitioned Dask cluster."""

import lidarview  # noqa: F401 - draws the pictures in notebooks
from lidarsim.environment.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "lidarfiles": (
            "PointCloud Recording RecordingInfo SweepsInMemory open_recording read_cloud "
            "save_cloud sweeps to_open3d"
        ),
        "lidarlive": "Foxglove Rerun play",
        "lidarreal": (
            "Augment Comparison Effects Fit Insertion PatternFit SurveyComparison Twin "
            "augment compare compare_strips compare_surveys fit fit_pattern twin"
        ),
        "lidarscenario": "Job Plan Planning",
        "lidarscenes": "Robot load_robot",
        "lidarsim": (
            "Actor Beams Cloud Column Fault Follower Gnss Imu LidarError Material Mounted "
            "MujocoScanner Navigation NewtonScanner Noise Optics Packets Pose Returns "
            "ScanSpec Scanner Scene SceneInstance SceneMesh Sensor Spin Survey Track "
            "__version__ box load_sensor load_trajectory"
        ),
        "lidarsim.columns.sweep": "Sweep",
        ".api.dask_frames": "to_dask",
        ".api.result": "Result",
        ".api.simulation": "Campaign simulate",
        ".pages.scanner_page": "show",
        ".report.merging": "merge",
        ".run.pipeline.stage_messages": "ScanFrame",
        ".run.run_result": "CampaignRun",
        ".run.store.run_store": "remove_run",
    },
)
