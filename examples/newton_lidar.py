"""Simulate a lidar in each of eight Newton worlds, in which boxes fall around it."""

import numpy as np

try:
    import newton
    import warp
except ImportError as error:
    raise SystemExit("This example needs Newton: pip install newton") from error

from lidarpool import NewtonScanner, Noise, load_sensor, save_cloud

WORLDS = 8
STEP_S = 1 / 240
DURATION_S = 0.55
SIZE_M = 0.6


def model_of_worlds():
    """Return a Newton model of worlds with boxes in the air, above a ground that they share."""
    world = newton.ModelBuilder()
    for position in np.random.default_rng(7).uniform((2, -3, 1), (8, 3, 4), (12, 3)).tolist():
        body = world.add_body(xform=warp.transform(position, warp.quat_identity()))
        world.add_shape_box(body, hx=SIZE_M / 2, hy=SIZE_M / 2, hz=SIZE_M / 2)
    world.add_site(-1, xform=warp.transform((0, 0, 1), warp.quat_identity()), label="lidar")
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    builder.replicate(world, WORLDS)
    return builder.finalize()


def main() -> None:
    """Simulate half a second and save the last sweep in world 0 to boxes.ply."""
    model = model_of_worlds()
    solver = newton.solvers.SolverXPBD(model)
    state = model.state()
    next_state = model.state()
    collisions = newton.CollisionPipeline(model)
    contacts = collisions.contacts()
    scanner = NewtonScanner(
        model,
        load_sensor("velodyne/vlp16"),
        site="lidar",
        columns=["range", "time", "intensity"],
        noise=Noise(range_m=0.01),
    )
    last = None
    for number in range(round(DURATION_S / STEP_S)):
        state.clear_forces()
        collisions.collide(state, contacts)
        solver.step(state, next_state, model.control(), contacts, STEP_S)
        state, next_state = next_state, state
        for world, clouds in enumerate(scanner.step(number * STEP_S, state)):
            for cloud in clouds:
                on_boxes = cloud.object > 0
                print(
                    f"{number * STEP_S:.3f} s, world {world}: {len(cloud):,} points, "
                    f"{on_boxes.sum():,} on boxes"
                )
                last = cloud if world == 0 else last
    if last is not None:
        save_cloud(last, "boxes.ply")


if __name__ == "__main__":
    main()
