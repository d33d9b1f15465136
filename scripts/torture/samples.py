"""Samples for mutation: small runs and files of every kind, each with its use."""

from __future__ import annotations

import contextlib
import hashlib
import io
import zlib
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.spaces import Dict

from scripts.torture.compare import tensors_and_header
from scripts.torture.kinds import (
    CART,
    IN_PYTHON,
    KINDS,
    LEARNS,
    NET,
    REPLAYS,
    TINY_IN_PYTHON,
    Balance,
    Kind,
    Tiny,
    alone,
    hierarchy_of,
    together,
    together_replay,
)
from skillweave import (
    PPO,
    SAC,
    Apart,
    Hierarchy,
    Skill,
    from_onnx,
)
from skillweave.algorithms.agent_policy import AgentPolicy
from skillweave.api import Agent, Run, train_agent
from skillweave.cli import commands, execute
from skillweave.compat.agilerl import agent_classes
from skillweave.compat.agilerl_files import convert
from skillweave.reporting.lineage import read_lineage
from skillweave.reporting.plots import plot_run
from skillweave.runs.directory import RunDirectory
from skillweave.schema import as_json
from skillweave.spaces import pack
from skillweave.types import Policy

Play = dict[str, Any]
"""What a policy does, so that two can be compared by ==."""
ROWS = 32
PLOTTED = 5
"""Plotting takes a second, so one in this number of cases that change a .jsonl file is plotted, and
each in which the file is empty, or no file any more. 1: all are."""
CART_SPACE = gym.make(CART).observation_space


@dataclass(frozen=True)
class Sample:
    """Files, and what is done with them."""

    make: Callable[[Path], None]
    """Writes them into an empty folder."""
    use: Callable[[Path, str], Play]
    """Does what a user does, with the folder, and the name of the file that was changed."""
    share: float = 1.0
    """How often it is drawn; less where its use takes long."""


# What users do ---------------------------------------------------------------------------------


def play(run: Run) -> Play:
    """Return a trained policy's actions, and an episode of its."""
    score = run.evaluate(1)
    return plays(run.policy) | {"returns": score.returns, "lengths": score.lengths}


def plays(policy: Policy) -> Play:
    """Return a policy's actions on fixed observations, greedy and sampled."""
    known = Tiny.observation_space if isinstance(policy.observation_space, Dict) else CART_SPACE
    # Not the policy's own bounds: a file may say others, and it must act the same all the same.
    fits = policy.observation_space.shape == known.shape
    space = known if fits else policy.observation_space
    space.seed(0)
    obs = pack(
        space,
        gym.vector.utils.concatenate(
            space,
            [space.sample() for _ in range(ROWS)],
            gym.vector.utils.create_empty_array(space, ROWS),
        ),
    )
    return {
        f"deterministic {greedy}": policy.act(
            policy.start(ROWS), obs, deterministic=greedy, rng=np.random.default_rng(0)
        )[0].tolist()
        for greedy in (True, False)
    }


def looked_at(run: Path, changed: str) -> None:
    """Run the commands that only read."""
    with contextlib.redirect_stdout(io.StringIO()):
        execute.run(commands.InfoCommand(target=str(run)))
    found = RunDirectory.open(run)
    if changed.endswith(".jsonl"):
        list(found.metrics())
        for stage in found.manifest.stages:
            read_lineage(found, stage.name)
        file = run.parent / changed
        if zlib.crc32(file.read_bytes() if file.is_file() else b"") % PLOTTED == 0:
            plot_run(found, run / "plots")


def declared(kind: Kind) -> Callable[[Path, str], Play]:
    """Load a run by its own declaration."""

    def use(folder: Path, changed: str) -> Play:
        looked_at(folder / "run", changed)
        return play(kind.declare().load(folder / "run"))

    return use


def from_data(folder: Path, changed: str) -> Play:
    """Load a run that says itself what it is."""
    run = folder / "run"
    looked_at(run, changed)
    manifest = RunDirectory.open(run).manifest
    kind = Agent if manifest.hierarchy is None else Hierarchy
    return play(kind.from_manifest(as_json(manifest)).load(run))


