"""Simulate the lidar of a MuJoCo robot that drives through falling balls."""

import numpy as np

try:
    import mujoco
except ImportError as error:
    raise SystemExit("This example needs MuJoCo: pip install mujoco") from error

from lidarpool import MujocoScanner, Noise, load_sensor, save_cloud

SPEED_M_S = 2.0
DURATION_S = 0.55


def world(balls: int = 12) -> str:
    """Return the MJCF of a hall with a robot and balls in the air."""
    rng = np.random.default_rng(7)
    bodies = [
        f'<body name="ball {k}" pos="{x:.2f} {y:.2f} {z:.2f}"><freejoint/>'
        f'<geom type="sphere" size=".25" rgba="{0.2 + 0.06 * k:.2f} .4 .3 1"/></body>'
        for k, (x, y, z) in enumerate(rng.uniform((1, -3, 1), (8, 3, 4), (balls, 3)))
    ]
    walls = [
        f'<geom type="box" size="{sx} {sy} 1.5" pos="{x} {y} 1.5"/>'
        for sx, sy, x, y in ((10, 0.1, 4, 4), (10, 0.1, 4, -4), (0.1, 4, 14, 0), (0.1, 4, -6, 0))
    ]
    return f"""
<mujoco>
  <worldbody>
    <geom type="plane" size="0 0 .1"/>
    {"".join(walls)}
    <body name="robot" pos="0 0 .3">
      <joint type="slide" axis="1 0 0"/>
      <geom type="cylinder" size=".3 .2" mass="20"/>
      <site name="lidar" pos="0 0 .5"/>
    </body>
    {"".join(bodies)}
  </worldbody>
</mujoco>"""


def main() -> None:
    """Simulate half a second and save the last sweep to balls.ply."""
    model = mujoco.MjModel.from_xml_string(world())
    data = mujoco.MjData(model)
    data.qvel[0] = SPEED_M_S
    scanner = MujocoScanner(
        model,
        load_sensor("velodyne/vlp16"),
        site="lidar",
        columns=["range", "time", "intensity"],
        noise=Noise(range_m=0.01),
    )
    cloud = None
    while data.time < DURATION_S:
        mujoco.mj_step(model, data)
        for cloud in scanner.step(data):
            on_balls = cloud.object > 0
            print(f"{data.time:.3f} s: {len(cloud):,} points, {on_balls.sum():,} on balls")
    if cloud is not None:
        save_cloud(cloud, "balls.ply")


if __name__ == "__main__":
    main()
