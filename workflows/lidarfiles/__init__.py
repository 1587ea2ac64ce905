"""Files of lidars: point clouds, recordings, data sets, and resumable work on them."""

from lidarsim.environment.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        ".clouds.open3d_cloud": "to_open3d",
        ".clouds.ply": "read_cloud",
        ".clouds.recording": "PointCloud Recording RecordingInfo SweepsInMemory",
        ".clouds.writing": "save_cloud",
        ".datasets.loader": "sweeps",
        ".recordings.opening": "open_recording",
    },
)
