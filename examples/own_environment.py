"""Bring your own environment: ``python examples/own_environment.py`` (under a minute).

Anything works that has Dict observations with ``observation``, ``achieved_goal`` and ``desired_goal`` and Box actions.
This one is a point in a cube that a wall with a window divides; goals are three-dimensional.
"""

import argparse
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces

from sb3_skillgraph import SkillGraphAgent


class WindowCube(gym.Env[dict[str, np.ndarray], np.ndarray]):
    """A point in the cube [-1, 1]^3; the plane x = 0 is a wall with a window of half side 0.5."""

    #: The agent takes the radius of its events from here (or from its argument ``event_radius``).
    distance_threshold = 0.3
    #: Plans promise to arrive within so many steps.
    max_steps = 100

    def __init__(self) -> None:
        box = spaces.Box(-1.0, 1.0, shape=(3,), dtype=np.float32)
        self.observation_space: spaces.Space = spaces.Dict({"observation": box, "achieved_goal": box, "desired_goal": box})
        self.action_space = spaces.Box(-1.0, 1.0, shape=(3,), dtype=np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start in the left half; the goal is anywhere."""
        super().reset(seed=seed)
        self.point = self.np_random.uniform([-0.9, -0.9, -0.9], [-0.5, 0.9, 0.9]).astype(np.float32)
        self.goal = self.np_random.uniform(-0.9, 0.9, size=3).astype(np.float32)
        self.n_steps = 0
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Move by up to 0.1 along each axis; the wall stops what does not go through the window."""
        moved = np.clip(self.point + 0.1 * np.clip(action, -1.0, 1.0), -1.0, 1.0).astype(np.float32)
        if (moved[0] > 0) != (self.point[0] > 0) and np.abs(moved[1:]).max() > 0.5:
            moved[0] = self.point[0]
        self.point = moved
        self.n_steps += 1
        success = bool(np.linalg.norm(self.point - self.goal) <= self.distance_threshold)
        # The agent learns without this reward; is_success is what SB3's callbacks report.
        return self._observe(), float(success), False, self.n_steps >= self.max_steps, {"is_success": success}

    def _observe(self) -> dict[str, np.ndarray]:
        return {"observation": self.point.copy(), "achieved_goal": self.point.copy(), "desired_goal": self.goal.copy()}


def success_rate(agent: SkillGraphAgent, env: WindowCube, n_episodes: int) -> float:
    """Measure on the environment's own starts and goals.

    :param agent: the agent
    :param env: the environment
    :param n_episodes: how many episodes
    :return: share of the episodes in which the goal was reached
    """
    n_reached = 0
    for episode in range(n_episodes):
        observation, _ = env.reset(seed=episode)
        state, reached, done = None, False, False
        while not (reached or done):
            action, state = agent.predict(observation, state=state, deterministic=True)
            observation, _, _, done, info = env.step(action)
            reached = info["is_success"]
        n_reached += reached
    return n_reached / n_episodes


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=5_000, help="environment steps of training")
    args = parser.parse_args()

    th.set_num_threads(1)  # small networks are faster on one thread
    agent = SkillGraphAgent("MultiInputPolicy", WindowCube(), seed=0)
    agent.learn(args.steps)
    summary = agent.graph_summary()
    print(f"{summary['events']} events, {summary['salient_events']} of them salient; {summary['edges']} edges")
    print(f"success rate: {success_rate(agent, WindowCube(), n_episodes=50):.2f}")
