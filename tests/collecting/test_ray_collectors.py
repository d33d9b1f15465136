"""Actors of Ray find what collectors in this thread find, whatever happens to them."""

import itertools
import os
import signal
import sys
import types

import gymnasium as gym
import numpy as np
import pytest
from reference_calls import Counter, Left, Right, Zigzag
from toy_acting import Again, Choices, requests

from skillweave.collecting.calls import SkillSet
from skillweave.collecting.cluster import Ray
from skillweave.collecting.decisions import DecisionCollector
from skillweave.collecting.group import Collectors
from skillweave.collecting.skill_rows import SkillCollector
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.seeding import Seeds
from skillweave.types import SkillweaveError

ray = pytest.importorskip("ray")
cluster_utils = pytest.importorskip("ray.cluster_utils")

from skillweave.collecting import actors  # noqa: E402

NAMES = ("obs", "action", "reward", "steps", "terminated", "truncated", "next_obs", "valid")


pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::FutureWarning")


@pytest.fixture(scope="module")
def cluster():
    """Two nodes with two CPUs each, on this machine."""
    made = cluster_utils.Cluster(
        initialize_head=True, head_node_args={"num_cpus": 2, "include_dashboard": False}
    )
    made.add_node(num_cpus=2)
    with Ray(address=made.address).connected(0, print):
        yield made
    made.shutdown()


@pytest.fixture
def on_ray(cluster):
    told, made = [], []

    def of(make, count=2, each=3, **how):
        how = {"patience": 60.0} | how
        made.append(actors.RayCollectors(make, each, count, 1, "Walk", tell=told.append, **how))
        return made[-1]

    of.told = told
    yield of
    for collectors in made:
        collectors.close()


def deciding(env=Again):
    def make(num_envs, first):
        kinds = tuple(kind() for kind in (Left, Right, Zigzag, Counter))
        skills = SkillSet(kinds, tuple(s.policy for s in kinds), call_steps=5)
        engine = make_engine(EnvSpec(env, engine="sync"), num_envs, first=first)
        return DecisionCollector(engine, Choices(num_envs, 4), skills)

    return make


def stepping(env=Again):
    def make(num_envs, first):
        engine = make_engine(EnvSpec(env, engine="sync"), num_envs, first=first)
        return SkillCollector(engine, Choices(num_envs, 3))

    return make


def here(make, count=2):
    return Collectors([make(3, 3 * i) for i in range(count)])


def equal(one, two):
    for name in NAMES:
        np.testing.assert_array_equal(getattr(one.experience, name), getattr(two.experience, name))
    assert one.experience.spent == two.experience.spent
    np.testing.assert_array_equal(one.episodes, two.episodes)


def kill(worker):
    os.kill(worker.place["process"], signal.SIGKILL)


def test_killed_actors_are_made_again_and_find_the_same(on_ray):
    plain, apart = here(deciding()), on_ray(deciding())
    for collectors in (plain, apart):
        collectors.start(Seeds(3))
    for at, request in enumerate(itertools.islice(requests(15), 40)):  # with snapshots in between
        if at in (7, 21):
            kill(apart._workers[1])
        if at in (0, 21):  # then both at once
            kill(apart._workers[0])
        equal(plain.collect(request), apart.collect(request))
        if at % 13 == 12:
            np.testing.assert_array_equal(plain.cut(Seeds(5) / at), apart.cut(Seeds(5) / at))
    assert plain.steps_made == apart.steps_made
    assert "worker 0 died; it is made again" in on_ray.told


def test_one_actor_alone_finds_what_this_thread_finds_and_it_can_be_written_to(on_ray):
    plain, apart = here(stepping(), 1), on_ray(stepping(), 1)
    for collectors in (plain, apart):
        collectors.start(Seeds(3))
    for request in itertools.islice(requests(200), 3):  # more than Ray sends without its store
        found = apart.collect(request)
        equal(plain.collect(request), found)
        found.experience.reward[:] = 0.0


def test_a_state_goes_from_actors_to_this_thread_and_back(on_ray):
    plain, apart = here(deciding()), on_ray(deciding())
    apart.start(Seeds(3))
    asked = requests(9)
    for request in itertools.islice(asked, 5):
        apart.collect(request)
    apart.cut(Seeds(1))
    state = apart.state()
    assert not len(plain.restore({k: np.array(v) for k, v in state.items()}))
    again = on_ray(deciding())
    assert not len(again.restore(state))
    for request in itertools.islice(asked, 5):
        found = apart.collect(request)
        equal(plain.collect(request), found)
        equal(again.collect(request), found)


