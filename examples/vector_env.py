"""Define a Gymnasium vector environment in which MuJoCo robots use lidars to avoid columns."""

import numpy as np

try:
    import gymnasium
    import mujoco
    from gymnasium.spaces import Box, Dict
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise SystemExit("This example needs: pip install mujoco gymnasium") from error

from lidarpool import MujocoScanner, Sensor

LIDAR = Sensor.grid(90, 4, vertical_fov_deg=20, step_deg=360, max_range_m=12)
STEPS = 25  # MuJoCo steps per environment step
COLUMNS = np.random.default_rng(1).uniform(-0.6, 0.6, (49, 2)) + np.argwhere(np.ones((7, 7))) * 4


def world(robots: int) -> str:
    """Return the MJCF of a hall with columns and robots.

    The robots do not collide with each other.
    """
    geoms = [f'<geom type="cylinder" size=".3 1" pos="{x:.2f} {y:.2f} 1"/>' for x, y in COLUMNS]
    for k in (-2, 26):
        geoms += [f'<geom type="box" size=".1 14 1" pos="{k} 12 1"/>']
        geoms += [f'<geom type="box" size="14 .1 1" pos="12 {k} 1"/>']
    bodies = [
        f'<body pos="0 0 .2"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>'
        f'<joint type="hinge"/><geom type="cylinder" size=".25 .1" contype="0" mass="1"/>'
        f'<site name="lidar {k}" pos="0 0 .3"/></body>'
        for k in range(robots)
    ]
    floor = '<geom type="plane" size="0 0 .1" conaffinity="0"/>'
    return f"<mujoco><worldbody>{floor}{''.join([*geoms, *bodies])}</worldbody></mujoco>"


class LidarVectorEnv(gymnasium.vector.VectorEnv):
    """Environment in which robots drive in a hall without hitting columns.

    An observation contains the velocities and the ranges (channels, firings). An action consists
    of the speed and the yaw rate. The reward is the distance driven, in meters. An episode ends
    when the robot hits a column or a wall.
    """

    def __init__(self, num_envs=8):
        self.metadata = {"autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP}
        self.num_envs = num_envs
        self.model = mujoco.MjModel.from_xml_string(world(num_envs))
        self.data = mujoco.MjData(self.model)
        sites = [f"lidar {k}" for k in range(num_envs)]
        self.scanner = MujocoScanner(self.model, LIDAR, site=sites, threads=1)
        self.single_observation_space = Dict(
            state=Box(-np.inf, np.inf, (3,)),
            lidar=Box(0, LIDAR.max_range_m, (LIDAR.channels, LIDAR.period)),
        )
        self.single_action_space = Box(np.float32([0, -2]), np.float32([1, 2]))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self._place(np.ones(self.num_envs, bool))
        return self._observed(), {}

    def step(self, actions):
        speed, yaw_rate = np.asarray(actions, np.float64).T
        for _ in range(STEPS):
            yaw = self.data.qpos[2::3]
            self.data.qvel[:] = np.stack(
                [speed * np.cos(yaw), speed * np.sin(yaw), yaw_rate], axis=1
            ).ravel()
            mujoco.mj_step(self.model, self.data)
        last = self._observed()
        ended = last["lidar"].min(axis=(1, 2)) < 0.35
        self._place(ended)
        reward = speed * STEPS * self.model.opt.timestep - 5 * ended
        infos = {"final_obs": last, "_final_obs": ended}
        return self._observed(), reward, ended, np.zeros_like(ended), infos

    def _place(self, chosen):
        """Place the selected robots at random positions between the columns."""
        cells = self.np_random.integers(0, 6, (self.num_envs, 2)) * 4 + 2
        yaws = self.np_random.uniform(-np.pi, np.pi, (self.num_envs, 1))
        self.data.qpos.reshape(-1, 3)[chosen] = np.hstack([cells, yaws])[chosen]
        mujoco.mj_forward(self.model, self.data)

    def _observed(self):
        ranges = self.scanner.ranges(self.data).transpose(0, 2, 1)
        state = self.data.qvel.reshape(-1, 3).astype(np.float32)
        return {"state": state, "lidar": np.minimum(ranges, np.float32(LIDAR.max_range_m))}


if __name__ == "__main__":
    envs = LidarVectorEnv()
    observation, _ = envs.reset(seed=1)
    total = np.zeros(envs.num_envs)
    for _ in range(60):  # steer away from the nearest surface
        nearest = observation["lidar"].min(axis=1)
        bearing = nearest.argmin(axis=1) * 2 * np.pi / LIDAR.period
        yaw_rate = np.clip(-1.5 * np.sin(bearing) / nearest.min(axis=1), -2, 2)
        actions = np.stack([np.full(envs.num_envs, 0.8), yaw_rate], axis=1)
        observation, reward, _, _, _ = envs.step(actions)
        total += reward
    print(f"lidar {observation['lidar'].shape}, rewards {total.round(1).tolist()}")
