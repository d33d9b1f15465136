"""A robot dog that walks to points: a walking policy from elsewhere is a skill, and a velocity is
its goal.

```
python examples/robot_dog.py walk.onnx --by-hand
python examples/robot_dog.py walk.onnx --out runs/robot-dog
```

The file is a joystick policy for Unitree's Go1, trained with google-deepmind/mujoco_playground
(Apache-2.0) and saved as ONNX. Its 48 inputs are the environment's ``state``, of which the last
three are the command: metres a second forward and left, and radians a second to the left. Its 12
outputs are the action. It needs ``pip install 'skillweave[envpool,onnx]'``.
"""

import argparse

import gymnasium as gym
import numpy as np
from PIL import Image, ImageDraw

import skillweave as sw
from skillweave.envs import PoolWrapper, one_of

POINTS = 4
SECONDS = 30  # for each point
DT = 0.02  # seconds of a step
NEAR = 0.5  # metres from a point at which the dog takes itself to be there
WITHIN = 1.0  # metres within which it must be then
FASTEST = np.float32([1.5, 0.8, 1.2])  # the policy's command
SEEN = gym.spaces.Dict(
    point=gym.spaces.Box(-np.inf, np.inf, (2,)), state=gym.spaces.Box(-np.inf, np.inf, (48,))
)


class Missions(PoolWrapper):
    """Dogs that walk to four points each. Places are complex: metres east, and i metres north.

    Observations: a dog's ``state``, and its next ``point``, metres forward and left of it. A dog
    reckons its place: it adds up the noisy velocities in ``state``. The simulator's exact ones give
    the true place.
    """

    def __init__(self, num_envs, threads, seed):
        steps = int(POINTS * SECONDS / DT) + 1  # EnvPool's own limit is 1,000
        name = "Go1JoystickFlatTerrain-v1"
        super().__init__(
            sw.envs.envpool(name, num_envs, threads, seed, max_episode_steps=steps), SEEN
        )
        self.rngs = [np.random.default_rng([seed, i]) for i in range(num_envs)]
        self.points = np.zeros((num_envs, POINTS), complex)
        self.place, self.true = np.zeros((2, num_envs), complex)
        self.heading, self.true_heading = np.zeros((2, num_envs))
        self.reached, self.found, self.waited = np.zeros((3, num_envs), np.int64)
        self.trails = [[] for _ in range(num_envs)]

    def reset(self, ids):
        for i in ids:  # each point is 3 to 6 metres from the one before
            angle, metres = self.rngs[i].uniform((-np.pi, 3), (np.pi, 6), (POINTS, 2)).T
            self.points[i] = np.cumsum(metres * np.exp(1j * angle))
            self.trails[i] = [0j]
        for numbers in (self.place, self.true, self.heading, self.true_heading):
            numbers[ids] = 0
        for numbers in (self.reached, self.found, self.waited):
            numbers[ids] = 0
        return super().reset(ids)

    def see(self, obs, ids):
        point = self.way(self.place, ids) * np.exp(-1j * self.heading[ids])
        return {"state": obs["state"], "point": np.stack([point.real, point.imag], axis=1)}

    def step(self, action, ids):
        before = np.abs(self.way(self.place, ids))
        obs, _, fell, late, _ = self.pool.step(action, ids)
        state, exact = obs["state"], obs["privileged_state"]
        walk(self.place, self.heading, ids, state[:, 0:2], state[:, 5])
        walk(self.true, self.true_heading, ids, exact[:, 57:59], exact[:, 62])
        after = np.abs(self.way(self.place, ids))
        there = after < NEAR
        self.found[ids] += there & (np.abs(self.way(self.true, ids)) < WITHIN)
        self.reached[ids] += there
        self.waited[ids] = np.where(there, 0, self.waited[ids] + 1)
        for i in ids:
            self.trails[i].append(self.true[i])
        info = {
            "reached": self.reached[ids],
            "found": self.found[ids],
            "drift": np.abs(self.place - self.true)[ids],
            "success": self.reached[ids] == POINTS,
        }
        reward = (0.1 * (before - after) + there).astype(np.float32)
        late = late | (self.waited[ids] >= SECONDS / DT)
        return self.see(obs, ids), reward, fell | info["success"], late, info

    def way(self, place, ids):
        """Return the ways from places to the next points, (k,) complex."""
        return self.points[ids, np.minimum(self.reached[ids], POINTS - 1)] - place[ids]

    def render(self, ids):
        """Return missions from above: the points, the true way so far, and the dog."""
        return np.stack([self.picture(i) for i in ids])

    def picture(self, i):
        picture = Image.new("RGB", (480, 480), "white")
        draw = ImageDraw.Draw(picture)
        east, north = ([0, *part] for part in (self.points[i].real, self.points[i].imag))
        middle = (min(east) + max(east) + 1j * (min(north) + max(north))) / 2
        metre = 480 / (3 + max(np.ptp(east), np.ptp(north)))

        def pixels(place):
            return 240 + metre * (place - middle).real, 240 - metre * (place - middle).imag

        for number, point in enumerate(self.points[i]):
            color = "#78be82" if number < self.reached[i] else "#e0e4ea"
            draw.circle(pixels(point), metre * WITHIN, color, "#3c4250")
            draw.text(pixels(point), str(number + 1), "black", anchor="mm", font_size=18)
        draw.line([pixels(place) for place in self.trails[i]], "#3c64c8", 3)
        half = 0.4 * np.exp(1j * self.true_heading[i])
        tail, nose = pixels(self.true[i] - half), pixels(self.true[i] + half)
        draw.line([tail, nose], "#e66e28", 9)
        draw.circle(nose, 8, "#e66e28")
        return np.asarray(picture)


