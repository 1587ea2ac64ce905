"""Simulate a lidar in Newton that scans boxes while they fall."""

import numpy as np

try:
    import newton
    import warp
except ImportError as error:
    raise SystemExit("This example needs Newton: pip install newton") from error

from lidarpool import Follower, Noise, box, load_sensor, save_cloud
from lidarsim.motion.rotations import matrices
from lidarsim.scene.transform import affine

STEP_S = 1 / 240
DURATION_S = 0.55
SIZE_M = 0.6


def model_of_boxes(positions):
    """Return a Newton model of boxes above the ground."""
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    for position in positions.tolist():
        body = builder.add_body(xform=warp.transform(position, warp.quat_identity()))
        builder.add_shape_box(body, hx=SIZE_M / 2, hy=SIZE_M / 2, hz=SIZE_M / 2)
    return builder.finalize()


def main() -> None:
    """Simulate half a second and save the last sweep to boxes.ply."""
    positions = np.random.default_rng(7).uniform((2, -3, 1), (8, 3, 4), (12, 3))
    model = model_of_boxes(positions)
    solver = newton.solvers.SolverXPBD(model)
    state = model.state()
    next_state = model.state()
    collisions = newton.CollisionPipeline(model)
    contacts = collisions.contacts()
    # The origin of a Newton box is its center, that of `box` is the center of its bottom face.
    mesh = box("Box", (SIZE_M, SIZE_M, SIZE_M)).affine_transform(
        "Box", np.eye(3), np.array([0, 0, -0.3])
    )
    follower = Follower(
        [mesh] * len(positions),
        load_sensor("velodyne/vlp16"),
        static=[
            box("Ground", (200, 200, 0.1)).affine_transform(
                "Ground", np.eye(3), np.array([0, 0, -0.1])
            )
        ],
        columns=["range", "time", "intensity"],
        noise=Noise(range_m=0.01),
    )
    lidar = affine(np.eye(3), np.array([0, 0, 1]))
    cloud = None
    for number in range(round(DURATION_S / STEP_S)):
        state.clear_forces()
        collisions.collide(state, contacts)
        solver.step(state, next_state, model.control(), contacts, STEP_S)
        state, next_state = next_state, state
        poses = state.body_q.numpy().astype(np.float64)  # positions and quaternions (x, y, z, w)
        rotations = matrices(poses[:, 3:] / np.linalg.norm(poses[:, 3:], axis=1, keepdims=True))
        bodies = affine(rotations, poses[:, :3])
        for cloud in follower.step(number * STEP_S, lidar, bodies):
            on_boxes = cloud.object > 0
            print(f"{number * STEP_S:.3f} s: {len(cloud):,} points, {on_boxes.sum():,} on boxes")
    if cloud is not None:
        save_cloud(cloud, "boxes.ply")


if __name__ == "__main__":
    main()
