"""AgileRL's pickles: refused by ``load``, converted by ``import-agilerl``, never run."""

from __future__ import annotations

import os
import pickle
import struct
import subprocess
import sys
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from skillweave.algorithms.agent_policy import AgentPolicy
from skillweave.cli import main
from skillweave.compat import pickles
from skillweave.compat.agilerl.algorithms.dqn import DQN
from skillweave.compat.agilerl.algorithms.ppo import PPO
from skillweave.compat.agilerl.algorithms.td3 import TD3
from skillweave.compat.pickles import read_torch_pickle
from skillweave.errors import RunError

OBS = torch.from_numpy(np.random.default_rng(0).normal(size=(5, 8)).astype(np.float32))


def network(outputs: int, norm: bool = True, activation: Any = nn.ReLU, inputs: int = 8) -> Any:
    """An MLP whose weights have the names that AgileRL gives them."""
    layers: OrderedDict[str, nn.Module] = OrderedDict()
    for i, (n_in, n_out) in enumerate([(inputs, 16), (16, 12)]):
        layers[f"linear_layer_{i}"] = nn.Linear(n_in, n_out)
        if norm:
            layers[f"layer_norm_{i}"] = nn.LayerNorm(n_out)
        layers[f"activation_{i}"] = activation()
    layers["linear_layer_output"] = nn.Linear(12, outputs)
    whole = nn.Module()
    whole.feature_net = nn.Sequential(layers)
    return whole


def init_dict(
    outputs: int, output: str | None, activation: str = "Tanh", norm: bool = True, inputs: int = 8
):
    return {
        "num_inputs": inputs, "num_outputs": outputs, "hidden_size": [16, 12],
        "mlp_activation": activation, "mlp_output_activation": output, "layer_norm": norm,
        "device": torch.device("cpu"), "accelerator": None, "support": None,
    }  # fmt: skip


def write(path: Path, **more: object) -> None:
    """Save what all checkpoints have, and more."""
    common = {
        "gamma": 0.97, "batch_size": 32, "one_hot": False, "index": 2, "mut": None,
        "scores": [np.float64(1.5)], "fitness": [np.float32(2.0)], "steps": [0, np.int64(9)],
        "state_dim": (8,), "device": torch.device("cpu"), "some_array": np.arange(3.0),
    }  # fmt: skip
    torch.save(common | more, path)


def ppo_file(path: Path, norm: bool = True, **changes: object) -> tuple[nn.Module, nn.Module]:
    torch.manual_seed(0)
    actor, critic = network(4, norm, nn.Tanh), network(1, norm, nn.Tanh)
    data = {
        "algo": "PPO", "lr": 3e-4, "clip_coef": 0.1,
        "actor_init_dict": init_dict(4, "Softmax", norm=norm),
        "critic_init_dict": init_dict(1, None, norm=norm),
        "actor_state_dict": actor.state_dict(), "critic_state_dict": critic.state_dict(),
        "optimizer_state_dict": torch.optim.Adam(actor.parameters()).state_dict(),
    }  # fmt: skip
    write(path, **data | changes)
    return actor, critic


def command(*words: object) -> int:
    return main(["import-agilerl", *map(str, words)])


@pytest.mark.parametrize("norm", [False, True])
def test_a_ppo_checkpoint_becomes_an_agent_that_computes_the_same(tmp_path, norm, capsys):
    actor, critic = ppo_file(tmp_path / "old.pt", norm)
    assert command(tmp_path / "old.pt", "--trust", "-o", tmp_path / "new.pt") == 0
    assert "PPO agent" in capsys.readouterr().out
    agent = PPO.load(tmp_path / "new.pt")
    assert agent.member.config.min_advantage_std == 0.0
    want = actor.feature_net(OBS).log_softmax(-1).detach()
    found = torch.from_numpy(policy(agent).heads(OBS.numpy())).log_softmax(-1)
    np.testing.assert_allclose(found, want, atol=1e-5)
    want = critic.feature_net(OBS)[:, 0].detach()
    np.testing.assert_allclose(agent.getAction(OBS)[3], want, atol=1e-5)
    assert (agent.lr, agent.gamma, agent.clip_coef, agent.batch_size) == (3e-4, 0.97, 0.1, 32)
    assert (agent.scores, agent.steps, agent.index) == ([1.5], [0, 9], 2)


def policy(agent: Any) -> AgentPolicy:
    return AgentPolicy.of(agent.learner, agent.member.state)