def test_collectors_of_a_lost_node_are_made_again_on_others(on_ray, cluster):
    extra = cluster.add_node(num_cpus=2)
    plain, apart = here(stepping(), 3), on_ray(stepping(), 3, cpus=2.0)  # one on each node
    for collectors in (plain, apart):
        collectors.start(Seeds(3))
    asked = requests(15)
    for at, request in enumerate(itertools.islice(asked, 5)):
        if at == 3:
            cluster.remove_node(extra, allow_graceful=False)
            cluster.add_node(num_cpus=2)  # nodes may join
        equal(plain.collect(request), apart.collect(request))
    assert any("was lost with its node; it is made again" in line for line in on_ray.told)


class Failing(Again):
    def step(self, action):
        if self.t == 2:
            raise ValueError("the arm is stuck")
        return super().step(action)


class Always(Again):
    def step(self, action):
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize(
    ("env", "says"),
    [
        (Failing, r"environment [0-5], step 3.*the arm is stuck.*worker [01]"),
        (Always, r"worker 0 \(environments 0 to 2\) died, and again when it was made anew"),
    ],
)
def test_what_goes_wrong_in_an_actor_is_told_with_who_it_was(on_ray, env, says):
    collectors = on_ray(stepping(env))
    collectors.start(Seeds(0))
    with pytest.raises(SkillweaveError, match=f"(?s){says}"):
        collectors.collect(next(requests(5)))


def test_no_room_is_told_while_it_waits_and_when_it_stops(on_ray, monkeypatch):
    monkeypatch.setattr(actors, "LOOK", 0.2)
    with pytest.raises(SkillweaveError, match=r"2 collectors need 14 CPUs.*it has \d, of which"):
        on_ray(stepping(), cpus=7.0, patience=0.5)
    assert any("waiting up to 0.5 s for more" in line for line in on_ray.told)


@pytest.mark.parametrize("what", ["Python", "Skillweave"])
def test_a_node_with_another_version_is_refused(on_ray, monkeypatch, what):
    if what == "Python":
        monkeypatch.setattr(actors.platform, "python_version", lambda: "3.99.1")
    else:
        monkeypatch.setattr("skillweave.__version__", "9.9")
    with pytest.raises(SkillweaveError, match=rf"has {what} .*, but here is (3\.99\.1|9\.9)"):
        on_ray(stepping())


def test_code_and_environments_that_no_node_has_travel_with_the_job(on_ray, tmp_path):
    file = tmp_path / "only_here.py"
    file.write_text(
        "import gymnasium as gym\nfrom reference_calls import Walk\n"
        "class Own(Walk):\n    pass\ngym.register('OnlyHere-v0', Own)\n"
    )
    module = types.ModuleType("only_here")
    module.__file__ = str(file)
    sys.modules["only_here"] = module
    try:
        exec(compile(file.read_text(), file, "exec"), vars(module))
        for env in (module.Own, "OnlyHere-v0"):
            plain, apart = here(stepping(env), 1), on_ray(stepping(env), 1)
            for collectors in (plain, apart):
                collectors.start(Seeds(3))
            request = next(requests(15))
            equal(plain.collect(request), apart.collect(request))
    finally:
        del sys.modules["only_here"], gym.registry["OnlyHere-v0"]


def test_what_cannot_be_sent_is_told(on_ray):
    lock = open(os.devnull)  # noqa: SIM115

    def make(num_envs, first):
        return lock

    with lock, pytest.raises(SkillweaveError, match=r"collectors of Walk.*cannot be sent"):
        on_ray(make)


def test_a_full_object_store_is_told(on_ray, monkeypatch):
    def full(_):
        raise ray.exceptions.ObjectStoreFullError("no room for 3 GB")

    collectors = on_ray(stepping())
    monkeypatch.setattr(actors.ray, "put", full)
    with pytest.raises(SkillweaveError, match="object store of the Ray cluster is full"):
        collectors.start(Seeds(0))


@pytest.mark.parametrize(
    ("address", "says"),
    [("127.0.0.1:1", "nobody listens at 127.0.0.1:1"), ("nowhere", "write host:port")],
)
def test_an_address_where_nobody_listens_is_told_at_once(monkeypatch, address, says):
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    with pytest.raises(SkillweaveError, match=says), Ray(address=address).connected(1, print):
        pass


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ({"collectors": 0}, "collectors is 0"),
        ({"address": 6379}, "address is 6379"),
        ({"cpus": 0}, "cpus is 0"),
        ({"patience": -1}, "patience is -1"),
    ],
)
def test_settings_out_of_range_are_refused(how, says):
    with pytest.raises(SkillweaveError, match=says):
        Ray(**how)
