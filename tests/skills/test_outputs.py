"""What foreign policies return: checked, or read as logits."""

import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete

from skillweave.errors import SkillweaveError
from skillweave.policies.core import Turn, World
from skillweave.policies.mapped import Outputs
from skillweave.policies.spaces import space_of

UNIT = Box(-1.0, 1.0, (2, 3), np.float32)


def decoded(output, n, space, who, *, mask=None, deterministic=True, rng=None):
    """Actions for the outputs of a network."""
    outputs = Outputs(space_of(space), logits=True, who=who)
    return outputs(output, n, mask, Turn(World(rng), mask, None, deterministic))[0]


@pytest.mark.parametrize(
    ("value", "space", "says"),
    [
        (np.zeros((2, 1), int), Discrete(3), r"shape \(2, 1\), but \(2,\).*Discrete\(3\)"),
        (np.zeros(3, int), Discrete(3), r"shape \(3,\)"),
        (np.zeros(2), Discrete(3), "float64, but actions of.*whole numbers"),
        (["a", "b"], Discrete(3), "whole numbers"),
        ([0, 3], Discrete(3), "returned 3, which is no action"),
        ([0, 1.5], Discrete(3), "whole numbers"),
        ([[np.nan, 1]] * 2, Box(0, 2, (2,), np.int64), "whole numbers"),
        ([0, 3], Discrete(3, start=1), "returned 0"),
        ([[0, 0], [1, 3]], MultiDiscrete([2, 3]), "returned 3"),
        ([[0, 2], [0, 0]], MultiBinary(2), "returned 2"),
        (np.zeros((2, 6)), UNIT, r"shape \(2, 6\), but \(2, 2, 3\)"),
        (np.full((2, 2, 3), np.nan), UNIT, "a NaN or an infinity"),
        (np.zeros((2, 2, 3), complex), UNIT, "complex128, but.*are numbers"),
    ],
)
def test_what_is_no_action_is_said_with_the_space(value, space, says):
    with pytest.raises(SkillweaveError, match=f"skill 'x'.*{says}") as raised:
        space_of(space).actions(value, 2, "skill 'x'")
    assert str(space) in str(raised.value) or "NaN" in says


def test_what_is_an_action_gets_the_type_of_the_space_and_a_box_its_bounds():
    found = space_of(Discrete(2)).actions([True, False], 2, "")
    assert (found.dtype, found.tolist()) == (np.int64, [1, 0])
    found = space_of(UNIT).actions(np.full((1, 2, 3), 7), 1, "")
    assert (found.dtype, found.min()) == (np.float32, 1.0)


def test_logits_are_read_by_space():
    def greedy(output, space):
        return decoded(np.array(output), len(output), space, "net").tolist()

    assert greedy([[0.0, 2.0, 1.0], [3.0, 2.0, 1.0]], Discrete(3)) == [1, 0]
    assert greedy([[0.0, 2.0, 1.0]], Discrete(3, start=-1)) == [0]
    assert greedy([[0.0, 1.0, 5.0, 4.0, 6.0]], MultiDiscrete([2, 3])) == [[1, 2]]
    assert greedy([[0.1, -0.1]], MultiBinary(2)) == [[1, 0]]
    assert greedy([[2, 0]], MultiDiscrete([3, 3])) == [[2, 0]]  # whole numbers: actions
    assert greedy([[2], [1]], Discrete(3)) == [2, 1]
    assert np.array(greedy([[0.5] * 6], UNIT)).shape == (1, 2, 3)
    with pytest.raises(SkillweaveError, match=r"net returned shape \(2, 4\).*\(2, 3\).*Discrete"):
        greedy(np.zeros((2, 4)), Discrete(3))
    with pytest.raises(SkillweaveError, match="net returned NaN"):
        greedy(np.full((2, 3), np.nan), Discrete(3))


@pytest.mark.parametrize("space", [Discrete(2, start=3), MultiDiscrete([2, 2]), MultiBinary(1)])
def test_sampling_follows_the_logits_and_the_generator(space):
    logits = {1: [0.0, np.log(3.0)], 2: [0.0, np.log(3.0)] * 2}
    row = [np.log(3.0)] if isinstance(space, MultiBinary) else logits[1 + len(space.shape)]
    output = np.tile(row, (20_000, 1))

    def sampled(seed):
        rng = np.random.default_rng(seed)
        return decoded(output, len(output), space, "", deterministic=False, rng=rng)

    start = getattr(space, "start", 0)
    np.testing.assert_allclose((sampled(0) - start).mean(0), 0.75, atol=0.01)
    assert (sampled(0) == sampled(0)).all()
    assert (sampled(0) != sampled(1)).any()


def test_what_is_masked_is_never_chosen():
    mask, output = np.array([[True, False, True]] * 500), np.tile([0.0, 9.0, 1.0], (500, 1))
    assert set(decoded(output, 500, Discrete(3), "", mask=mask).tolist()) == {2}
    rng = np.random.default_rng(0)
    some = decoded(output, 500, Discrete(3), "", mask=mask, deterministic=False, rng=rng)
    assert set(some.tolist()) == {0, 2}
