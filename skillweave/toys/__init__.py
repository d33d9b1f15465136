"""Small environments to try Skillweave on. They need nothing but Gymnasium and NumPy.

| class | Gymnasium id | task |
|---|---|---|
| `KeyDoor` | `skillweave/KeyDoor-v0` | fetch a key, open a door, leave; pays 1 at the exit |
| `Balancer` | `skillweave/Balancer-v0` | a robot on two wheels, for ready policies |

Importing this package registers the ids.
"""

from __future__ import annotations

import gymnasium as gym

from skillweave.toys.balancer import Balancer
from skillweave.toys.key_door import KeyDoor

__all__ = ["Balancer", "KeyDoor"]

gym.register("skillweave/KeyDoor-v0", entry_point="skillweave.toys.key_door:KeyDoor")
gym.register("skillweave/Balancer-v0", entry_point="skillweave.toys.balancer:Balancer")
