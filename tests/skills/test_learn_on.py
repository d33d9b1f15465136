"""A policy from elsewhere with ``learn=True``: a skill begins with its networks, and learns on."""

import gymnasium as gym
import numpy as np
import pytest
import torch
import toys
from small_runs import interrupted

import skillweave as sw
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import AgentPolicy, make_algorithm
from skillweave.errors import DeclarationError, PolicyError, RunError

sb3 = pytest.importorskip("stable_baselines3")


SEEN = gym.spaces.Box(-2, 2, (3,), np.float32)
PUSH = gym.spaces.Box(np.float32([-1.0, 2.0]), np.float32([3.0, 2.5]))


def world(observation=SEEN, action=PUSH):
    """An environment of noise."""
    return toys.World(observation, action)


DISCRETE = gym.spaces.Discrete(3)
SMALL = {
    "PPO": sw.PPO(num_envs=2, n_steps=8, batch_size=16, update_epochs=1),
    "SAC": sw.SAC(num_envs=2, learning_starts=8, batch_size=8),
    "TD3": sw.TD3(num_envs=2, learning_starts=8, batch_size=8),
    "DQN": sw.DQN(num_envs=2, learning_starts=8, batch_size=8),
}
LEARNS_BY = {"PPO": "PPO", "A2C": "PPO", "SAC": "SAC", "TD3": "TD3", "DDPG": "TD3", "DQN": "DQN"}


def model_of(kind, env, **settings):
    torch.manual_seed(1)
    parts = isinstance(env.observation_space, gym.spaces.Dict)
    name = "MultiInputPolicy" if parts else "MlpPolicy"
    model = getattr(sb3, kind)(name, env, seed=3, device="cpu", **settings)
    with torch.no_grad():
        for weights in model.policy.parameters():
            weights.mul_(1.3).add_(0.02)
    return model


def agent_of(learnable, config, env):
    algorithm = make_algorithm(
        learnable.learning_on(config, "skill 'x'"), env.observation_space, env.action_space
    )
    fresh = algorithm.weights(algorithm.init([Seeds(0)]))
    given = learnable.weights(env.action_space)
    return AgentPolicy(algorithm, fresh | {k: torch.from_numpy(v) for k, v in given.items()})


@pytest.mark.parametrize("kind", LEARNS_BY)
def test_it_acts_as_the_model_does(kind):
    env = world(action=DISCRETE if kind in ("DQN", "A2C") else PUSH)
    model = model_of(kind, env)
    if kind == "A2C":
        model.policy.action_net.weight.data.mul_(100)  # fresh logits are nearly equal
    agent = agent_of(sw.from_sb3(model, learn=True), SMALL[LEARNS_BY[kind]], env)
    env.observation_space.seed(0)
    obs = np.stack([env.observation_space.sample() for _ in range(100)])
    actions, _ = agent.act(agent.start(100), obs)
    np.testing.assert_allclose(actions, model.predict(obs, deterministic=True)[0], atol=1e-5)


@pytest.mark.parametrize(
    "space",
    [
        gym.spaces.Discrete(5),
        gym.spaces.MultiDiscrete([3, 2]),
        gym.spaces.MultiBinary(4),
        gym.spaces.Box(-1, 1, (2, 3), np.float32),
        gym.spaces.Dict(
            {"b": gym.spaces.Box(-1, 1, (2,), np.float32), "a": gym.spaces.Discrete(3)}
        ),
    ],
    ids=str,
)
def test_observations_of_other_kinds(space):
    env = world(space, gym.spaces.MultiDiscrete([3, 4]))
    model = model_of("PPO", env)
    model.policy.action_net.weight.data.mul_(100)  # fresh logits are nearly equal
    space.seed(0)
    agent = agent_of(sw.from_sb3(model, learn=True), SMALL["PPO"], env)
    rows = [space.sample() for _ in range(50)]
    obs = np.stack(rows)
    if isinstance(space, gym.spaces.Dict):
        obs = {k: np.stack([row[k] for row in rows]) for k in space.spaces}
    actions, _ = agent.act(agent.start(50), obs)
    np.testing.assert_array_equal(actions, model.predict(obs, deterministic=True)[0])


