"""Skills that own a part of observations and actions: trained, resumed, nested, called, logged."""

from __future__ import annotations

import functools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from crane import ON, SMALL, Arm, Crane, Hook, acted, crane, goes_on_and_loads
from playing import episode
from small_runs import reports_every

import skillweave as sw
from skillweave.errors import RunError, SkillError
from skillweave.evolution import Evolution
from skillweave.hierarchy.roles import roles_of
from skillweave.runs.directory import RunDirectory
from skillweave.schema import as_json

often = reports_every(40)
OFF = {"num_envs": 4, "batch_size": 16, "learning_starts": 20, "buffer_size": 500}
OFTEN = sw.TrainDefaults(checkpoint_every=60)
RECURRENT = sw.PPO(
    num_envs=4, n_steps=16, batch_size=32, network=sw.Network((8,), rnn=sw.algorithms.RNN("gru", 6))
)
SAC = sw.SAC(**OFF, network=SMALL)
DQN = sw.DQN(**OFF, train_freq=2, network=SMALL)


def on(kind: str = "box", masked: bool = False) -> Any:
    return sw.EnvSpec(functools.partial(Crane, kind, masked), engine="sync", workers=1)


def actions_of(policy: Any) -> tuple[Any, list[str]]:
    """Return the actions of an episode (20, 3), and the skills that acted."""
    player = sw.Player(policy)
    told = [(action, policy.acts(player.memory)) for (action,) in episode(Crane(), player)]
    actions, skills = zip(*told, strict=True)
    return np.array(actions), list(skills)


