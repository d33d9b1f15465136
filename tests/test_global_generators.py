# ruff: noqa: NPY002
"""Environments that draw from the global generators: one seed gives one result."""

import contextlib
import multiprocessing
import os
import random
import threading
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch
from safetensors.torch import load_file

import skillweave as sw
from skillweave._internal.seeding import Seeds, global_generators

# A quiet run says it as a Python warning.
pytestmark = pytest.mark.filterwarnings("ignore:.* draws from ")
SMALL = sw.PPO(num_envs=4, n_steps=16, batch_size=32, update_epochs=1, network=sw.Network((4,)))
DRAWS = {
    "random": lambda: random.uniform(-5, 5),
    "numpy.random": lambda: float(np.random.uniform(-5, 5)),
    "torch": lambda: float(torch.rand(()) * 10 - 5),
}


class Corridor(gym.Env):
    """Begins where ``draw`` says; writes down where, if it is told a file."""

    observation_space = gym.spaces.Box(-20, 20, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)
    draw = None
    file = None

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        draw = type(self).draw
        self.x, self.t = self.np_random.uniform(-5, 5) if draw is None else draw(), 0
        if self.file is not None:
            with open(self.file, "a") as file:
                file.write(f"{os.getpid()} {self.x}\n")
        return np.array([self.x], np.float32), {}

    def step(self, action):
        self.t += 1
        self.x += 1 if action else -1
        return np.array([self.x], np.float32), -abs(self.x), False, self.t == 5, {}


def drawing(name, file=None):
    return type("Drawing", (Corridor,), {"draw": DRAWS.get(name), "file": file})


def train(env, folder, workers=1, steps=128, **how):
    return sw.train_agent(
        sw.EnvSpec(env, engine="sync", workers=workers), SMALL, steps, folder, quiet=True, **how
    )


def weights(run):
    return {k: v.clone() for k, v in run.policy.weights.items()}


def same(one, two):
    return all(torch.equal(one[k], two[k]) for k in one)


def disturb(number):
    """Let the caller's generators stand anywhere."""
    random.seed(number)
    np.random.seed(number)
    torch.manual_seed(number)


@contextlib.contextmanager
def untouched():
    """Assert that the caller's generators stand where they stood."""
    disturb(7)
    expected = random.random(), np.random.random(), torch.rand(())
    disturb(7)
    yield
    assert (random.random(), np.random.random(), torch.rand(())) == expected


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("name", DRAWS)
@pytest.mark.parametrize("workers", [1, 2])
def test_the_same_seed_gives_the_same_weights(name, workers, tmp_path):
    runs = []
    for i, seed in enumerate((3, 3, 4)):
        disturb(i)
        runs.append(weights(train(drawing(name), tmp_path / str(i), workers, seed=seed)))
    assert same(runs[0], runs[1])
    assert not same(runs[0], runs[2])


def test_environments_of_two_processes_draw_other_numbers_when_made_and_when_they_begin(tmp_path):
    class Built(drawing("numpy.random", tmp_path / "starts")):
        def __init__(self):
            self.length = float(np.random.uniform())
            if multiprocessing.parent_process() is not None:
                (tmp_path / f"{os.getpid()}-{self.length}").touch()

    spec = sw.EnvSpec(Built, engine="sync", workers=2, check_seed=False)
    sw.train_agent(spec, SMALL, 128, tmp_path / "run", quiet=True)
    lengths = [f.name.split("-")[1] for f in tmp_path.iterdir() if "-" in f.name]
    assert len(lengths) == len(set(lengths)) == 4
    starts = {}
    for line in (tmp_path / "starts").read_text().splitlines():
        process, x = line.split()
        starts.setdefault(process, set()).add(x)
    starts.pop(str(os.getpid()), None)
    assert len(starts) == 2
    assert not set.intersection(*starts.values())


