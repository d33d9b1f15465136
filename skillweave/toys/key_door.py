"""``KeyDoor``: fetch a key, open a door with it, leave."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.toys.drawing import Array, Canvas

SPEED = 0.05
"""The longest way in one step, along x and along y."""
RADIUS = 0.07
"""The agent's."""
WALL = 0.2
"""The wall's x."""
GAP = 0.2
"""Half the height of the gap in the wall, which is around y = 0."""
TOUCH = 0.14
"""Distance at which the agent takes the key."""
UNLOCK = 0.25
"""Distance from the middle of the door at which the agent opens it, if it has the key."""
EXIT_X, EXIT_Y = 0.8, 0.3
"""The exit is where x > 0.8 and |y| < 0.3."""

PIXELS = 320
"""Width and height of a picture."""
EXTENT = 1.15
"""The largest |x| and |y| in a picture."""
MARGIN = 1.07
"""The |x| and |y| at which the outer walls begin in a picture."""
FLOOR = (247, 245, 240)
STONE = (58, 66, 82)
WOOD = (166, 98, 47)
GREEN = (134, 206, 150)
GOLD = (240, 180, 20)
BLUE = (38, 98, 210)
WHITE = (255, 255, 255)
DARK_GREEN = (40, 132, 72)
DARK_GOLD = (140, 98, 0)
DARK_BLUE = (20, 52, 120)