def resumed(kind: Kind) -> Callable[[Path, str], Play]:
    """Resume a run to its end."""

    def use(folder: Path, changed: str) -> Play:
        run = folder / "run"
        looked_at(run, changed)
        before = set((run / "policies").glob("*"))
        played = play(kind.declare().resume(run, quiet=True))
        trained = sorted(set((run / "policies").glob("*.safetensors")) - before)
        return played | {
            p.name: hashlib.sha256(tensors_and_header(p)[0]).hexdigest() for p in trained
        }

    return use


def weights_file(kind: Kind) -> Callable[[Path, str], Play]:
    """Load a file of weights into its declaration."""
    return lambda folder, changed: play(kind.declare().load_weights(folder / "w.safetensors"))


def flat_weights(folder: Path, changed: str) -> Play:
    """Score a flat agent's weights on the command line."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        execute.run(
            commands.EvaluateCommand(target=str(folder / "w.safetensors"), episodes=1, json=True)
        )
    return {"printed": out.getvalue().replace(str(folder), "")}


def converted(folder: Path, changed: str) -> Play:
    """Convert a checkpoint of AgileRL's, and load the result."""
    convert(folder / "old.pt", folder / "new.safetensors")
    agent = agent_classes.PPO.load(folder / "new.safetensors")
    about = agent.scores, agent.fitness, agent.steps, agent.index
    return plays(AgentPolicy.of(agent.learner, agent.member.state)) | {"about": repr(about)}


def onnx_skill(folder: Path, changed: str) -> Play:
    """Load a run whose skill is an ONNX file, and the file itself."""
    looked_at(folder / "run", changed)
    return play(_with_onnx(folder).load(folder / "run"))


# How they are made -----------------------------------------------------------------------------


class _Stop(Exception):
    """Ends a training early."""


def unfinished(kind: Kind, cuts: int) -> Callable[[Path], None]:
    """Make a run that was stopped after ``count`` checkpoints."""

    def make(folder: Path) -> None:
        saved, count = RunDirectory.save_checkpoint, 0

        def stop(run: RunDirectory, *arguments: Any) -> None:
            nonlocal count
            saved(run, *arguments)
            count += run.path == folder / "run"  # not of the run that it starts from
            if count == cuts:
                raise _Stop

        RunDirectory.save_checkpoint = stop  # type: ignore[method-assign]
        try:
            kind.train(folder / "run")
        except _Stop:
            pass
        finally:
            RunDirectory.save_checkpoint = saved  # type: ignore[method-assign]

    return make


def whole(name: str) -> Callable[[Path], None]:
    """Make a finished run."""

    def make(folder: Path) -> None:
        KINDS[name].train(folder / "run")

    return make


def weights(name: str) -> Callable[[Path], None]:
    """Make a file of a whole run's weights."""

    def make(folder: Path) -> None:
        import tempfile

        with tempfile.TemporaryDirectory() as run:
            KINDS[name].train(Path(run) / "run").save_weights(folder / "w.safetensors")

    return make


def agilerl(folder: Path) -> None:
    """Make a checkpoint as AgileRL's PPO writes it."""
    torch.manual_seed(0)

    def network(outputs: int) -> dict[str, torch.Tensor]:
        layers = OrderedDict(linear_layer_0=torch.nn.Linear(4, 6))
        layers["linear_layer_output"] = torch.nn.Linear(6, outputs)
        return {f"feature_net.{k}": v for k, v in torch.nn.Sequential(layers).state_dict().items()}

    def described(outputs: int, end: str | None) -> dict[str, Any]:
        return {
            "num_inputs": 4,
            "num_outputs": outputs,
            "hidden_size": [6],
            "mlp_activation": "Tanh",
            "mlp_output_activation": end,
            "layer_norm": False,
            "device": torch.device("cpu"),
        }

    checkpoint = {
        "algo": "PPO",
        "gamma": 0.97,
        "lr": 3e-4,
        "batch_size": 32,
        "one_hot": False,
        "index": 2,
        "scores": [np.float64(1.5)],
        "fitness": [np.float32(2.0)],
        "steps": [0, np.int64(9)],
        "actor_init_dict": described(2, "Softmax"),
        "critic_init_dict": described(1, None),
        "actor_state_dict": network(2),
        "critic_state_dict": network(1),
        "array": np.arange(3.0),
    }
    torch.save(checkpoint, folder / "old.pt")