def test_a_dqn_checkpoint_with_a_pickled_loss(tmp_path):
    actor = network(4)
    write(
        tmp_path / "old.pt", algo="DQN", actor_init_dict=init_dict(4, None, "ReLU"), lr=1e-3,
        learn_step=5, actor_state_dict=actor.state_dict(), criterion=nn.MSELoss(), tau=0.01,
    )  # fmt: skip
    assert command(tmp_path / "old.pt", "--trust") == 0
    agent = DQN.load(tmp_path / "old.safetensors")
    want = actor.feature_net(OBS).detach()
    np.testing.assert_allclose(policy(agent).heads(OBS.numpy()), want, atol=1e-5)
    assert (agent.learn_step, agent.tau) == (5, 0.01)


def test_a_td3_checkpoint_has_its_critics(tmp_path):
    actor = network(2)
    critics = [network(1, inputs=10) for _ in range(2)]
    data = {}
    for i, critic in enumerate(critics, 1):
        data[f"critic_{i}_init_dict"] = init_dict(1, None, "ReLU", inputs=10)
        data[f"critic_{i}_state_dict"] = critic.state_dict()
    write(
        tmp_path / "old.pt", algo="TD3", actor_init_dict=init_dict(2, "Tanh", "ReLU"),
        lr_actor=1e-4, lr_critic=1e-3, min_action=-2, max_action=np.array([2.0, 2.0]),
        policy_freq=3, learn_step=2, actor_state_dict=actor.state_dict(), **data,
    )  # fmt: skip
    assert command(tmp_path / "old.pt", "--trust") == 0
    agent = TD3.load(tmp_path / "old.safetensors")
    assert agent.member.config.action_l2 == 0.0  # AgileRL has no such cost
    want = 2.0 * actor.feature_net(OBS).tanh().detach()
    np.testing.assert_allclose(agent.act(OBS, explore=False), want, atol=1e-5)
    assert (agent.lr_actor, agent.policy_freq) == (pytest.approx(1e-4), 3)
    learner, state = agent.learner, agent.member.state
    action = torch.rand(5, 2)
    views = learner.critics.views(state.critic)
    found = learner.critics(views, {"vector": OBS[None]}, action[None])
    for i, critic in enumerate(critics):
        want = critic.feature_net(torch.cat([OBS, action], 1))
        torch.testing.assert_close(found[0, i], want)


def test_without_trust_a_pickle_is_not_read(tmp_path, capsys):
    ppo_file(tmp_path / "old.pt")
    with pytest.raises(RunError, match=r"import-agilerl .*old\.pt --trust"):
        PPO.load(tmp_path / "old.pt")
    assert command(tmp_path / "old.pt") == 1
    assert "--trust" in capsys.readouterr().err
    assert not (tmp_path / "old.safetensors").exists()


class Bomb:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


class Eval:
    def __reduce__(self):
        return eval, ("1",)


@pytest.mark.parametrize("what", ["bomb", "eval", "object array", "own class"])
def test_a_pickle_that_names_anything_else_is_refused_and_does_nothing(tmp_path, capsys, what):
    value = {
        "bomb": Bomb(tmp_path / "boom"), "eval": Eval(), "own class": nn.Linear(2, 2),
        "object array": np.array([{}], dtype=object),
    }[what]  # fmt: skip
    ppo_file(tmp_path / "old.pt", extra=value)
    assert command(tmp_path / "old.pt", "--trust") == 1
    assert "refused" in capsys.readouterr().err
    assert not (tmp_path / "boom").exists()
    assert not (tmp_path / "old.safetensors").exists()


def test_arrays_and_numbers_come_as_they_were(tmp_path):
    value = {
        "f": np.arange(6.0).reshape(2, 3), "t": np.asfortranarray(np.eye(3)), "n": np.int32(4),
        "big": np.arange(3, dtype=">i4"), "set": {1, 2}, "view": torch.arange(9.0).view(3, 3).T[1:],
        "empty": torch.zeros(0), "bool": np.bool_(True), "text": "é",
    }  # fmt: skip
    torch.save(value, tmp_path / "x.pt")
    found = read_torch_pickle(tmp_path / "x.pt")
    assert list(found) == list(value)
    for key, want in value.items():
        np.testing.assert_array_equal(np.asarray(found[key]), np.asarray(want), err_msg=key)


# What a file of a stranger's may hold


def write_program(path: Path, program: bytes, **how: Any) -> Path:
    """A zip as torch.save writes it, of a pickle's program and nothing else."""
    with zipfile.ZipFile(path, "w", **how) as file:
        file.writestr("archive/data.pkl", program)
    return path


