"""The shuttle's suite: cells of what was seen."""

from __future__ import annotations

import numpy as np

from benchmarks.pay.shuttle import cells
from skillweave.recipes import _cheetah as cheetah


def seen(metres, speed, leg):
    """An observation this far beyond the point that is run to."""
    obs = np.zeros((1, cheetah.LEG.stop), np.float32)
    obs[0, cheetah.X] = cheetah.to_log(np.array([metres]))[0]
    obs[0, cheetah.SPEED], obs[0, cheetah.LEG.start + leg] = speed, 1.0
    return obs


def test_a_cell_is_a_metre_two_metres_a_second_and_a_leg():
    obs = [seen(0.5, 0.5, 0), seen(-0.5, 3.0, 1), seen(5.5, -0.5, 2)]
    assert cells(np.concatenate(obs)).tolist() == [[0, 0, 0], [-1, 1, 1], [5, -1, 2]]
