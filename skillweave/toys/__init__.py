"""Small environments to try Skillweave on. They need nothing but Gymnasium and NumPy.

| class | Gymnasium id | task |
|---|---|---|
| `KeyDoor` | `skillweave/KeyDoor-v0` | fetch a key, open a door, leave; pays 1 at the exit |

Importing this package registers the ids.
"""

from __future__ import annotations

import gymnasium as gym

from skillweave.toys.key_door import KeyDoor

__all__ = ["KeyDoor"]

gym.register("skillweave/KeyDoor-v0", entry_point="skillweave.toys.key_door:KeyDoor")
