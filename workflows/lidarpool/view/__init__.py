"""Pictures of a survey: scene, ray intensity, point cloud and planned path."""

from .cloud_picture import MOST_POINTS, draw_cloud
from .intensity_picture import draw_intensity
from .path_picture import draw_path
from .scene_picture import draw_scene
from .shot import SIZE, Shot, take_shot

__all__ = [
    "MOST_POINTS",
    "SIZE",
    "Shot",
    "draw_cloud",
    "draw_intensity",
    "draw_path",
    "draw_scene",
    "take_shot",
]