class Everywhere(Corridor):
    """Draws wherever it can: when it is made, in each step, and in each picture."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    draw = DRAWS["numpy.random"]

    def __init__(self, render_mode=None):
        self.render_mode = render_mode
        self.weight = np.random.uniform() + random.random()

    def step(self, action):
        obs, reward, *end, info = super().step(action)
        return obs, reward + (random.random() + float(torch.rand(()))) * self.weight, *end, info

    def render(self):
        shade = np.random.randint(255)
        return np.full((16, 16, 3), shade, np.uint8)


def hierarchy(**how):
    skills = [Left(), Right()]
    return sw.Hierarchy(Everywhere, skills, algorithm=SMALL, selector=SMALL, steps=128, **how)


@pytest.fixture(scope="module")
def everywhere(tmp_path_factory):
    folder = tmp_path_factory.mktemp("everywhere")
    return hierarchy().train(folder / "run", seed=0, quiet=True)


USES = {
    "train_agent": lambda run, to: sw.train_agent(Everywhere, SMALL, 128, to / "run", quiet=True),
    "train": lambda run, to: hierarchy().train(to / "run", quiet=True),
    "train apart": lambda run, to: hierarchy(learn="apart").train(to / "run", quiet=True),
    "continue": lambda run, to: hierarchy().train(run.path, resume=True, quiet=True),
    "load": lambda run, to: hierarchy().load(run.path),
    "weights": lambda run, to: hierarchy().load_weights(run.save_weights(to / "w.safetensors")),
    "evaluate": lambda run, to: run.evaluate(2, quiet=True),
    "evaluate a skill": lambda run, to: run.evaluate(2, skill="left", quiet=True),
    "render": lambda run, to: run.render(to / "film.gif", quiet=True),
    "make_options_env": lambda run, to: sw.envs.make_options_env(run, 2, 0.99).close(),
    "report": lambda run, to: run.report(to / "report.html", episodes=2, films=0, quiet=True),
}


SLOW = {"report": pytest.mark.slow}


@pytest.mark.parametrize("use", [pytest.param(u, marks=SLOW.get(u, ())) for u in USES])
def test_generators_of_the_caller_stand_where_they_stood_after(use, everywhere, tmp_path):
    with untouched(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        USES[use](everywhere, tmp_path)


def test_what_a_seed_makes_of_a_run_is_the_same_again(everywhere, tmp_path):
    made, films = [], []
    for number, seed in enumerate((1, 1, 2)):
        disturb(number)
        env = sw.envs.make_options_env(everywhere, 2, 0.99, seed=seed)
        made.append([one.unwrapped.weight for one in env.engine.envs])
        env.close()
        everywhere.render(tmp_path / f"{number}.gif", episodes=2, seed=seed, quiet=True)
        films.append((tmp_path / f"{number}.gif").read_bytes())
    assert made[0] == made[1] != made[2]
    assert films[0] == films[1] != films[2]


def test_an_evaluation_gives_the_same_again_and_says_nothing_of_resuming(tmp_path):
    run = train(drawing("torch"), tmp_path / "run")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        one, two, other = (
            sw.evaluate(run.policy, drawing("torch"), episodes=3, seed=seed) for seed in (1, 1, 2)
        )
    assert one.returns == two.returns
    assert one.returns != other.returns


def test_they_stand_where_they_stood_after_trainings_in_threads(tmp_path):
    first_step, second_began = threading.Event(), threading.Event()

    class Waiting(Corridor):
        """Lets one training begin within the other, and end after it."""

        def step(self, action):
            first_step.set()
            second_began.wait(20)
            return super().step(action)

    class Late(drawing("numpy.random")):
        def reset(self, *, seed=None, options=None):
            second_began.set()
            one.join(20)
            return super().reset(seed=seed)

    runs = []
    one, two = (
        threading.Thread(target=lambda env=env: runs.append(train(env, tmp_path / env.__name__)))
        for env in (Waiting, Late)
    )
    with untouched():
        one.start()
        assert first_step.wait(20)
        two.start()
        one.join()
        two.join()
    assert [run.path.name for run in runs] == ["Waiting", "Late"]


@pytest.mark.parametrize(
    ("name", "workers"), [*((name, 1) for name in (*DRAWS, "none")), ("random", 2)]
)
def test_it_is_said_once_that_an_environment_draws_from_them(name, workers, tmp_path, capsys):
    spec = sw.EnvSpec(drawing(name), engine="sync", workers=workers)
    sw.train_agent(spec, SMALL, 128, tmp_path / "run")
    said = capsys.readouterr().err
    assert said.count("self.np_random") == (name != "none")
    assert (f"Drawing draws from {name}," in said) == (name != "none")


class Left(sw.Skill): ...


class Right(sw.Skill): ...


@pytest.mark.parametrize("learn", ["together", "apart", "flat"])
@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("name", DRAWS)
def test_weights_do_not_depend_on_how_often_a_run_is_evaluated(name, learn, tmp_path):
    found = []
    for i, every in enumerate((None, 64)):
        defaults = sw.TrainDefaults(eval_every=every, eval_episodes=2)
        spec, folder = sw.EnvSpec(drawing(name), engine="sync", workers=1), tmp_path / str(i)
        if learn == "flat":
            plain = sw.Agent(spec, SMALL, 256, train_defaults=defaults)
            found.append(weights(plain.train(folder, seed=0, quiet=True)))
            continue
        hierarchy = sw.Hierarchy(
            spec, [Left(), Right()], algorithm=SMALL, selector=SMALL, steps=256,
            learn=learn, train_defaults=defaults,
        )  # fmt: skip
        hierarchy.train(folder, seed=0, quiet=True)
        files = sorted((folder / "policies").glob("*.safetensors"))
        found.append({f"{f.name} {k}": v for f in files for k, v in load_file(f).items()})
    assert same(*found)


def test_threads_that_share_a_generator_are_promised_nothing(tmp_path, capsys):
    plays, over = threading.Event(), threading.Event()

    def other() -> None:
        with global_generators(Seeds(1)):
            plays.set()
            over.wait(60)

    thread = threading.Thread(target=other)
    thread.start()
    assert plays.wait(60)
    for name in ("numpy.random", "none"):
        spec = sw.EnvSpec(drawing(name), engine="sync", workers=1)
        sw.train_agent(spec, SMALL, 64, tmp_path / name)
        said = capsys.readouterr().err
        shared = f"several threads train or play, and their environments draw from {name}"
        assert (shared in said) == (name != "none")
        assert "gives the same weights" not in said
    over.set()
    thread.join()