def test_the_deviation_of_actions_and_the_values_come_along():
    env = world()
    model = model_of("PPO", env)
    agent = agent_of(sw.from_sb3(model, learn=True), SMALL["PPO"], env)
    # The first action spans 4, the second 0.5: in [-1, 1] a deviation is half the span as large.
    std = np.exp(model.policy.log_std.detach().numpy()) / np.array([2.0, 0.25])
    np.testing.assert_allclose(np.exp(agent.weights["actor.log_std"][0]), std, rtol=1e-5)
    obs = torch.randn(20, 3)
    state = agent.algorithm.init([Seeds(0)])
    agent.algorithm.set_weights(state, agent.weights)
    values = agent.algorithm.value(state, obs[None])[0]
    theirs = model.policy.predict_values(obs)[:, 0]
    torch.testing.assert_close(values, theirs, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("given", [True, False])
def test_statistics_of_observations_come_along(given):
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    vec = VecNormalize(DummyVecEnv([world]))
    vec.reset()
    for _ in range(20):
        vec.step([vec.action_space.sample()])
    model = model_of("PPO", vec)
    learnable = sw.from_sb3(model, normalize=vec if given else None, learn=True)
    agent = agent_of(learnable, SMALL["PPO"], world())
    obs = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    theirs = model.predict(vec.normalize_obs(obs), deterministic=True)[0]
    np.testing.assert_allclose(agent.act({}, obs)[0], theirs, atol=1e-5)
    assert learnable.steps == pytest.approx(vec.obs_rms.count, abs=1)


def test_a_sequential_module():
    torch.manual_seed(0)
    module = torch.nn.Sequential(
        torch.nn.Flatten(),
        torch.nn.Linear(3, 8),
        torch.nn.ReLU(),
        torch.nn.Sequential(torch.nn.Linear(8, 4), torch.nn.ReLU()),
        torch.nn.Linear(4, 2, bias=False),
    )
    env = world()
    agent = agent_of(sw.from_torch(module, learn=True), SMALL["PPO"], env)
    obs = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    with torch.no_grad():
        wanted = module(torch.from_numpy(obs)).numpy()
    wanted = wanted.clip(env.action_space.low, env.action_space.high)
    np.testing.assert_allclose(agent.act({}, obs)[0], wanted, atol=1e-5)


def skill(policy, **fields):
    return type("Walk", (sw.Skill,), {"policy": policy, **fields})()


def hierarchy(walk, **settings):
    given = {"algorithm": SMALL["PPO"], "selector": SMALL["PPO"], "steps": 64, "call_steps": 4}
    return sw.Hierarchy(sw.EnvSpec(world, workers=1), [walk], **(given | settings))


def test_a_skill_begins_with_it_and_learns(tmp_path):
    model = model_of("PPO", world())
    walk = skill(sw.from_sb3(model, learn=True), steps=32)
    run = hierarchy(walk, learn="apart").train(tmp_path / "run", quiet=True)
    entry = run.info()["stages"][0]
    assert entry["name"] == "walk"
    assert entry["starts"]["walk"]["run"] is None
    ours = run.policy.skills.policies[0]
    first = model.policy.mlp_extractor.policy_net[0].weight.detach().numpy().T
    moved = np.abs(ours.weights["actor.0.weight"].numpy() - first).max()
    assert 0 < moved < 0.05  # two updates from the model's weights
    again = hierarchy(walk, learn="apart").load(tmp_path / "run")
    obs = np.zeros((4, 3), np.float32)
    np.testing.assert_array_equal(
        again.policy.skills.policies[0].act({}, obs)[0], ours.act({}, obs)[0]
    )


@pytest.mark.parametrize("kind", ["SAC", "DQN"])
def test_off_policy_skills_act_with_it_from_the_start(kind, tmp_path):
    env = world(action=DISCRETE if kind == "DQN" else PUSH)
    walk = skill(sw.from_sb3(model_of(kind, env), learn=True), algorithm=SMALL[kind], steps=32)
    made = sw.Hierarchy(
        sw.EnvSpec(lambda: world(action=env.action_space), workers=1),
        [walk],
        selector=SMALL["PPO"],
        steps=64,
        call_steps=4,
        learn="apart",
    )
    run = made.train(tmp_path / "run", quiet=True)
    assert run.info()["stages"][0]["starts"]["walk"]["steps"] == 0


def test_resumed_it_ends_with_the_same_weights(tmp_path):
    def declared():
        walk = skill(sw.from_sb3(model_of("PPO", world()), learn=True), steps=64)
        return hierarchy(walk, learn="apart", steps=96)

    whole = declared().train(tmp_path / "whole", quiet=True)

    with interrupted(2):
        declared().train(tmp_path / "cut", quiet=True, checkpoint_every=16)
    cut = declared().train(tmp_path / "cut", resume=True, quiet=True)
    for ours, theirs in zip(whole.policy.skills.policies, cut.policy.skills.policies, strict=True):
        for name, value in ours.weights.items():
            torch.testing.assert_close(theirs.weights[name], value, rtol=0, atol=0)


def test_a_plain_agent_starts_from_it(tmp_path):
    model = model_of("PPO", world())
    learnable = sw.from_sb3(model, learn=True)
    config = learnable.learning_on(SMALL["PPO"], "agent")
    run = sw.Agent(world, config, 16).train(tmp_path / "run", start_from=learnable, quiet=True)
    assert "agent" in run.info()["stages"][0]["starts"]
    with pytest.raises(DeclarationError, match=r"write PPO\(.*normalize_obs=False"):
        sw.Agent(world, SMALL["PPO"], 16).train(
            tmp_path / "other", start_from=learnable, quiet=True
        )


def test_other_goals_are_refused(tmp_path):
    reach, place = gym.spaces.Box(-1, 1, (1,), np.float32), world().observation_space
    seen = gym.spaces.Dict([("observation", place), ("goal", reach)])
    model = sb3.PPO("MultiInputPolicy", world(seen), device="cpu")
    module = torch.nn.Sequential(torch.nn.Linear(4, 2))
    for policy in (
        sw.from_sb3(model, learn=True),
        sw.from_torch(module, observation_space=seen, learn=True),
    ):

        def goes(high, policy=policy):
            wide = gym.spaces.Box(-high, high, (1,), np.float32)

            def reward(self, step):
                return step.goal[:, 0]

            return skill(policy, goal_space=wide, reward=reward, steps=16)

        for how in ({}, {"start_from": {"walk": policy}}):
            walk = goes(3.0, None if how else policy)
            with pytest.raises(PolicyError, match=r"'walk': .*was trained for goals of Box\(-1"):
                hierarchy(walk).train(tmp_path / "run", quiet=True, **how)
    run = hierarchy(goes(1.0), learn="apart", steps=32).train(tmp_path / "run", quiet=True)
    assert "walk" in run.info()["stages"][0]["starts"]


def learning(policy, **how):
    return hierarchy(skill(policy, **how)).train(quiet=True)


def with_nan():
    module = torch.nn.Linear(3, 2)
    module.weight.data[0, 0] = float("nan")
    return module


def of(*layers):
    return torch.nn.Sequential(torch.nn.Linear(3, 4), *layers)


FIVE, PIXELS = (
    gym.spaces.Box(-2, 2, (5,), np.float32),
    gym.spaces.Box(0, 255, (36, 36, 3), np.uint8),
)
REFUSED = [
    (lambda: learning(by_sb3("SAC")), "SAC learns on by SAC"),
    (lambda: learning(by_sb3("PPO", world(FIVE))), "'walk'.*observation_space"),
    (lambda: learning(by_torch(torch.nn.Linear(5, 2))), "does not fit 'walk'"),
    (lambda: learning(by_torch(torch.nn.Sequential(torch.nn.Linear(5, 2)))), "actor 5 to 2"),
    (lambda: by_torch(of(torch.nn.Dropout(), torch.nn.Linear(4, 2))), "cannot learn on"),
    (lambda: by_torch(of(torch.nn.Linear(4, 2))), "cannot learn on"),
    (lambda: by_torch(of(torch.nn.Tanh())), "cannot learn on"),
    (lambda: by_torch(of(torch.nn.ELU(5.0), torch.nn.Linear(4, 2))), "cannot learn on"),
    (lambda: by_sb3("PPO", sees=(0, 1, 2), every=2), "leave out sees and every"),
    (lambda: by_torch(torch.nn.Linear(3, 2), every=2), "leave out sees"),
    (
        lambda: sw.from_sb3(
            sb3.PPO("CnnPolicy", world(PIXELS, DISCRETE), device="cpu"), learn=True
        ),
        "cannot learn on.*NatureCNN",
    ),
    (lambda: sw.from_sb3(model_of("PPO", world(), use_sde=True), learn=True), "gSDE"),
    (lambda: by_torch(with_nan()), "NaN"),
    (lambda: by_sb3("PPO", learn="yes"), "learn is 'yes'"),
    (lambda: by_torch(torch.nn.Linear(3, 2), learn=1), "learn is 1"),
]


def by_sb3(kind, env=None, **how):
    return sw.from_sb3(model_of(kind, env or world()), **{"learn": True} | how)


def by_torch(module, **how):
    return sw.from_torch(module, **{"learn": True} | how)


@pytest.mark.parametrize(("make", "says"), REFUSED, ids=[says for _, says in REFUSED])
def test_what_cannot_learn_on_is_refused(make, says):
    with pytest.raises((DeclarationError, PolicyError), match=says):
        make()


def test_a_zip_without_trust_repeats_what_was_asked(tmp_path):
    model_of("PPO", world()).save(tmp_path / "m.zip")
    with pytest.raises(PolicyError, match=r"ppo.*trust=True, learn=True"):
        sw.from_sb3(tmp_path / "m.zip", learn=True)
    with pytest.raises(RunError, match="does not exist"):
        sw.from_sb3(tmp_path / "other.zip", learn=True)