DEEP = 200_000
PROGRAMS = {
    # Hashing such a key overflows the stack of the interpreter.
    "a tuple as a key": b"\x80\x02})" + b"\x85" * DEEP + b"K\x01s.",
    "a frozenset": b"\x80\x04" + b"(" * DEEP + b"\x91" * DEEP + b".",
    "lists": b"\x80\x02" + b"]" * DEEP + b"a" * (DEEP - 1) + b".",
    "a circle": b"\x80\x02]q\x00]q\x01h\x00h\x01a0h\x01h\x00a.",
}


@pytest.mark.slow
def test_a_pickle_nested_too_deep_is_refused(tmp_path):
    for name, program in PROGRAMS.items():
        write_program(tmp_path / name, program)
    # In a process of their own, which they may crash.
    code = """
import sys
from pathlib import Path
from skillweave.compat.pickles import read_torch_pickle
from skillweave.errors import SkillweaveError
for path in sys.argv[1:]:
    print(Path(path).name, end=": ", flush=True)
    try:
        read_torch_pickle(Path(path))
    except SkillweaveError as error:
        print("refused" if "deep" in str(error) else error)
    else:
        print("read")
"""
    command = [sys.executable, "-c", code, *(str(tmp_path / name) for name in PROGRAMS)]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.stdout.splitlines() == [f"{name}: refused" for name in PROGRAMS]
    assert result.returncode == 0


