"""Own parts as data: they refuse what contradicts itself."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from skillweave.policies.acting_errors import PolicyError
from skillweave.policies.core import RowPolicy
from skillweave.policies.mapped import Input, Take
from skillweave.policies.parts import PartOf, Slice
from skillweave.policies.spaces import Space, space_of


def box(*shape: int) -> Space:
    return Space("Box", "float32", shape, np.array(-1.0), np.array(1.0))


BOX, ONE = box(3), Space("Discrete", "int64", (), np.array(0), np.array(4))
BOTH = Space("Dict", parts={"arm": box(2), "hand": ONE})
FIXED = np.zeros((1, 3), np.float32)
SEES = {"": Input((Take("observation", (4,)),), (4,))}
HELD = ((), np.ones(3, bool))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Slice(BOX, box(1), places=(3,), fixed=FIXED), r"Part.places is \(3,\).* 0 to 2"),
        (lambda: Slice(BOX, box(2), places=(0,), fixed=FIXED), "Part.own is "),
        (lambda: Slice(BOX, box(1), places=(0,)), "Part.fixed is None"),
        (lambda: Slice(BOX, box(1), places=(0,), fixed=FIXED[0]), "Part.fixed is .*does not fit"),
        (
            lambda: Slice(BOX, box(1), places=(0,), fixed=FIXED, held=((("x",), HELD[1]),)),
            r"Part.held has \('x',\)",
        ),
        (
            lambda: Slice(BOTH, ONE, paths=((("arm",), ()),), fixed=BOTH.start(1)),
            r"Part.paths has \('arm',\) and \(\), which are not alike",
        ),
        (lambda: Slice(BOX, BOX, SEES), "Part.inputs and Part.sees must be given together"),
        (lambda: Slice(BOX, BOX, SEES, box(3)), "Part.sees is .*does not fit Part.inputs"),
    ],
)
def test_what_contradicts_itself_is_refused(make: Any, says: str) -> None:
    with pytest.raises(PolicyError, match=says):
        make()


def test_what_does_not_fit_the_spaces_is_refused() -> None:
    part = Slice(BOX, box(1), SEES, box(4), 1, (0,), fixed=FIXED, held=(HELD,))
    whole = PartOf(RowPolicy(), part)
    whole.check(box(4), BOX, None, "policy")
    for sees, acts, says in (
        (box(5), BOX, r"policy.part.inputs\[''\] takes the observation of shape \(4,\)"),
        (box(4), box(2), "policy.part.space is Box"),
    ):
        with pytest.raises(PolicyError, match=says):
            whole.check(sees, acts, None, "policy")
    part.axes = 0
    with pytest.raises(PolicyError, match=r"policy.part.axes is 0"):
        whole.check(box(4), BOX, None, "policy")


def test_the_rest_of_choices_is_their_first():
    """Also where choices begin below zero: zero may be one that does something."""
    space = gym.spaces.Dict(
        a=gym.spaces.Discrete(3, start=-1), c=gym.spaces.Box(-1, 1, (1,)), d=gym.spaces.Box(1, 2)
    )
    start = space_of(space).start(2)
    assert start["a"].tolist() == [-1, -1]
    assert (start["c"].tolist(), start["d"].tolist()) == ([[0], [0]], [[1], [1]])
