"""Key and door: three skills, and a selector that learns when to use which, in half a minute.

python examples/key_door.py
"""

import numpy as np

import skillweave as sw
from skillweave.toys import KeyDoor  # fetch a key, open a door, leave; pays 1 at the exit alone

X, Y, KEY_X, KEY_Y, HAS_KEY, IS_OPEN = range(6)  # the columns of an observation


def progress(step, x, y):  # how much nearer to (x, y) each environment came in this step
    before = np.hypot(step.obs[:, X] - x, step.obs[:, Y] - y)
    return before - np.hypot(step.next_obs[:, X] - x, step.next_obs[:, Y] - y)


class GetKey(sw.Skill):
    def initiation(self, obs):  # where the skill may start
        return obs[:, HAS_KEY] == 0

    def reward(self, step):  # what it maximises
        return progress(step, step.obs[:, KEY_X], step.obs[:, KEY_Y])

    def termination(self, step):  # where it ends
        return step.next_obs[:, HAS_KEY] == 1


class OpenDoor(sw.Skill):
    def initiation(self, obs):
        return (obs[:, HAS_KEY] == 1) & (obs[:, IS_OPEN] == 0)

    def reward(self, step):
        return progress(step, 0.2, 0.0)

    def termination(self, step):
        return step.next_obs[:, IS_OPEN] == 1


class Leave(sw.Skill):
    def initiation(self, obs):
        return obs[:, IS_OPEN] == 1

    def reward(self, step):
        return progress(step, 1.0, 0.0)


hierarchy = sw.Hierarchy(KeyDoor, [GetKey(), OpenDoor(), Leave()], steps=120_000)

if __name__ == "__main__":  # so that other programs can import this file without training
    run = hierarchy.train(seed=0)  # a new folder in runs/
    print(run.evaluate(100))
    run.render("key-door.gif")