def test_a_pickle_that_is_huge_when_written_out_is_refused(tmp_path):
    doubling = b"".join(b"](h%ch%ceq%c" % (i, i, i + 1) for i in range(60))
    for program, says in (
        (b"\x80\x02]q\x00" + doubling + b".", "more than 500,000 objects"),
        (b"\x80\x02(" + b"N" * 600_000 + b"t.", "more than 500,000 operations"),
        (b"\x80\x02]2a.", "refused: the pickle doubles an object"),
        (b"N" * 20_000_000, "its pickle declares 20,000,000 bytes"),
    ):
        with pytest.raises(RunError, match=says):
            read_torch_pickle(write_program(tmp_path / "x.pt", program))
    # Sizes that a file declares are looked at before it is read.
    zeros = b"\x80\x02(" + b"0" * 10_000_000
    path = write_program(tmp_path / "x.pt", zeros, compression=zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 50_000
    with pytest.raises(RunError, match=r"x\.pt: refused: it declares 10,000,003 bytes"):
        read_torch_pickle(path)


def test_a_tensor_that_repeats_one_number_takes_no_memory(tmp_path):
    torch.save({"x": torch.ones(1).expand(10**12)}, tmp_path / "x.pt")
    found = read_torch_pickle(tmp_path / "x.pt")["x"]
    assert found.shape == (10**12,)
    assert found.untyped_storage().nbytes() == 4


def test_a_zip_that_is_quoted_at_length_is_told_in_short(tmp_path):
    path = write_program(tmp_path / "x.pt", b"N" * 20_000)
    data = bytearray(path.read_bytes())
    data[26:28] = struct.pack("<H", 10_000)  # the length of its file's name, which zipfile quotes
    path.write_bytes(data)
    with pytest.raises(RunError, match=r"x\.pt is no checkpoint of torch\.save") as raised:
        read_torch_pickle(path)
    assert len(str(raised.value)) < 1_000


# BUILD sets attributes: of what `find_class` returned, too, if that lets it.
BUILDS = {
    "a function": b"ctorch._utils\n_rebuild_parameter\n",
    "a class": b"cnumpy\nndarray\n",
    "a loss's class": b"ctorch.nn.modules.loss\nMSELoss\n",
    "a container's class": b"ccollections\nOrderedDict\n",
    "a device's class": b"ctorch\ndevice\n",
}


@pytest.mark.parametrize("thing", BUILDS.values(), ids=BUILDS.keys())
@pytest.mark.parametrize(
    "state", [b"}X\x04\x00\x00\x00evilK\x01s", b"N}X\x04\x00\x00\x00evilK\x01s\x86"]
)
def test_a_pickle_cannot_set_attributes_of_what_reads_it(tmp_path, thing, state):
    path = write_program(tmp_path / "x.pt", b"\x80\x02" + thing + state + b"b.")
    with pytest.raises(RunError, match=r"refused|is damaged"):
        read_torch_pickle(path)
    for kind in (*pickles._ALLOWED.values(), pickles.Inert, pickles._Array, torch.Tensor):
        assert not hasattr(kind, "evil")


def test_a_pickle_cannot_set_attributes_of_a_tensor(tmp_path):
    torch.save({"x": torch.ones(3)}, tmp_path / "x.pt")
    with zipfile.ZipFile(tmp_path / "x.pt") as file:
        members = {n: file.read(n) for n in file.namelist()}
    name = next(n for n in members if n.endswith("data.pkl"))
    head, tail = members[name].rsplit(b"R", 1)  # the tensor is made, and put into the dict
    members[name] = head + b"R}X\x04\x00\x00\x00evilK\x01sb" + tail
    with zipfile.ZipFile(tmp_path / "y.pt", "w") as file:
        for n, data in members.items():
            file.writestr(n, data)
    with pytest.raises(RunError, match="refused: the pickle sets the attributes of a tensor"):
        read_torch_pickle(tmp_path / "y.pt")


def altered(change):
    """The state dict of ``ppo_file``'s actor with one weight changed."""
    torch.manual_seed(0)
    weights = dict(network(4, True, nn.Tanh).state_dict())
    key = "feature_net.linear_layer_1.weight"
    return {"actor_state_dict": weights | {key: change(weights[key])}}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"algo": "MADDPG"}, "MADDPG"),
        ({"actor_init_dict": {"channel_size": [3]}}, "CNN"),
        ({"actor_init_dict": init_dict(4, "GumbelSoftmax")}, "GumbelSoftmax"),
        ({"actor_init_dict": init_dict(4, "Softmax", "PReLU")}, "PReLU"),
        ({"actor_init_dict": init_dict(5, "Softmax")}, "shape"),
        ({"actor_state_dict": {}}, "no weights for"),
        ({"actor_state_dict": {"other.weight": torch.ones(1)}}, "unknown weights other.weight"),
        (altered(lambda w: w.t().contiguous()), "(16, 12), but (12, 16) is described"),
        (altered(lambda w: w.reshape(6, 32)), "(6, 32), but (12, 16) is described"),
        (altered(lambda w: w.reshape(-1)), "(192,), but (12, 16) is described"),
        (altered(lambda w: w * float("nan")), "holds NaN, infinity"),
        (altered(lambda w: w.double() * 1e300), "holds NaN, infinity"),
        (altered(lambda w: w.long()), "no real numbers"),
        (altered(lambda w: 5), "linear_layer_1.weight is no weights"),
        ({"actor_state_dict": 5}, "actor_state_dict is 5; it must be an object"),
        ({"actor_init_dict": [1]}, "actor_init_dict is [1]; it must be an object"),
        ({"actor_init_dict": init_dict(10**9, "Softmax")}, "num_outputs is 10000000"),
        ({"actor_init_dict": init_dict(4, "Softmax", inputs=10**12)}, "num_inputs is"),
        ({"lr": "a"}, "lr is 'a'; it must be a finite number"),
        ({"lr": float("nan")}, "lr is nan; it must be a finite number"),
        ({"gamma": 7.0}, "PPO.gamma is 7.0"),
        ({"index": [1]}, "index is [1]; it must be a whole number"),
        ({"scores": 5}, "scores is 5; it must be a list"),
        ({"scores": ["a"]}, "scores[0] is 'a'; it must be a finite number"),
        ({"algo": ["PPO"]}, "algorithm ['PPO']"),
        ({"critic_init_dict": None}, "critic_init_dict is None; it must be an object"),
    ],
)
def test_what_is_not_as_agilerl_writes_it_is_told_by_its_field(tmp_path, capsys, change, says):
    ppo_file(tmp_path / "old.pt", **change)
    assert command(tmp_path / "old.pt", "--trust") == 1
    told = capsys.readouterr().err
    assert says in told
    assert "old.pt" in told
    assert len(told) < 600
    assert not (tmp_path / "old.safetensors").exists()


def test_missing_damaged_and_foreign_files(tmp_path, capsys):
    (tmp_path / "text.pt").write_text("hello")
    (tmp_path / "plain.pt").write_bytes(pickle.dumps({"a": 1}))
    ppo_file(tmp_path / "half.pt")
    data = (tmp_path / "half.pt").read_bytes()
    (tmp_path / "half.pt").write_bytes(data[: len(data) // 2])
    for name, says in {
        "nothing.pt": "does not exist", "text.pt": "no checkpoint", "plain.pt": "no checkpoint",
        "half.pt": "no checkpoint",
    }.items():  # fmt: skip
        assert command(tmp_path / name, "--trust") == 1
        assert says in capsys.readouterr().err
