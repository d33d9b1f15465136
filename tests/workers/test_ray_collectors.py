"""Actors of Ray find what collectors in this thread find, whatever happens to them."""

import importlib.util
import itertools
import os
import platform
import re
import signal
import sys
import threading
from contextlib import ExitStack, suppress
from dataclasses import replace
from importlib import metadata
from types import SimpleNamespace

import gymnasium as gym
import pytest
from small_runs import interrupt_at_checkpoint
from toy_acting import Again, deciding, equal, requests, stepping

from skillweave import (
    PPO,
    Agent,
    TrainDefaults,
)
from skillweave._internal.seeding import Seeds
from skillweave.envs.make import EnvSpec
from skillweave.errors import SkillweaveError
from skillweave.experience.group import Collectors
from skillweave.runs.files import read_tensors
from skillweave.workers.cluster import Ray

ray = pytest.importorskip("ray")
cluster_utils = pytest.importorskip("ray.cluster_utils")

from skillweave.workers import actors  # noqa: E402
from skillweave.workers.actor_host import COMPUTING, ActorHost  # noqa: E402

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::FutureWarning"),
]


SOON = {"health_check_period_ms": 1000, "health_check_failure_threshold": 3}
"""When Ray takes a node for lost: after 3 seconds, not 15."""


@pytest.fixture(scope="module")
def cluster():
    """Nodes on this machine: the head has two CPUs."""
    head = {"num_cpus": 2, "include_dashboard": False, "_system_config": SOON}
    made = cluster_utils.Cluster(initialize_head=True, head_node_args=head)
    ray.init(made.address, logging_level="ERROR", log_to_driver=False)
    yield made
    ray.shutdown()
    made.shutdown()


@pytest.fixture
def on_ray(cluster):
    told, open_ = [], ExitStack()

    def of(make, count=2, each=3, **how):
        settings = Ray(**{"patience": 60.0} | how)
        where = open_.enter_context(settings.connected(count, told.append))
        made = where.collectors(make, each * count, count, 1, "Walk")
        open_.callback(made.close)
        return made

    of.told = told
    with open_:
        yield of


def here(make, count=2):
    return Collectors([make(3, 3 * i) for i in range(count)])


def kill(worker):
    os.kill(worker.place["process"], signal.SIGKILL)


@pytest.mark.slow
def test_actors_find_what_this_thread_finds_though_they_are_killed(on_ray):
    plain, apart = here(deciding()), on_ray(deciding())
    for collectors in (plain, apart):
        collectors.start(Seeds(3))
    asked = requests(15)
    for at, request in enumerate(itertools.islice(asked, 40)):  # with snapshots in between
        for number, killed in enumerate([(0, 21), (21,)]):
            if at in killed:
                kill(apart._workers[number])
        equal(plain.collect(request), apart.collect(request))
        if at % 13 == 12:
            assert plain.state().keys() == apart.state().keys()
    assert plain.steps_made == apart.steps_made
    assert on_ray.told[0] == "worker 0 died; it is made again"
    assert sorted(on_ray.told[1:]) == [f"worker {i} died; it is made again" for i in (0, 1)]
    state = apart.state()
    request = next(asked)
    found = apart.collect(request)
    for collectors in (plain, apart):  # a state goes to this thread, and back
        assert not len(collectors.restore(state))
        equal(collectors.collect(request), found)


@pytest.fixture
def only_here(tmp_path):
    """A module that no node can import, and an environment that it registers."""
    file = tmp_path / "only_here.py"
    file.write_text(
        "import gymnasium as gym\nfrom toy_acting import Again\nclass Own(Again):\n"
        "    def __init__(self, render_mode=None):\n        super().__init__()\n"
        "gym.register('OnlyHere-v0', Own, disable_env_checker=True, order_enforce=False)\n"
    )
    spec = importlib.util.spec_from_file_location("only_here", file)
    module = importlib.util.module_from_spec(spec)
    sys.modules["only_here"] = module
    spec.loader.exec_module(module)
    yield "OnlyHere-v0"
    del sys.modules["only_here"], gym.registry["OnlyHere-v0"]


@pytest.mark.slow
def test_collectors_of_a_lost_node_are_made_again_on_others(on_ray, cluster, only_here):
    extra = cluster.add_node(num_cpus=3)
    make = stepping(only_here)
    plain, apart = here(make, 1), on_ray(make, 1, cpus=3.0)
    for collectors in (plain, apart):
        collectors.start(Seeds(3))
    for at, request in enumerate(itertools.islice(requests(200), 5)):  # too much for a message
        if at == 3:
            cluster.remove_node(extra, allow_graceful=False)
            cluster.add_node(num_cpus=3)  # nodes may join
        found = apart.collect(request)
        equal(plain.collect(request), found)
        found.batches[""]["reward"][:] = 0.0  # it can be written to
    lost = "worker 0 (was lost with its node|is out of reach); it is made again"
    assert on_ray.told
    assert all(re.fullmatch(lost, line) for line in on_ray.told)