def in_turn(obs: Any) -> Any:
    """Call arm, then hook, and so on: the camera shows the time."""
    return np.where(obs["camera"][:, 0, 0, 0] // 4 % 2 == 0, "arm", "hook")


@pytest.mark.parametrize("learn", ["together", "apart"])
def test_each_skill_learns_on_its_own_numbers(learn):
    hierarchy = crane(learn=learn, selector=in_turn)
    roles = roles_of(hierarchy)
    assert roles["arm"].action_space.shape == (2,)
    assert roles["arm"].observation_space == Crane.observation_space["arm"]
    run = hierarchy.train(quiet=True)
    arm, hook = run.policy.skills.policies
    assert arm.algorithm.action_space.shape == (2,)
    assert hook.algorithm.observation_space.shape == (4,)
    actions, names = actions_of(run.policy)
    assert names == (["arm"] * 4 + ["hook"] * 4) * 2 + ["arm"] * 4
    is_arm = np.array(names) == "arm"
    assert (actions[is_arm, 2] == 0).all()
    assert (actions[~is_arm, :2] == 0).all()
    assert actions[is_arm, :2].any()
    assert actions[~is_arm, 2].any()
    alone = run.evaluate(2, skill="arm")
    assert alone.skills["arm"].calls == 2


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> sw.Run:
    """A run in which the rest of the action is held."""
    folder = tmp_path_factory.mktemp("held")
    return crane(selector=in_turn, rest="hold").train(folder, quiet=True)


@pytest.mark.parametrize("skill", ["arm", "hook"])
def test_a_skill_alone_acts_as_in_the_hierarchy(skill, held):
    actions = acted(held.player(skill=skill))
    assert (actions[:, 2 if skill == "arm" else 0] == 0).all()
    assert actions.any()


ALGORITHMS: dict[str, tuple[str, dict[str, Any]]] = {
    "PPO, together": ("box", {"learn": "together"}),
    "PPO, apart": ("box", {"learn": "apart"}),
    "PPO, recurrent": ("box", {"algorithm": RECURRENT}),
    "PPO, several": ("several", {}),
    "PPO, bits": ("bits", {}),
    "SAC": ("box", {"algorithm": SAC, "learn": "apart"}),
    "TD3": ("box", {"algorithm": sw.TD3(**OFF, network=SMALL), "learn": "apart"}),
    "DQN": ("one", {"algorithm": DQN, "learn": "apart"}),
    "SAC, discrete": ("one", {"algorithm": SAC, "learn": "apart"}),
    "goals, together": ("box", {"learn": "together"}),
    "goals, apart": ("box", {"learn": "apart"}),
    "nested, together": ("box", {"learn": "together"}),
    "nested, apart": ("box", {"learn": "apart"}),
}


class Sideways(sw.Skill):
    """A skill with goals and a part."""

    sees, acts = "arm", (0, 1)
    goal_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    max_steps = 8

    def reward(self, step):
        return -np.abs(step.next_obs["arm"] - step.goal).sum(axis=1)


def skills_for(name: str, kind: str, env: Any, learn: Any) -> Any:
    if name.startswith("goals"):
        return [Sideways(), Hook()]
    if name.startswith("nested"):
        inner = crane([Arm(), Hook()], env=env, rest="hold", name="inner", learn=learn)
        return [inner, type("Whole", (sw.Skill,), {})()]
    if kind != "one":
        return [Arm(), Hook()]
    left, right = type("Left", (Arm,), {"acts": (0, 2)})(), type("Right", (Hook,), {"acts": 3})()
    return [left, right, type("All", (sw.Skill,), {})()]


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_stopped_run_ends_with_the_same_weights(name, tmp_path):
    kind, how = ALGORITHMS[name]

    def hierarchy() -> sw.Hierarchy:
        rest = {} if kind == "one" or name.startswith("nested") else {"rest": "hold"}
        env = on(kind)
        defaults = {"env": env, "train_defaults": OFTEN}
        return crane(skills_for(name, kind, env, how.get("learn")), **(defaults | rest | how))

    goes_on_and_loads(hierarchy, tmp_path)


def test_a_run_without_its_code_has_the_parts(tmp_path):
    class Arm(sw.Skill):
        sees, acts = "arm", (0, 1)

    class Hook(sw.Skill):
        sees, acts = {"a": "hook", "b": "camera"}, slice(2, 3)

    gym.register("Crane-v0", Crane)
    try:
        env = sw.EnvSpec("Crane-v0", engine="sync", workers=1)
        hierarchy = crane([Arm(), Hook()], env=env, rest="hold", steps=130)
        run = hierarchy.train(tmp_path / "run", quiet=True)
        loaded = sw.Hierarchy.from_manifest(as_json(RunDirectory.open(tmp_path / "run").manifest))
        assert loaded.rest == "hold"
        again = loaded.load(tmp_path / "run")
        assert again.evaluate(3).returns == run.evaluate(3).returns
    finally:
        gym.registry.pop("Crane-v0")


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize(
    ("skills", "rest", "says"),
    [
        ([type("Arm", (Arm,), {"acts": (0, 2)})(), Hook()], "hold", "skill 'arm'.*with acts"),
        ([type("Arm", (Arm,), {"sees": "hook"})(), Hook()], "hold", "skill 'arm'.*with sees"),
        ([Arm(), Hook()], "zero", "skill 'arm'.*with rest 'hold', but now it is 'zero'"),
    ],
)
def test_other_parts_are_not_loaded(skills, rest, says, tmp_path):
    run = crane(rest="hold").train(tmp_path / "run", quiet=True)
    other = crane(skills, rest=rest)
    with pytest.raises(RunError, match=says):
        other.load(run.path)
    file = run.save_weights(tmp_path / "weights.safetensors")
    with pytest.raises(RunError, match=says):
        other.load_weights(file)


@pytest.fixture(scope="module")
def learnt(tmp_path_factory):
    path = tmp_path_factory.mktemp("run")
    return crane([Arm(), Hook()], learn="apart", steps=200).train(path, quiet=True)


OTHERS: list[tuple[dict[str, Any], str]] = [
    ({"sees": (1, 2)}, r"sees was .*'arm'.*, and here it is .*\[1, 2\]"),
    ({"policy": sw.Residual(lambda obs: np.zeros((len(obs), 2)))}, "residual was None.* 0.2"),
    ({"acts": (0, 2)}, r"acts was '0:2', and here it is \[0, 2\]"),
]


def test_a_skill_does_not_start_with_what_it_learnt_on_another_part(learnt):
    where = r"start_from: 'arm' cannot start with what it learnt in .*"
    for changes, says in OTHERS:
        moved = crane([type("Arm", (Arm,), changes)(), Hook()], learn="apart", steps=200)
        with pytest.raises(RunError, match=rf"{where}its {says}.*'arm' begins new"):
            moved.train(start_from=learnt, quiet=True)
    started = moved.train(start_from={"hook": learnt}, quiet=True)
    assert [set(stage.get("starts", {})) for stage in started.info()["stages"]][:2] == [
        set(),
        {"hook"},
    ]
    again = crane([Arm(), Hook()], learn="apart", steps=200, rest=0.5)
    run = again.train(start_from=learnt, quiet=True)
    assert "arm" in run.info()["stages"][0]["starts"], "the rest is no part of it"


def test_ready_skills_have_parts(tmp_path):
    class Push(sw.Skill):
        """Pushes the arm back to the middle."""

        sees, acts = "arm", (0, 1)

        def policy(self, obs):
            assert obs.shape[1:] == (2,)
            return -0.5 * obs

    class Lift(sw.Skill):
        """A policy from elsewhere, with a mapping of its own of the part."""

        sees, acts = ("hook", "arm"), 2
        policy = sw.from_function(
            lambda x: x, sees=sw.Part(places=(0,)), acts=sw.Acts(scale=0.25, offset=0.5)
        )

    run = crane([Push(), Lift(), Arm()], selector=ON).train(tmp_path / "run", quiet=True)
    env = Crane()
    for skill, numbers in (("push", slice(0, 2)), ("lift", slice(2, 3))):
        player = run.player(skill=skill)
        obs, _ = env.reset(seed=2)
        action = player.act(obs)
        wanted = -0.5 * obs["arm"] if skill == "push" else 0.25 * obs["hook"] + 0.5
        assert np.allclose(action[numbers], np.clip(wanted, -1, 1))
        assert np.count_nonzero(action) == np.count_nonzero(wanted)


def test_calls_come_first_and_the_rest_is_held_on(tmp_path):
    class Late(Arm):
        """Starts after calls of others."""

        def initiation(self, obs):
            return obs["camera"][:, 0, 0, 0] >= 4

    class Down(Hook):
        """Lowers the hook."""

        def policy(self, obs):
            return np.full((len(obs), 1), -0.5, np.float32)

    late = type("Spy", (Late,), {"name": "late"})()
    seen = []
    late.reward = lambda step: seen.append(step.action.copy()) or -np.abs(step.action).sum(axis=1)
    hierarchy = crane(
        [Down(), late],
        selector=lambda obs: np.full(len(obs), "down"),
        learn="apart",
        rest="hold",
        steps=300,
        apart=sw.Apart(start_calls=1),
    )
    hierarchy.train(tmp_path / "run", quiet=True)
    held = np.concatenate(seen)[:, 2]
    assert (held == -0.5).mean() > 0.5


def test_a_mask_that_forbids_the_rest_is_an_error():
    with pytest.raises(SkillError, match=r"skill 'hook'.*forbids the value 0 at place 0.*rest"):
        crane([Hook()], env=on("several", True)).train(quiet=True)
    # Zero of place 0 is forbidden in some steps, one in others, two never.
    run = crane([Hook()], env=on("several", True), rest=(2, 0, 0)).train(quiet=True)
    assert run.evaluate(1).returns


def to_the_middle(obs: Any) -> Any:
    return np.concatenate([-0.5 * obs["arm"], -0.25 * obs["hook"]], axis=1)


Corrects = type(
    "Corrects", (Arm,), {"sees": None, "acts": None, "policy": sw.Residual(to_the_middle)}
)


@pytest.mark.slow
@pytest.mark.parametrize(("first", "size"), [(Arm, 2), (Corrects, 3)])
def test_a_population_learns(first, size, tmp_path):
    skill = first()
    evolve = {skill.name: Evolution(population=2, generations=2)}
    hierarchy = crane([skill, Hook()], learn="apart", rest="hold", steps=1200)
    run = hierarchy.train(tmp_path / "run", evolve=evolve, quiet=True)
    assert run.policy.skills.policies[0].action_space.shape == (size,)
    assert run.evaluate(2).returns


def test_calls_are_logged(held):
    log = held.log_calls(200)
    assert log.action.shape[1:] == (3,)
    log.check_skills(held.policy.skills)
    other = crane(selector=in_turn).train(quiet=True)
    with pytest.raises(RunError, match="has changed since the log was recorded"):
        log.check_skills(other.policy.skills)