def walk(place, heading, ids, velocity, turn):
    """Move by a step with velocities forward and left (k, 2), and a turn."""
    heading[ids] += DT * turn
    place[ids] += DT * (velocity[:, 0] + 1j * velocity[:, 1]) * np.exp(1j * heading[ids])


class Walk(sw.Skill):
    """Walk with a velocity."""

    goal_space = gym.spaces.Box(-FASTEST, FASTEST)

    def __init__(self, path):
        self.policy = sw.from_onnx(path, sees=(sw.Part("state", slice(0, 45)), sw.Goal()))


def steer(obs):
    """Return the velocity that leads to the point: a selector that is a rule."""
    forward, left = obs["point"].T
    turn = np.arctan2(left, forward)
    ahead = np.where(np.abs(turn) < 0.6, 1.0, 0.2)
    goal = np.stack([ahead, np.zeros(len(obs)), np.clip(2 * turn, -1.2, 1.2)], axis=1)
    return np.full(len(obs), "walk"), goal


def score(run, env, episodes):
    """Print how many points the dogs reach, by their own reckoning and in truth."""
    ends = {"reached": [], "found": [], "drift": []}

    def watch(played):
        for name, values in ends.items():
            values.extend(played.step.info[name][played.over])

    found = sw.evaluate(run.policy, env, episodes=episodes, engine="envpool", watch=watch)
    print(found)
    print(f"points reached: {np.sum(ends['reached']) / POINTS / episodes:.0%}")
    print(f"within {WITHIN} m in truth: {np.sum(ends['found']) / POINTS / episodes:.0%}")
    print(f"drift of the reckoning at the end: {np.mean(ends['drift']):.2f} m")


def main():
    """Train the selector, and walk missions that it never saw."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("path", help="the walking policy, an ONNX file")
    parser.add_argument("--steps", type=int, default=300_000, help="of the environment")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=32)
    parser.add_argument("--out", default=None)
    parser.add_argument("--by-hand", action="store_true", help="steer by a rule, without training")
    parser.add_argument("--flat", action="store_true", help="PPO moves the joints, without a skill")
    args = parser.parse_args()
    env = sw.EnvSpec(one_of(Missions), pool=Missions)
    if args.flat:
        flat = sw.PPO(
            num_envs=64,
            n_steps=64,
            batch_size=256,
            update_epochs=10,
            learning_rate=1e-3,
            gamma=0.998,
        )
        run = sw.train_agent(env, flat, args.steps, args.out, seed=args.seed)
    else:
        learnt = sw.PPO(  # it sees the point alone
            num_envs=16,
            n_steps=640,
            batch_size=128,
            update_epochs=10,
            learning_rate=1e-3,
            gamma=0.998,
            network=sw.Network(sees=(0, 1)),
        )
        hierarchy = sw.Hierarchy(
            env,
            [Walk(args.path)],
            call_steps=20,  # the selector decides each 0.4 seconds
            selector=steer if args.by_hand else learnt,
            steps=args.steps,
        )
        run = hierarchy.train(args.out, seed=args.seed)
    score(run, env, args.episodes)
    print(run.render())
    print(run.report(episodes=4, films=1)["verdict"])


if __name__ == "__main__":
    main()
