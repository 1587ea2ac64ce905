"""Define a Gymnasium environment in which a robot drives to a goal using only its lidar."""

import math

import numpy as np

try:
    import gymnasium
except ImportError as error:
    raise SystemExit("This example needs Gymnasium: pip install gymnasium") from error

from lidarpool import Noise, Pose, Scanner, Scene, Sensor

RAYS = 64
FAR_M = 15.0  # range of the lidar
RADIUS_M = 0.4  # radius of the robot
STEP_S = 0.1
MAX_STEPS = 400
START = (25.0, 25.0)
GOAL = (-30.0, -20.0)


class RobotEnv(gymnasium.Env):
    """Environment in which a robot drives to a goal without hitting columns.

    An observation contains 64 ranges, and the distance and direction of the goal. An action
    consists of the speed (0 to 2 m/s) and the yaw rate. The reward is the distance covered toward
    the goal, in meters. An episode ends when the robot reaches the goal or hits a surface.
    """

    def __init__(self, scene=None):
        sensor = Sensor.grid(RAYS, 1, step_deg=360, max_range_m=FAR_M)
        self.scanner = Scanner(scene or Scene.seed(), sensor, noise=Noise(range_m=0.02), threads=1)
        self.action_space = gymnasium.spaces.Box(np.float32([0, -1.5]), np.float32([2, 1.5]))
        # Ranges, distance to the goal, and cosine and sine of the direction of the goal.
        minimum = np.zeros(RAYS + 3, np.float32)
        minimum[-2:] = -1
        maximum = np.full(RAYS + 3, FAR_M, np.float32)
        maximum[-3:] = (np.inf, 1, 1)
        self.observation_space = gymnasium.spaces.Box(minimum, maximum)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position = np.array(START) + self.np_random.uniform(-1, 1, 2)
        self.yaw = self.np_random.uniform(-math.pi, math.pi)
        self.steps = 0
        # The sweep number determines the random numbers, so each episode has different noise.
        self.number = int(self.np_random.integers(1_000_000))
        return self._observed(), {}

    def step(self, action):
        action = np.clip(action, self.action_space.low, self.action_space.high)
        speed, rate = action.tolist()
        distance_before = math.dist(self.position, GOAL)
        self.yaw += rate * STEP_S
        self.position += speed * STEP_S * np.array([math.cos(self.yaw), math.sin(self.yaw)])
        self.steps += 1
        observation = self._observed()
        distance_after = math.dist(self.position, GOAL)
        hit = bool(observation[:RAYS].min() < RADIUS_M)
        return (
            observation,
            distance_before - distance_after - 10 * hit,
            hit or distance_after < 1,
            self.steps >= MAX_STEPS,
            {},
        )

    def _observed(self):
        pose = Pose((*self.position, 0.5), yaw_deg=math.degrees(self.yaw))
        ranges = self.scanner.ranges(pose, number=self.number + self.steps).reshape(-1)
        goal_bearing = math.atan2(*(np.array(GOAL) - self.position)[::-1]) - self.yaw
        goal = [math.dist(self.position, GOAL), math.cos(goal_bearing), math.sin(goal_bearing)]
        return np.concatenate([np.minimum(ranges, FAR_M), goal]).astype(np.float32)


if __name__ == "__main__":
    env = RobotEnv()
    observation, _ = env.reset(seed=1)
    total = 0.0
    finished = False
    while not finished:  # toward the goal, and away from the nearest surface
        nearest = observation[:RAYS].argmin() * 2 * math.pi / RAYS
        yaw_rate = (
            math.atan2(observation[-1], observation[-2])
            - 3 * math.sin(nearest) / observation[:RAYS].min()
        )
        observation, reward, ended, cut, _ = env.step(np.float32([2, yaw_rate]))
        total += reward
        finished = ended or cut
    print(f"{env.steps} steps, reward {total:.1f}, {observation[-3]:.1f} m from the goal")
