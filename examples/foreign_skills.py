"""Skills from anywhere: a function, a PyTorch module, a Stable-Baselines3 model, an ONNX file.

Each becomes a skill's policy in one line; the selector learns which of them to call on CartPole.

    pip install 'skillweave[sb3,onnx]'
    python examples/foreign_skills.py
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import onnx
import stable_baselines3 as sb3
import torch
from onnx import TensorProto, helper

from skillweave import PPO, Apart, Hierarchy, Skill, from_onnx, from_sb3
from skillweave.types import Array

ENV = "CartPole-v1"


class Upright(Skill):
    """A function of observations (n, 4): here as a method, a bare function will do too."""

    def policy(self, obs: Array) -> Array:
        return (obs[:, 2] + 0.5 * obs[:, 3] > 0).astype(np.int64)


class Untrained(Skill):
    """A module: observations to logits (n, 2). Its weights are copied into the run."""

    policy = torch.nn.Sequential(torch.nn.Linear(4, 16), torch.nn.Tanh(), torch.nn.Linear(16, 2))


def skills(folder: Path) -> list[Skill]:
    """Those above, and two whose files were just made."""

    class Learnt(Skill):
        """A zip holds pickles, which can run code: open only what you trust. Named in the run."""

        policy = from_sb3(make_zip(folder), "ppo", trust=True)

    class Exported(Skill):
        """The file is copied into the run."""

        policy = from_onnx(make_onnx(folder))

    return [Upright(), Untrained(), Learnt(), Exported()]


def make_zip(folder: Path) -> Path:
    """Make a zip of Stable-Baselines3's PPO after a moment of training."""
    model = sb3.PPO("MlpPolicy", ENV, n_steps=256, seed=0, device="cpu")
    model.learn(1_000).save(folder / "ppo.zip")
    return folder / "ppo.zip"


def make_onnx(folder: Path) -> Path:
    """Make a linear controller, logits = obs · gains, as any framework's exporter could."""
    gains = np.outer([0.1, 0.3, 2.0, 1.0], [-1.0, 1.0]).astype(np.float32)
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["obs", "gains"], ["logits"])],
        "controller",
        [helper.make_tensor_value_info("obs", TensorProto.FLOAT, ["n", 4])],
        [helper.make_tensor_value_info("logits", TensorProto.FLOAT, ["n", 2])],
        [onnx.numpy_helper.from_array(gains, "gains")],
    )
    opset = helper.make_opsetid("", 17)
    onnx.save(helper.make_model(graph, opset_imports=[opset], ir_version=9), folder / "skill.onnx")
    return folder / "skill.onnx"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=30_000, help="training of the selector")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        hierarchy = Hierarchy(
            ENV,
            skills(folder),
            call_steps=5,
            selector=PPO(num_envs=8, n_steps=320, batch_size=128),
            apart=Apart(selector_steps=args.steps),
        )
        run = hierarchy.train(folder / "run", seed=args.seed, quiet=True)
        for entry in run.info()["skills"]:
            score = run.evaluate(20, skill=entry["name"])
            print(f"{entry['name']:<10} {score.mean:5.1f}  {entry['policy']}")
        print(
            "kept in the run:", ", ".join(sorted(p.name for p in (run.path / "policies").iterdir()))
        )
        print(f"skills under the selector: {run.evaluate(20)}")


if __name__ == "__main__":
    main()
