"""A lander that flies to any point: one skill with a goal, in place of a skill for each place.

```
python examples/go_to.py --out runs/go-to
```
"""

import argparse

import gymnasium as gym
import numpy as np

import skillweave as sw

X, Y = 0, 1
GRID = [(x, y) for x in (-0.6, -0.3, 0.0, 0.3, 0.6) for y in (0.4, 0.65, 0.9, 1.15)]
HELD = 20  # steps within 0.1 of the goal, one after another


def distance(obs, goal):
    """Return how far the lander is from its goal."""
    return np.hypot(obs[:, X] - goal[:, 0], obs[:, Y] - goal[:, 1])


class GoTo(sw.Skill):
    """Fly to a point, and stay there."""

    goal_space = gym.spaces.Box(np.float32([-0.8, 0.3]), np.float32([0.8, 1.3]))
    max_steps = 300

    def reward(self, step):
        """Return more the nearer the goal is; an end of the episode is a crash."""
        far = distance(step.next_obs, step.goal)
        near = 1.0 - far + 0.5 * (far < 0.1)
        return np.where(step.terminated, -5.0, near)

    def success(self, step):
        """Return where it is at its goal."""
        return distance(step.next_obs, step.goal) < 0.1


def tour(obs):
    """Return the corner to fly to, by where the lander is: a selector that is a rule."""
    right = obs[:, X] < 0
    goal = np.where(right[:, None], (0.5, 0.8), (-0.5, 0.8))
    return np.full(len(obs), "go_to"), goal


def holds(run, goal, seed):
    """Return whether the lander reaches a goal and stays there, in one episode."""
    env, player = gym.make("LunarLander-v3"), run.player(skill="go_to", goal=goal)
    obs, _ = env.reset(seed=seed)
    held = most = 0
    for _ in range(400):
        obs, _, terminated, truncated, _ = env.step(player.act(obs))
        held = held + 1 if np.hypot(obs[X] - goal[0], obs[Y] - goal[1]) < 0.1 else 0
        most = max(most, held)
        if terminated or truncated:
            break
    env.close()
    return most >= HELD


def main():
    """Train the skill, and fly to a grid of goals."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--steps", type=int, default=1_500_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--grid", type=int, default=len(GRID), help="goals to fly to")
    parser.add_argument("--out", default=None)
    args = parser.parse_args()
    hierarchy = sw.Hierarchy(
        "LunarLander-v3",
        [GoTo()],
        selector=tour,
        call_steps=100,
        algorithm=sw.PPO(
            num_envs=64,
            n_steps=64,
            learning_rate=1e-3,
            gamma=0.98,
            gae_lambda=0.95,
            batch_size=1024,
            update_epochs=3,
            network=sw.Network(activation="relu"),
        ),
        learn="apart",
        steps=args.steps,
    )
    run = hierarchy.train(args.out, seed=args.seed)
    print(run.evaluate(20, skill="go_to"))
    grid = GRID[: args.grid]
    reached = [holds(run, goal, 1_000 + i) for i, goal in enumerate(grid)]
    print(f"goals reached and held for {HELD} steps: {sum(reached)} of {len(reached)}")


if __name__ == "__main__":
    main()