def onnx_file(path: Path) -> None:
    """Write CartPole's linear controller as an ONNX model."""
    import onnx
    from onnx import TensorProto, helper

    weight = np.array([[-0.1, 0.1], [-0.2, 0.2], [-2.0, 2.0], [-1.0, 1.0]], np.float32)
    node = helper.make_node("MatMul", ["obs", "w"], ["logits"])
    shapes = {"obs": ["n", 4], "logits": ["n", 2]}
    ends = [helper.make_tensor_value_info(k, TensorProto.FLOAT, v) for k, v in shapes.items()]
    graph = helper.make_graph(
        [node], "linear", ends[:1], ends[1:], [onnx.numpy_helper.from_array(weight, "w")]
    )
    opset = [helper.make_opsetid("", 17)]
    onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=9), str(path))


def _with_onnx(folder: Path) -> Hierarchy:
    class Model(Skill):
        policy = from_onnx(folder / "model.onnx")

    ppo = PPO(**LEARNS, network=NET)
    return Hierarchy(
        IN_PYTHON,
        [Model(), Balance()],
        algorithm=ppo,
        selector=ppo,
        learn="apart",
        apart=Apart(skill_steps=64, selector_steps=64),
    )


def onnx_run(folder: Path) -> None:
    """Make a run with a skill that is an ONNX file."""
    onnx_file(folder / "model.onnx")
    _with_onnx(folder).train(folder / "run", seed=0, quiet=True)


def agent(folder: Path) -> None:
    """Make one plain agent's run."""
    ppo = PPO(**LEARNS, network=NET, normalize_obs=True)
    train_agent(IN_PYTHON, ppo, 128, folder / "run", quiet=True)


# Few steps to resume: there are many cases.
SHORT = Kind(lambda: hierarchy_of(128, PPO(**LEARNS, network=NET), PPO(**LEARNS, network=NET)))
SHORT_REPLAY = Kind(
    lambda: alone(TINY_IN_PYTHON, SAC(**REPLAYS, normalize_obs=True, n_step=3), 200)
)
SHORT_TOGETHER = Kind(lambda: together(576))
SHORT_TOGETHER_REPLAY = Kind(lambda: together_replay(80))
SHORT_START = Kind(lambda: together_replay(80), before=lambda: together_replay(80))
SAMPLES: dict[str, Sample] = {
    "hierarchy": Sample(
        whole("skills and selector, replay"), declared(KINDS["skills and selector, replay"])
    ),
    "hierarchy of data": Sample(whole("skills and selector"), from_data),
    "continuous": Sample(
        whole("replay of continuous actions"), declared(KINDS["replay of continuous actions"])
    ),
    "recurrent": Sample(whole("recurrent"), from_data, share=0.3),
    "agent": Sample(agent, from_data),
    "population": Sample(whole("population"), from_data),
    "unfinished": Sample(unfinished(SHORT, 5), resumed(SHORT), share=0.4),
    "unfinished population": Sample(
        unfinished(KINDS["population, replay"], 2),
        resumed(KINDS["population, replay"]),
        share=0.1,
    ),
    "unfinished replay": Sample(unfinished(SHORT_REPLAY, 3), resumed(SHORT_REPLAY), share=0.2),
    "unfinished together": Sample(
        unfinished(SHORT_TOGETHER, 2), resumed(SHORT_TOGETHER), share=0.2
    ),
    "unfinished together, replay": Sample(
        unfinished(SHORT_TOGETHER_REPLAY, 8), resumed(SHORT_TOGETHER_REPLAY), share=0.2
    ),
    "unfinished start from another run": Sample(
        unfinished(SHORT_START, 1), resumed(SHORT_START), share=0.2
    ),
    "weights": Sample(weights("skills and selector"), weights_file(KINDS["skills and selector"])),
    "flat weights": Sample(weights("replay of continuous actions"), flat_weights),
    "AgileRL": Sample(agilerl, converted),
    "ONNX": Sample(onnx_run, onnx_skill, share=0.3),
}