class KeyDoor(gym.Env[Array, Array]):
    """Two rooms: the agent and a key are in the left one, the exit is in the right one.

    The agent takes the key by touching it. With the key it opens the door by coming close to it.
    It starts at a random place of the left room, and so does the key.

    - **Observation**, ``Box`` of six numbers: the agent's x and y, the key's x and y (where it was
      at the start, also after the agent has taken it), 1 if the agent has the key, 1 if the door is
      open. Places range from −1 to 1; the door is at (0.2, 0), the exit around (0.9, 0).
    - **Action**, ``Box`` of two numbers from −1 to 1: the motion along x and y, in units of 0.05.
    - **Reward**: 1 at the exit, where the episode terminates; 0 in every other step.
    - **Truncation**: after ``max_steps`` steps.
    - **info**: ``success`` is true in the step that reaches the exit.

    Args:
        render_mode: "rgb_array" for pictures; None: none.
        max_steps: the longest episode.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 15}  # noqa: RUF012  # Gymnasium's way
    observation_space = gym.spaces.Box(
        np.array([-1, -1, -1, -1, 0, 0], np.float32), np.ones(6, np.float32)
    )
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self, render_mode: str | None = None, max_steps: int = 150) -> None:
        self.render_mode = render_mode
        self.max_steps = max_steps
        self._place = self._key = (0.0, 0.0)
        self._has_key = self._is_open = False
        self._steps = 0
        self._trail: list[tuple[float, float]] = []
        self._ground: Canvas | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Put the agent and the key at random places, and close the door."""
        super().reset(seed=seed)
        x, y, key_x, key_y = self.np_random.uniform((-1, -1, -0.9, -0.9), (0, 1, 0, 0.9)).tolist()
        self._place = (x, y)
        self._key = (key_x, key_y)
        self._has_key = self._is_open = False
        self._steps = 0
        self._trail = []
        self._ground = None
        return self._observation(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Move the agent; at a wall only the motion along it remains."""
        self._steps += 1
        self._trail.append(self._place)
        self._move(*action.tolist())
        self._has_key = self._has_key or math.dist(self._place, self._key) < TOUCH
        at_door = math.dist(self._place, (WALL, 0.0)) < UNLOCK
        self._is_open = self._is_open or (self._has_key and at_door)
        x, y = self._place
        left = x > EXIT_X and abs(y) < EXIT_Y
        out_of_time = self._steps >= self.max_steps
        return self._observation(), float(left), left, out_of_time, {"success": left}

    def render(self) -> Array | None:
        """Return a picture (320, 320, 3) uint8 of both rooms, with a trail behind the agent."""
        if self.render_mode is None:
            return None
        if self._ground is None:
            self._ground = _rooms()
        while self._trail:
            self._ground.paint(self._ground.disc(self._trail.pop(0), 0.013), BLUE, 0.55)
        canvas = self._ground.copy()
        _draw_door(canvas, self._is_open)
        if not self._has_key:
            _draw_key(canvas, *self._key, size=1.0)
        x, y = self._place
        canvas.paint(canvas.disc((x, y), RADIUS + 0.012), DARK_BLUE)
        canvas.paint(canvas.disc((x, y), RADIUS - 0.006), BLUE)
        if self._has_key:
            _draw_key(canvas, x, y, size=0.62)
        return canvas.frame()

    def _move(self, right: float, up: float) -> None:
        """Move the agent as far as walls and the door let it."""
        x, y = self._place
        new_x = min(max(x + SPEED * min(max(right, -1.0), 1.0), -1.0), 1.0)
        new_y = min(max(y + SPEED * min(max(up, -1.0), 1.0), -1.0), 1.0)
        for place in ((new_x, new_y), (x, new_y), (new_x, y)):
            if self._is_free(*place):
                self._place = place
                return

    def _is_free(self, x: float, y: float) -> bool:
        """Return whether the agent is not in the wall there."""
        return abs(x - WALL) >= RADIUS or (self._is_open and abs(y) <= GAP - RADIUS)

    def _observation(self) -> Array:
        numbers = (*self._place, *self._key, self._has_key, self._is_open)
        return np.array(numbers, np.float32)


def _rooms() -> Canvas:
    """Draw what never moves: the floor, the exit and the walls."""
    canvas = Canvas(PIXELS, EXTENT, FLOOR)
    canvas.paint(canvas.box((EXIT_X, -EXIT_Y), (EXTENT, EXIT_Y)), GREEN)
    for height in (-0.08, 0.08):  # an arrow that points outwards
        arrow = canvas.bar((0.9, height), (0.98, 0.0), 0.035)
        canvas.paint(arrow, DARK_GREEN)
    for low, high in (
        ((-EXTENT, MARGIN), (EXTENT, EXTENT)),
        ((-EXTENT, -EXTENT), (EXTENT, -MARGIN)),
        ((-EXTENT, -EXTENT), (-MARGIN, EXTENT)),
        ((MARGIN, EXIT_Y), (EXTENT, EXTENT)),
        ((MARGIN, -EXTENT), (EXTENT, -EXIT_Y)),
        ((WALL - 0.035, GAP), (WALL + 0.035, EXTENT)),
        ((WALL - 0.035, -EXTENT), (WALL + 0.035, -GAP)),
    ):
        canvas.paint(canvas.box(low, high), STONE)
    return canvas


def _draw_door(canvas: Canvas, is_open: bool) -> None:
    """Draw the door: in the gap, or turned into the right room."""
    hinge = (WALL, GAP - 0.02)
    end = (WALL + 2 * GAP - 0.04, GAP - 0.02) if is_open else (WALL, -GAP + 0.02)
    canvas.paint(canvas.bar(hinge, end, 0.06), WOOD)
    lock = (end[0] - 0.06, end[1]) if is_open else (end[0], end[1] + 0.06)
    canvas.paint(canvas.disc(lock, 0.02), GOLD)


def _draw_key(canvas: Canvas, x: float, y: float, size: float) -> None:
    """Draw a key: a ring, a shaft and two teeth, with a dark edge."""
    ring = canvas.ring((x - 0.055 * size, y), 0.045 * size, 0.032 * size)
    shaft = canvas.bar((x - 0.01 * size, y), (x + 0.11 * size, y), 0.028 * size)
    shape = np.minimum(ring, shaft)
    for tooth in (0.07, 0.11):
        start = (x + tooth * size, y)
        end = (x + tooth * size, y - 0.045 * size)
        shape = np.minimum(shape, canvas.bar(start, end, 0.026 * size))
    canvas.paint(shape - 0.012, DARK_GOLD)
    canvas.paint(shape, GOLD)
