"""Simulate a lidar in PyBullet that scans boxes while they fall."""

import numpy as np

try:
    import pybullet as bullet
except ImportError as error:
    raise SystemExit("This example needs PyBullet: pip install pybullet") from error

from lidarpool import Follower, Noise, box, load_sensor, save_cloud

STEP_S = 1 / 240  # default time step of PyBullet
DURATION_S = 0.55
SIZE_M = 0.6


def matrix(position, quaternion):
    """Convert a PyBullet pose to a transformation matrix from the body frame to the world frame.

    The shape is (4, 4).
    """
    result = np.eye(4)
    result[:3, :3] = np.reshape(bullet.getMatrixFromQuaternion(quaternion), (3, 3))
    result[:3, 3] = position
    return result


def main() -> None:
    """Simulate half a second and save the last sweep to boxes.ply."""
    bullet.connect(bullet.DIRECT)
    bullet.setGravity(0, 0, -9.81)
    bullet.createMultiBody(0, bullet.createCollisionShape(bullet.GEOM_PLANE))
    shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=[SIZE_M / 2] * 3)
    positions = np.random.default_rng(7).uniform((2, -3, 1), (8, 3, 4), (12, 3))
    boxes = [bullet.createMultiBody(5, shape, basePosition=p) for p in positions.tolist()]
    # The origin of a PyBullet box is its center, that of `box` is the center of its bottom face.
    mesh = box("Box", (SIZE_M, SIZE_M, SIZE_M)).affine_transform(
        "Box", np.eye(3), np.array([0, 0, -0.3])
    )
    follower = Follower(
        [mesh] * len(boxes),
        load_sensor("velodyne/vlp16"),
        static=[
            box("Ground", (200, 200, 0.1)).affine_transform(
                "Ground", np.eye(3), np.array([0, 0, -0.1])
            )
        ],
        columns=["range", "time", "intensity"],
        noise=Noise(range_m=0.01),
    )
    lidar = matrix((0, 0, 1), (0, 0, 0, 1))
    cloud = None
    for number in range(round(DURATION_S / STEP_S)):
        bullet.stepSimulation()
        poses = [matrix(*bullet.getBasePositionAndOrientation(body)) for body in boxes]
        for cloud in follower.step(number * STEP_S, lidar, poses):
            on_boxes = cloud.object > 0
            print(f"{number * STEP_S:.3f} s: {len(cloud):,} points, {on_boxes.sum():,} on boxes")
    if cloud is not None:
        save_cloud(cloud, "boxes.ply")
    bullet.disconnect()


if __name__ == "__main__":
    main()