def test_a_run_on_ray_goes_on_in_processes_and_ends_as_if_nothing_had_happened(
    cluster, tmp_path, monkeypatch
):
    def learnt(path):
        return {f.name: f.read_bytes() for f in sorted((path / "policies").iterdir())}

    small = PPO(num_envs=4, n_steps=16, batch_size=32, update_epochs=1)
    spec = EnvSpec("CartPole-v1", engine="sync", workers=2)
    often = TrainDefaults(checkpoint_every=128)
    whole = Agent(spec, small, 512, train_defaults=often)
    whole.train(tmp_path / "whole", quiet=True)
    agent = Agent(replace(spec, workers=1), small, 512, train_defaults=often)
    interrupt_at_checkpoint(monkeypatch, 2)
    with pytest.raises(KeyboardInterrupt):
        agent.train(tmp_path / "on", quiet=True, cluster=Ray(collectors=2))
    assert 0 < read_tensors(tmp_path / "on" / "checkpoint.safetensors")[1]["steps"] < 512
    with pytest.raises(
        SkillweaveError, match="was started with 2 collectors, and continues with as"
    ):
        agent.resume(tmp_path / "on", quiet=True, cluster=Ray(collectors=4))
    agent.resume(tmp_path / "on", quiet=True)
    assert learnt(tmp_path / "on") == learnt(tmp_path / "whole")


class Failing(Again):
    def step(self, action):
        if self.t == 2:
            raise ValueError("the arm is stuck")
        return super().step(action)


def test_what_goes_wrong_in_an_actor_is_an_answer():
    stationed = ActorHost()
    assert stationed.make(actors.packed(stepping(Failing), "it"), 3, 1) == (None, None)
    assert stationed.answer("start", Seeds(0)) == (None, None)
    error, answer = stationed.answer("collect", next(requests(5)))
    assert answer is None
    assert error[0] == "EnvError"
    assert re.search("environment [3-5], step 3.*the arm is stuck", error[1])
    stationed.close()


def test_no_room_is_told_while_it_waits_and_when_it_stops(on_ray, monkeypatch):
    monkeypatch.setattr(actors, "LOOK", 0.2)
    with pytest.raises(SkillweaveError, match=r"2 collectors need 14 CPUs.*it has \d, of which"):
        on_ray(stepping(), cpus=7.0, patience=0.5)
    assert any("waiting up to 0.5 s for more" in line for line in on_ray.told)


@pytest.mark.parametrize(
    ("other", "says"),
    [
        ({"Python": "3.99.1"}, r"node 10.0.0.7 .* has Python 3\.99\.1, but here is"),
        ({"Skillweave": "9.9"}, r"node 10.0.0.7 .* has Skillweave 9\.9, but here is"),
        ({"Skillweave": None}, "node 10.0.0.7 .* has no Skillweave: install"),
    ],
)
def test_a_node_with_another_version_is_refused(other, says):
    there = {"node": "10.0.0.7", "Python": platform.python_version()}
    there |= {"Skillweave": metadata.version("skillweave")}
    actors.check_versions(there)
    with pytest.raises(SkillweaveError, match=says):
        actors.check_versions(there | other)


def test_a_node_that_computes_with_another_version_is_told_once(on_ray):
    there: dict[str, str | None] = {"node": "10.0.0.7"} | dict.fromkeys(COMPUTING)
    for name in COMPUTING:
        with suppress(metadata.PackageNotFoundError):
            there[name] = metadata.version(name)
    told = on_ray(stepping())._workers[0]._actors
    for _ in range(2):
        told.tell_versions(there)
        told.tell_versions(there | {"torch": "1.0.1", "numpy": None})
    [line] = [line for line in on_ray.told if "10.0.0.7" in line]
    assert re.search(r"has torch 1\.0\.1 \(here .*\), numpy missing \(here", line)


def test_an_address_is_refused_where_another_cluster_is_joined(cluster, monkeypatch):
    port = int(cluster.address.rpartition(":")[2])
    with pytest.raises(SkillweaveError, match=rf"joined to the cluster at .*:{port} already"):
        Ray(address=f"localhost:{port - 1}").joined(1).__enter__()
    joined = SimpleNamespace(gcs_address="10.0.0.1:9")
    monkeypatch.setattr(ray, "get_runtime_context", lambda: joined)
    with pytest.raises(SkillweaveError, match=r"joined to the cluster at 10.0.0.1:9 already"):
        Ray(address="10.0.0.7:9").joined(1).__enter__()
    monkeypatch.undo()
    with Ray(address=f"localhost:{port}").joined(1) as found:
        assert found is ray


def test_what_cannot_be_sent_is_told(on_ray):
    lock = threading.Lock()
    with pytest.raises(SkillweaveError, match=r"(?s)collectors of Walk.*cannot be sent.*lock"):
        on_ray(lambda *_: lock)


def test_a_full_object_store_is_told(on_ray, monkeypatch):
    def full(_):
        raise ray.exceptions.ObjectStoreFullError("no room for 3 GB")

    monkeypatch.setattr(actors.ray, "put", full)
    with pytest.raises(SkillweaveError, match="object store of the Ray cluster is full"):
        on_ray(stepping())


@pytest.mark.parametrize(
    ("address", "says"),
    [("127.0.0.1:1", "no program listens at 127.0.0.1:1"), ("nowhere", "write host:port")],
)
def test_an_address_where_nobody_listens_is_told_at_once(monkeypatch, address, says):
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    with pytest.raises(SkillweaveError, match=says), Ray(address=address).connected(1, print):
        pass
