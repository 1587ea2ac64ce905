"""Poses and trajectories, their files, and the platform's IMU and GNSS receiver."""

from .navigation import Gnss, Imu, Navigation
from .trajectory import Pose, StaticPose, Stations, Track, Trajectory
from .trajectory_files import load_trajectory

__all__ = [
    "Gnss",
    "Imu",
    "Navigation",
    "Pose",
    "StaticPose",
    "Stations",
    "Track",
    "Trajectory",
    "load_trajectory",
]
