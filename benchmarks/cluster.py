"""Collectors on Ray: how they scale, what they cost, and whether the weights stay the same.

    python -m benchmarks.cluster [scale] [overhead] [equal] [costs] [saturation] [population]
    python -m benchmarks.cluster sweep [--ray]

``scale``: an environment whose step sleeps 2 ms, so that it waits and does not compute: steps per
second of 1 to 16 collectors with 4 environments each, against as many times those of one.
``overhead``: two actors of Ray against two processes, PPO on MiniGrid's DoorKey-8x8 in Python;
rounds take turns, the median ratio counts. ``equal``: weights after ``kill -9`` of an actor at
random moments, and of a whole node (Ray's ``Cluster``), against those of processes. ``costs``:
microseconds and bytes of a step, here and there. ``saturation``: a simulation of more collectors
than there are, by these. ``population``: 16 members in three parts on three nodes (Ray's
``Cluster``), one of which is killed at a random moment, against three processes here. ``sweep``: 20
seeds, the driver killed (``kill -9``) at two moments, against an undisturbed sweep; with
``--ray`` its runs are tasks of Ray, else processes.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.collecting import EPOCHS, NETWORK, grid, ours
from benchmarks.common import report, table
from skillweave import PPO, EnvSpec, Network, train_agent
from skillweave.evolution import Evolution
from skillweave.types import Array
from skillweave.workers import Ray
from skillweave.workers.cluster import imported

SLEEP = 2e-3
EACH, ROWS = 4, 64


class Sleeping(gym.Env[Array, Any]):
    """A step takes 2 ms and no computing."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (8,), np.float32)
    action_space = gym.spaces.Discrete(4)

    def reset(
        self, *, seed: int | None = None, options: Any = None
    ) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        self.t = 0
        return self._look(), {}

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        time.sleep(SLEEP)
        self.t += 1
        return self._look(), float(action == self.t % 4), self.t >= 50, False, {}

    def _look(self) -> Array:
        return self.np_random.uniform(-1.0, 1.0, 8).astype(np.float32)


def small(collectors: int, each: int = EACH, rows: int = ROWS) -> PPO:
    return PPO(
        num_envs=each * collectors,
        n_steps=rows,
        batch_size=256,
        update_epochs=EPOCHS,
        network=NETWORK,
        normalize_obs=False,
    )


def trained(env: Any, config: PPO, steps: int, workers: int, cluster: Ray | None) -> dict[str, Any]:
    """Return steps per second, and the checksum of the weights."""
    with tempfile.TemporaryDirectory() as folder:
        spec, path = EnvSpec(env, engine="sync", workers=workers), Path(folder) / "run"
        run = train_agent(spec, config, steps, path, quiet=True, cluster=cluster)
        weights = (path / "policies" / "agent.safetensors").read_bytes()
        speed = run.info()["stages"][0]["steps_per_second"]
        return {"speed": speed, "weights": hashlib.sha256(weights).hexdigest()}


def scale(given: argparse.Namespace) -> dict[str, Any]:
    found: dict[int, float] = {}
    with Ray().joined(16):
        for _ in range(given.rounds):
            for count in (1, 2, 4, 8, 16):
                steps = EACH * count * ROWS * given.updates
                speed = trained(Sleeping, small(count), steps, count, Ray(count))["speed"]
                found[count] = max(found.get(count, 0.0), speed)
    share = {count: speed / (count * found[1]) for count, speed in found.items()}
    print(
        table(
            ("collectors", "steps/s", "of linear"),
            [(n, f"{s:,.0f}", f"{share[n]:.2f}") for n, s in found.items()],
        )
    )
    return {"steps_per_second": found, "of_linear": share}


def overhead(given: argparse.Namespace) -> dict[str, Any]:
    ratios, steps = [], given.steps
    with Ray().joined(2):
        for _ in range(given.rounds):
            plain, on_ray = ours(2, steps), ours(2, steps, Ray(2))
            ratios.append(on_ray / plain)
            print(
                f"processes {plain:,.0f}, Ray {on_ray:,.0f} steps/s: {ratios[-1]:.2f}", flush=True
            )
    return {"ratios": ratios, "median": statistics.median(ratios)}


def below(parent: int, name: str) -> list[int]:
    """Return the processes that a process began, and whose command holds ``name``."""
    asked = ["pgrep", "-P", str(parent), "-f", name]
    found = subprocess.run(asked, capture_output=True, text=True)
    return [int(pid) for pid in found.stdout.split()]


