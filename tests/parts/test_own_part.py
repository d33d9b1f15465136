"""The part of observations that a skill sees, and of actions that it writes."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from crane import Crane
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Tuple

import skillweave as sw
from skillweave.errors import DeclarationError, SkillError
from skillweave.skills.own_part import OwnPart, part_from_json, part_to_json, rest_of
from skillweave.spaces import pack

OBS = Crane.observation_space
HIGH = np.array([1.0, 2.0, 3.0], np.float32)
BOX = Box(-HIGH, HIGH)


def skill(sees: Any = None, acts: Any = None) -> sw.Skill:
    return type("X", (sw.Skill,), {"sees": sees, "acts": acts})()


def part(sees: Any = None, acts: Any = None, rest: Any = "zero", space: Any = BOX) -> OwnPart:
    return OwnPart(skill(sees, acts), rest, OBS, space, "skill 'x'")


def observations(n: int = 4) -> Any:
    batch = gym.vector.utils.batch_space(OBS, n)
    batch.seed(1)
    return pack(OBS, batch.sample())


@pytest.mark.parametrize(
    ("sees", "space"),
    [
        ("arm", OBS["arm"]),
        ("camera", OBS["camera"]),
        (("hook", "arm"), Box(-np.inf, np.inf, (3,), np.float32)),
        ("mode", Box(-np.inf, np.inf, (3,), np.float32)),
        ((0, 1), Box(-np.inf, np.inf, (2,), np.float32)),
        (slice(0, 2), Box(-np.inf, np.inf, (2,), np.float32)),
        (sw.Part("arm", scale=0.5), Box(-np.inf, np.inf, (2,), np.float32)),
        (
            {"picture": "camera", "rest": ("hook", "mode")},
            Dict(picture=OBS["camera"], rest=Box(-np.inf, np.inf, (4,), np.float32)),
        ),
    ],
)
def test_what_it_sees_is_in_its_space(sees, space):
    own, obs = part(sees), observations()
    assert own.observation_space == space
    seen = own.part.see(obs)
    again = own.part.see(obs.reshape(2, 2))
    assert again.reshape(seen.shape).tobytes() == seen.tobytes()
    for row in range(4):
        one: Any = seen[row]
        if isinstance(space, Dict):
            one = {name: seen[name][row] for name in space}
        assert space.contains(one)


def test_parts_are_joined_in_their_order():
    obs = observations()
    seen = part(("hook", "arm", "mode", lambda o: 2 * o["hook"])).part.see(obs)
    assert (seen[:, :1] == obs["hook"]).all()
    assert (seen[:, 1:3] == obs["arm"]).all()
    assert (seen[:, 3:6].argmax(1) == obs["mode"]).all()
    assert (seen[:, 6:] == 2 * obs["hook"]).all()
    scaled = part(sw.Part("arm", offset=1.0, scale=2.0)).part.see(obs)
    assert np.allclose(scaled, 2 * (obs["arm"] - 1))


PLACES = (2, 0), [2, 0], np.array([2, 0]), range(2, -1, -2)


@pytest.mark.parametrize("places", PLACES)
def test_places_are_given_in_the_same_kinds_everywhere(places):
    flat = part(slice(0, 3)).part.see(observations())
    assert part(places).part.see(observations()).tolist() == flat[:, [2, 0]].tolist()
    joined = part(("hook", places)).part.see(observations())
    assert joined[:, 1:].tolist() == flat[:, [2, 0]].tolist()
    again = part(sw.Part(places=places)).part.see(observations())
    assert again.tolist() == flat[:, [2, 0]].tolist()
    assert mine(sees=places, acts=places).validate() is None
    outside = sw.from_function(lambda x: x, sees=places, acts=places).mapping
    assert outside == sw.from_function(lambda x: x, sees=(2, 0), acts=(2, 0)).mapping
    for place in (2, np.int64(2)):  # a place alone
        assert part(place).part.see(observations()).shape == (4, 1)
        assert part(acts=place).action_space == Box(BOX.low[[2]], BOX.high[[2]], dtype=np.float32)
        assert sw.from_function(lambda x: x, acts=place).mapping.acts == sw.Acts(to=(2,))
        assert sw.Part(places=place) == sw.Part(places=(2,))


TWO_OF_BOX = Box(BOX.low[[2, 0]], BOX.high[[2, 0]], dtype=np.float32)
MATRIX = Box(-1, 1, (2, 2), np.float64)
SEVERAL = MultiDiscrete([3, 4, 2], start=[1, 0, 5])
LAST_BITS = np.array([[1, 1, 0]], np.int8)
BY_HAND: dict[str, tuple[Any, ...]] = {
    "a box": (BOX, (2, 0), (0.0, 1.5, 0.0), TWO_OF_BOX, [0.5, -0.5], [-0.5, 1.5, 0.5]),
    "by Acts": (BOX, sw.Acts(to=(2, 0)), 0.0, TWO_OF_BOX, [0.5, -0.5], [-0.5, 0, 0.5]),
    "by an array": (BOX, sw.Acts(to=np.array([2, 0])), 0.0, TWO_OF_BOX, [0, 1], [1, 0, 0]),
    "a matrix": (
        MATRIX, slice(1, 3), 0.25, Box(-1, 1, (2,), np.float64),
        [0.5, -0.5], [[0.25, 0.5], [-0.5, 0.25]],
    ),
    "several choices": (
        SEVERAL, (2, 0), (1, 3, 5), MultiDiscrete([2, 3], start=[5, 1]), [6, 3], [3, 3, 6]
    ),
    "bits": (MultiBinary(3), (1,), "hold", MultiBinary(1), [0], [1, 0, 0]),
    "one choice": (Discrete(5, start=10), (4, 1), "zero", Discrete(2), 1, 11),
}  # fmt: skip
"""A space, what is written and the rest; the part's space, an action in it, and the whole one."""


