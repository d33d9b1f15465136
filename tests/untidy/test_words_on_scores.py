"""Numbers of an evaluation that would flatter are told with what they mean."""

import gymnasium as gym
import numpy as np
import pytest
from timed import SMALL, Timed

import skillweave as sw
from skillweave.errors import DeclarationError
from skillweave.reporting.facts import verdict

STILL = sw.from_function(lambda obs: np.zeros(len(obs), int))


class Passes(Timed):
    """Succeeds in its third step alone."""

    def step(self, action):
        *step, _ = super().step(action)
        return *step, {"success": self.t == 3}

    def show(self):
        return self.np_random.uniform(-1, 1, 1).astype(np.float32)


def test_success_in_some_step_is_told_beside_success_at_the_end():
    found = sw.evaluate(STILL, Passes, episodes=6)
    assert (found.succeeded, found.succeeded_once) == (0, 6)
    assert found.to_json()["success_once_rate"] == 1
    assert "0% succeed at the end (100% in some step)" in str(found)
    assert "100 % succeed in some step" in verdict(found, True)


class Late(Timed):
    """Differs in its last step alone."""

    def step(self, action):
        obs, reward, *ends, info = super().step(action)
        return obs, reward + (self.t == 10) * float(self.np_random.normal()), *ends, info


@pytest.mark.parametrize("num_envs", [1, 4])
@pytest.mark.parametrize(("env", "alike"), [(Timed, True), (Late, False), (Passes, False)])
def test_episodes_that_are_all_alike_have_no_interval(env, alike, num_envs):
    found = sw.evaluate(STILL, env, episodes=6, num_envs=num_envs)
    assert found.all_alike is alike
    assert (found.to_json()["ci95"] is None) is alike
    assert ("same in every step" in str(found)) is alike
    assert ("95 % CI" in str(found)) is not alike
    assert ("same in every step" in verdict(found, True)) is alike
    assert not sw.evaluate(STILL, env, episodes=1).all_alike


class Far(Timed):
    """Pays far less than float32 can hold, and shows it."""

    def step(self, action):
        _, _, *rest = super().step(action)
        return np.array([1e-300]), 1e-300, *rest


class Less(sw.Skill):
    def reward(self, step):
        return np.full(len(step.reward), 1e-300)


class Divides(Timed):
    def step(self, action):
        np.zeros(1) / np.zeros(1)
        return super().step(action)


def test_floats_are_handled_as_usual_in_the_library_and_as_set_in_the_program(tmp_path):
    with np.errstate(all="raise"):
        sw.train_agent(sw.EnvSpec(Far, workers=1), SMALL, 128, tmp_path / "flat", quiet=True)
        spec = sw.EnvSpec(Far, workers=1)
        hierarchy = sw.Hierarchy(spec, [Less()], steps=128, algorithm=SMALL, selector=SMALL)
        hierarchy.train(tmp_path / "tree", quiet=True).evaluate(2)
        assert set(np.geterr().values()) == {"raise"}
        with pytest.raises(sw.SkillweaveError, match="FloatingPointError"):
            sw.evaluate(STILL, Divides, episodes=1)


class Parts(Timed):
    observation_space = gym.spaces.Dict(
        state=gym.spaces.Box(-1, 1, (2,), np.float32), left=gym.spaces.Discrete(3)
    )

    def show(self):
        return {"state": np.zeros(2, np.float32), "left": 2}


@pytest.mark.parametrize(
    ("left", "says"),
    [(7, r"obs\['left'\] is 7, which is not in Discrete\(3\)"), (-1, "-1"), (1.5, "cannot hold")],
)
def test_a_choice_out_of_its_space_is_named(left, says, tmp_path):
    run = sw.train_agent(sw.EnvSpec(Parts, workers=1), SMALL, 64, tmp_path / "run", quiet=True)
    with pytest.raises(DeclarationError, match=says):
        run.act({"state": np.zeros(2), "left": left})
    assert run.act({"state": np.zeros(2), "left": 2.0}) in (0, 1)


class Up(sw.Skill):
    def policy(self, obs):
        return np.ones(len(obs), int)


def declared(call_steps=5, **limits):
    skill = Up()
    for name, value in limits.items():
        setattr(skill, name, value)
    return sw.Hierarchy(Timed, [skill], call_steps=call_steps, selector=lambda obs: [0] * len(obs))


def test_changed_limits_of_calls_are_said_by_load(tmp_path, recwarn):
    declared().train(tmp_path / "run", quiet=True)
    sw.load(tmp_path / "run", declared())
    assert not [w for w in recwarn if "limits" in str(w.message)]
    for changed, says in (
        (declared(9), "call_steps is 5 .declared now: 9"),
        (declared(max_steps=3), "max_steps of skill 'up' is None .declared now: 3"),
    ):
        with pytest.warns(match=says):
            sw.load(tmp_path / "run", changed)


class Ends(Up):
    call_steps = None

    def termination(self, step):
        return step.elapsed >= 7


class Again(Ends):
    call_steps = 3


class Undone(Again):
    call_steps = None


class Endless(Up):
    call_steps = None


class Plain(Up):
    termination = Ends.termination


def set_by_a_program():
    skill = Plain()
    skill.call_steps = None
    return skill


@pytest.mark.parametrize(
    ("make", "how", "told"),
    [
        (Ends, {}, True),
        (type("Below", (Ends,), {}), {}, True),
        (Ends, {"call_steps": 5}, False),
        (Ends, {"call_steps": None}, False),
        (Again, {}, False),
        (Undone, {}, False),
        (Endless, {}, False),
        (Plain, {}, False),
        (set_by_a_program, {}, False),
    ],
)
def test_call_steps_of_none_in_a_skill_is_said_to_be_the_hierarchys(make, how, told, recwarn):
    sw.Hierarchy(Timed, [make()], selector=lambda obs: [0] * len(obs), **how)
    texts = [str(w.message) for w in recwarn]
    assert ["it means the hierarchy's call_steps, 40" in text for text in texts] == [True] * told


def test_the_options_env_names_what_is_to_be_called_first():
    env = sw.envs.make_options_env(declared(), num_envs=2, gamma=0.9)
    with pytest.raises(DeclarationError, match="call reset"):
        env.step(np.zeros(2, int))
    env.reset(seed=0)
    env.step(np.zeros(2, int))
    env.close()
    for call in (lambda: env.step(np.zeros(2, int)), env.reset):
        with pytest.raises(DeclarationError, match="closed"):
            call()