def actors() -> list[int]:
    """Return the processes of all actors in nodes that this process began."""
    raylets = below(os.getpid(), "raylet")
    return [pid for raylet in raylets for pid in actors_of(raylet)]


def actors_of(raylet: int) -> list[int]:
    return below(raylet, "ray::CollectorActor")


def raylets_of(node: Any) -> list[int]:
    return [process.pid for kind, process in node.live_processes() if kind == "raylet"]


def equal(given: argparse.Namespace) -> dict[str, Any]:
    ray = imported()
    from ray.cluster_utils import Cluster

    rng, config, steps = random.Random(0), small(3), EACH * 3 * ROWS * 10
    plain = trained(Sleeping, config, steps, 3, None)["weights"]
    nodes = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False}
    )
    others = [nodes.add_node(num_cpus=1) for _ in range(3)]  # one more than are needed
    ray.init(nodes.address, logging_level="ERROR", log_to_driver=False)
    found: dict[str, list[bool]] = {"undisturbed": [], "actor": [], "node": []}

    def one(kind: str, disturb: Callable[[], None]) -> None:
        timer = threading.Timer(rng.uniform(0.0, 20.0), disturb)
        timer.start()
        same = trained(Sleeping, config, steps, 3, Ray(3))["weights"] == plain
        timer.cancel()
        if not same or done or kind == "undisturbed":  # else it was over too early
            found[kind].append(same)
            print(f"{kind} {len(found[kind])}: {'equal' if same else 'NOT EQUAL'}", flush=True)
        done.clear()

    done: list[str] = []

    def kill_actor() -> None:
        if pids := actors():
            os.kill(rng.choice(pids), signal.SIGKILL)
            done.append("killed")

    def kill_node() -> None:
        nodes.remove_node(others.pop(rng.randrange(len(others))), allow_graceful=False)
        done.append("killed")

    one("undisturbed", lambda: None)
    while len(found["actor"]) < given.kills:
        one("actor", kill_actor)
    while len(found["node"]) < given.nodes:
        one("node", kill_node)
        while len(others) < 3:
            others.append(nodes.add_node(num_cpus=1))
    ray.shutdown()
    nodes.shutdown()
    counts = {kind: f"{sum(same)} of {len(same)}" for kind, same in found.items()}
    return {"equal": counts}


def population(given: argparse.Namespace) -> dict[str, Any]:
    ray = imported()
    from ray.cluster_utils import Cluster

    rng, parts = random.Random(0), 3

    def evolved(cluster: Ray | None, path: Path) -> dict[str, Any]:
        spec, began = EnvSpec(Sleeping, engine="sync", workers=parts), time.monotonic()
        evolve = Evolution(population=16, generations=3, episodes=2)
        config = replace(small(1, 2, 32), batch_size=64, network=Network((16, 16)))
        train_agent(spec, config, 600, path, quiet=True, evolve=evolve, cluster=cluster)
        found = (path / "policies" / "agent.safetensors").read_bytes()
        found += (path / "lineage.jsonl").read_bytes()
        seconds = round(time.monotonic() - began, 1)
        return {"result": hashlib.sha256(found).hexdigest(), "seconds": seconds}

    def kill(path: Path, over: threading.Event, longest: float) -> None:
        """Kill a node at which a part is, after the first generation."""
        lineage = path / "lineage.jsonl"
        while not over.wait(0.05) and not (lineage.exists() and lineage.stat().st_size):
            pass
        if over.wait(rng.uniform(0.0, longest)):
            return
        if busy := [node for node in others if any(map(actors_of, raylets_of(node)))]:
            others.remove(lost := rng.choice(busy))
            nodes.remove_node(lost, allow_graceful=False)

    with tempfile.TemporaryDirectory() as folder:
        plain = evolved(None, Path(folder) / "here")
        nodes = Cluster(
            initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False}
        )
        others = [nodes.add_node(num_cpus=1) for _ in range(parts + 1)]  # one more than are needed
        ray.init(nodes.address, logging_level="ERROR", log_to_driver=False)
        on_ray = evolved(Ray(parts), Path(folder) / "ray")
        print(f"processes {plain}, Ray {on_ray}", flush=True)
        killed = list[dict[str, Any]]()
        while len(killed) < given.nodes:
            path, over = Path(tempfile.mkdtemp(dir=folder)) / "run", threading.Event()
            thread = threading.Thread(target=kill, args=(path, over, plain["seconds"] / 3))
            thread.start()
            found = evolved(Ray(parts), path)
            over.set()
            thread.join()
            if len(others) <= parts:  # else it was over too early
                others.append(nodes.add_node(num_cpus=1))
                same = found["result"] == plain["result"]
                killed.append({"equal": same, "seconds": found["seconds"]})
                print(killed[-1], flush=True)
        ray.shutdown()
        nodes.shutdown()
    undisturbed = on_ray["result"] == plain["result"]
    return {"processes": plain, "on_ray": on_ray | {"equal": undisturbed}, "node_killed": killed}