@pytest.mark.parametrize(("space", "acts", "rest", "own", "mine", "whole"), BY_HAND.values())
def test_it_writes_its_part_of_an_action(space, acts, rest, own, mine, whole):
    found = part(acts=acts, space=space, rest=rest)
    assert found.action_space == own
    action = found.part.write(np.array([mine], own.dtype), LAST_BITS)
    assert (action.tolist(), action.dtype) == ([whole], space.dtype)
    assert space.contains(action[0])


MASKS: dict[str, tuple[Any, ...]] = {
    "several": (SEVERAL, (2, 0), [1, 0, 1, 1, 1, 1, 1, 0, 1], [0, 1, 1, 0, 1]),
    "bits": (MultiBinary(3), (1,), [1, 1, 0, 1, 1, 0], [0, 1]),
    "one": (Discrete(5, start=10), (4, 1), [1, 1, 1, 1, 0], [0, 1]),
    "none is left": (Discrete(5, start=10), (4, 1), [1, 0, 1, 1, 0], [1, 1]),
}


@pytest.mark.parametrize(("space", "acts", "mask", "own"), MASKS.values(), ids=MASKS)
def test_it_sees_its_part_of_a_mask(space, acts, mask, own):
    found = part(acts=acts, space=space).part.mask(np.array([mask], bool))
    assert found.tolist() == [[bool(x) for x in own]]


ROBOT = Dict(
    arm=Dict(joints=Box(-1, 1, (2,), np.float32), brake=Discrete(2)),
    hand=Box(0, 1, (1,), np.float32),
)


def test_its_names_of_a_dict():
    own = part(acts="arm", space=ROBOT, rest={"hand": "hold"})
    assert own.action_space == ROBOT["arm"]
    last = pack(ROBOT, {"arm": {"joints": np.ones((1, 2)), "brake": [1]}, "hand": [[0.5]]})
    mine = pack(ROBOT["arm"], {"joints": np.full((1, 2), 0.25), "brake": [0]})
    action = own.part.write(mine, last)
    assert action["arm"]["joints"].tolist() == [[0.25, 0.25]]
    assert action["arm"]["brake"].tolist() == [0]
    assert action["hand"].tolist() == [[0.5]]
    two = part(acts=("arm.brake", "hand"), space=ROBOT)
    assert two.action_space == Dict({"arm.brake": Discrete(2), "hand": ROBOT["hand"]})
    alone = part(acts="arm.joints", space=ROBOT)
    action = alone.part.write(np.full((1, 2), 0.5, np.float32), None)
    assert action["arm"]["joints"].tolist() == [[0.5, 0.5]]
    assert action["hand"].tolist() == [[0.0]]
    pair = Tuple((Box(-1, 1, (1,), np.float32), Discrete(2)))
    assert part(acts="1", space=pair).action_space == Discrete(2)


@pytest.mark.parametrize("space", [BOX, MultiDiscrete([3, 4, 2]), MultiBinary(3), ROBOT])
def test_the_last_action_is_held_as_it_was_and_zero_is_the_nearest_to_zero(space):
    names = tuple(space) if space is ROBOT else slice(None)
    held = part(acts=names, rest="hold", space=space).part
    batch = gym.vector.utils.batch_space(space, 3)
    batch.seed(0)
    actions = pack(space, batch.sample())
    assert held.filled(3, actions).tobytes() == actions.tobytes()
    low, high = np.array([1.0, -3.0], np.float32), np.array([2.0, -1.0], np.float32)
    assert rest_of("zero", Box(low, high))[0].tolist() == [[1.0, -1.0]]  # the nearest
    assert rest_of("zero", MultiDiscrete([3], start=[4]))[0].tolist() == [[4]]


def mine(**attributes: Any) -> sw.Skill:
    return type("Mine", (sw.Skill,), attributes)()


@pytest.mark.parametrize(
    ("attributes", "says"),
    [
        ({"acts": 1.5}, r"skill 'mine'.*acts is 1.5; it must be the places"),
        ({"acts": ()}, r"acts: Acts.to is \(\); it must be"),
        ({"acts": (0, 0)}, "each place of an action can be written once"),
        ({"acts": ("arm", "arm")}, "acts names a part of the action twice"),
        ({"acts": sw.Acts(to=(0,), scale=2.0)}, "acts has a scale.*give the places alone"),
        ({"acts": sw.Acts(to=(0,), rest=0.0)}, r"acts has rest.*Hierarchy\(..., rest=...\)"),
        ({"acts": sw.Acts()}, "it must be the places"),
        ({"acts": lambda self, obs: obs}, r"acts is a function.*policy\(self, obs\)"),
        ({"sees": 1.5}, r"sees is 1.5; it must be the key.*, Part\(...\), or a function"),
        ({"sees": ("arm", None)}, r"sees\[1\] is None; .*, Part\(...\), or a function"),
        ({"sees": ()}, "sees is empty"),
        ({"sees": (0, -1)}, r"Part.places is \(0, -1\); it must be a slice"),
        ({"sees": sw.Goal}, r"sees has Goal\(\).*already: leave it out"),
        ({"sees": ("arm", sw.LastAction())}, r"sees\[1\] has LastAction\(\).*leave it out"),
        ({"acts": range(0)}, "it must be a slice, or a list of places"),
    ],
)
def test_what_a_skill_cannot_declare(attributes, says):
    with pytest.raises(DeclarationError, match=says):
        mine(**attributes).validate()


@pytest.mark.parametrize(
    ("sees", "acts", "rest", "space", "says"),
    [
        (None, 3, "zero", BOX, "acts is .3,., a part of the action that does not exist.* 0 to 2"),
        (None, "arm", "zero", BOX, "acts names 'arm', a part of the action that does not exist"),
        (None, 4, "zero", Discrete(4), "does not exist: .* has places 0 to 3"),
        (None, "leg", "zero", ROBOT, "acts names 'leg'.*does not exist.*arm"),
        (None, ("arm", "arm.brake"), "zero", ROBOT, "a part of the action twice"),
        (None, 0, "zero", ROBOT, "the action has parts with names .'arm', 'hand'."),
        (None, 0, 5.0, BOX, "rest is 5.0, which is out of"),
        (None, 0, (0.0, 1.0), BOX, "rest is .* but the action has 3 numbers"),
        (None, 0, 0.5, MultiDiscrete([2, 2]), "has whole numbers"),
        (
            None,
            (0, 2),
            "hold",
            Discrete(4),
            "rest is 'hold', but an action is one choice.*leave out",
        ),
        (None, "arm", {"leg": 0.0}, ROBOT, "rest has 'leg', which the action does not have"),
        (None, "arm", 0.0, ROBOT, "give a dict by its keys"),
        (None, "arm", None, ROBOT, "rest is None; it must be 'zero', 'hold'"),
        ("legs", None, "zero", BOX, "skill 'x': sees reads 'legs'.*there are: arm"),
        ((9,), None, "zero", BOX, "sees.places is .* but there are 6 numbers"),
        (("arm", "camera"), None, "zero", BOX, "sees joins an image with other parts.*its own"),
    ],
)
def test_what_does_not_fit_the_spaces(sees, acts, rest, space, says):
    with pytest.raises(DeclarationError, match=says):
        part(sees, acts, rest, space)


def test_a_function_that_gives_no_number_is_an_error():
    own = part(("hook", lambda obs: np.where(obs["hook"] == 0.0, np.inf, obs["arm"])))
    obs = observations()
    assert own.part.see(obs).shape == (4, 3)
    obs["hook"][1] = 0.0
    with pytest.raises(SkillError, match=r"skill 'x': sees gives .*inf.*finite numbers"):
        own.part.see(obs)


@pytest.mark.parametrize(
    ("sees", "acts"),
    [
        ("arm", (0, 2)),
        (("arm", slice(0, 2)), slice(0, 2)),
        ({"a": "arm", "b": sw.Part("hook", scale=2.0)}, "hand"),
        (None, ("hand", "arm.brake")),
    ],
)
def test_parts_as_json_are_the_same_parts(sees, acts):
    content = part_to_json(skill(sees, acts), "zero", "x")
    again = skill(**part_from_json(content.get("sees"), content.get("acts")))
    assert part_to_json(again, "zero", "x") == content