SWEPT = """
from skillweave import Apart, Network, PPO, Hierarchy, Skill, TrainDefaults

class Still(Skill):
    def reward(self, step):
        return -abs(step.next_obs[:, 1])

small = PPO(num_envs=2, n_steps=32, batch_size=32, update_epochs=1, network=Network(hidden=(8,)))
hierarchy = Hierarchy(
    "CartPole-v1", [Still()], algorithm=small, selector=small, learn="apart",
    apart=Apart(skill_steps=640, selector_steps=640),
    train_defaults=TrainDefaults(checkpoint_every=128),
)
"""


def sweep(given: argparse.Namespace) -> dict[str, Any]:
    rng, seeds = random.Random(0), 20

    def words(out: Path) -> list[str]:
        found = [sys.executable, "-m", "skillweave", "sweep", str(recipe), "--seeds", f"0:{seeds}"]
        found += ["--out", str(out), "--evaluate", "2", "--jobs", "2", "--json", "--quiet"]
        return [*found, "--ray"] if given.ray else found

    def summary(out: Path) -> dict[str, Any]:
        found = subprocess.run(words(out), stdout=subprocess.PIPE, text=True, check=True).stdout
        answer: dict[str, Any] = json.loads(found)
        return answer

    def finished(out: Path) -> dict[str, int]:
        """Return by name the finished runs, and the times of their ends."""
        saved = {p.parent.name: p.stat().st_mtime_ns for p in out.glob("s*/evaluation.json")}
        return {k: v for k, v in saved.items() if not (out / k / "checkpoint.safetensors").exists()}

    def result(out: Path, seed: int) -> str:
        """Return a checksum of weights and metrics, times left out."""
        path = out / f"s{seed}"
        lines = [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
        kept = json.dumps([line | {"seconds": 0} for line in lines]).encode()
        weights = [p.read_bytes() for p in sorted((path / "policies").glob("*.safetensors"))]
        return hashlib.sha256(b"".join([kept, *weights])).hexdigest()

    with tempfile.TemporaryDirectory() as folder:
        recipe, out, whole = (Path(folder) / name for name in ("swept.py", "killed", "whole"))
        recipe.write_text(SWEPT)
        undisturbed = summary(whole)
        before, kills, again = dict[str, int](), list[int](), 0
        for least in (rng.randrange(3, 9), rng.randrange(10, 17)):
            driver = subprocess.Popen(words(out), stdout=subprocess.DEVNULL)
            while driver.poll() is None and len(finished(out)) < least:
                time.sleep(0.05)
            time.sleep(rng.uniform(0.0, 2.0))
            driver.kill()
            driver.wait()
            kills.append(len(finished(out)))
            again += sum(finished(out).get(name) != when for name, when in before.items())
            before = finished(out)
            print(f"killed when {kills[-1]} runs were finished", flush=True)
        answer = summary(out)
        again += sum(finished(out).get(name) != when for name, when in before.items())
        same = sum(result(out, seed) == result(whole, seed) for seed in range(seeds))
        values = [[run["return"] for run in found["runs"]] for found in (answer, undisturbed)]
    return {
        "finished_when_killed": kills,
        "trained_again": again,
        "equal": same,
        "runs_in_table": len(answer["runs"]),
        "failed": len(answer["failed"]),
        "same_table": values[0] == values[1],
    }


def costs(given: argparse.Namespace) -> dict[str, Any]:
    """Return a step's costs in microseconds of one processor, and its bytes."""
    import ray

    from skillweave._internal.seeding import Seeds
    from skillweave.algorithms.agent_policy import make_algorithm
    from skillweave.experience.acting import Acting
    from skillweave.training.learner import RolloutLearner, Stack
    from skillweave.training.learning_task import skill_task
    from skillweave.training.role import agent_role

    found: dict[str, Any] = {}
    for name, env in (("CartPole", lambda: gym.make("CartPole-v1")), ("MiniGrid", grid)):
        each, rows, count = 16, 128, 2
        learning_task = skill_task(agent_role(EnvSpec(env, engine="sync")))
        config = small(count, each, rows)
        algorithm = make_algorithm(config, *learning_task.role.spaces)
        learner = RolloutLearner(Stack(algorithm, algorithm.init([Seeds(0)])), Seeds(1))

        def make(
            num_envs: int,
            first: int,
            learning_task: Any = learning_task,
            algorithm: Any = algorithm,
        ) -> Any:
            return learning_task.collector(num_envs, Acting([(algorithm, 1)], num_envs), first)

        alone = make(each, 0)
        alone.start(Seeds(0))
        seconds: dict[str, list[float]] = {"collect": [], "there and back": [], "learn": []}
        with Ray(count).connected(count, print) as where:
            away: Any = where.collectors(make, each * count, count, 1, name)
            away.start(Seeds(0))
            for update in range(given.updates):
                request, began = learner.request(update, 0, 0.0), time.process_time()
                alone.collect(request)
                seconds["collect"].append((time.process_time() - began) / (each * rows))
                refs = [
                    away._workers[i]._actors.get(i).answer.remote("collect", request)
                    for i in range(count)
                ]
                ray.wait(refs, num_returns=count)
                began = time.process_time()
                answers = [ray.get(ref)[1] for ref in refs]
                collected = away._joined(answers)
                ray.get(ray.put(request))
                seconds["there and back"].append(
                    (time.process_time() - began) / (each * rows * count)
                )
                learner.take(collected.experience)
                began = time.process_time()
                learner.learn(update, 0, 0.0)
                seconds["learn"].append((time.process_time() - began) / (each * rows * count))
            away.close()
        import pickle

        sent = len(pickle.dumps(answers[0], protocol=5)) / (each * rows)
        params = len(pickle.dumps(request, protocol=5))
        found[name] = {k: round(1e6 * statistics.median(v), 2) for k, v in seconds.items()}
        found[name] |= {"bytes of a step": round(sent), "bytes of a request": params}
        print(name, found[name], flush=True)
    return found


def saturation(given: argparse.Namespace) -> dict[str, Any]:
    """Simulate steps per second of one learner and W collectors, round by round.

    A round is over when the slowest collector has answered, its rows are joined, and the learner
    has learnt from the round before. What a step costs is measured (``costs``); that collectors
    differ by 10 % from round to round, and that a call takes 2 ms, is assumed.
    """
    saved = json.loads(Path("runs/benchmarks/cluster-costs.json").read_text())
    cost = {k: v / 1e6 for k, v in saved["costs"]["MiniGrid"].items()}
    rng, each, rows, rounds = np.random.default_rng(0), 16, 128, 200
    lines, found = list[tuple[Any, ...]](), {}
    for name, wait in (("MiniGrid in Python", 0.0), ("5 ms a step", 5e-3)):
        for count in (1, 10, 100, 1_000):
            steps, alone = each * rows * count, each * rows * (cost["collect"] + wait)
            slowest = alone * rng.normal(1.0, 0.1, (rounds, count)).max(1)
            round_trip = slowest + 2e-3 + steps * cost["there and back"]
            learn = steps * cost["learn"]
            seconds = float(np.maximum(round_trip, learn).sum())
            speed = rounds * steps / seconds
            busy = rounds * alone / seconds
            lines.append((name, count, f"{speed:,.0f}", f"{busy:.0%}"))
            found[f"{name}, {count}"] = {"steps_per_second": speed, "collectors_busy": busy}
    print(table(("environment", "collectors", "steps/s", "collectors busy"), lines))
    return found


PARTS: dict[str, Callable[[argparse.Namespace], dict[str, Any]]] = {
    "scale": scale,
    "overhead": overhead,
    "equal": equal,
    "costs": costs,
    "saturation": saturation,
    "population": population,
    "sweep": sweep,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], default=list(PARTS))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=40_000)
    parser.add_argument("--updates", type=int, default=20)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--nodes", type=int, default=5)
    parser.add_argument("--ray", action="store_true", help="of sweep: runs are tasks of Ray")
    given = parser.parse_args()
    # Ray's processes would else be behind all others on a busy machine, and those here are not.
    os.environ.setdefault("RAY_worker_niceness", "0")
    for name in given.parts:
        report(f"cluster-{name}", {name: PARTS[name](given)})


if __name__ == "__main__":
    main()
