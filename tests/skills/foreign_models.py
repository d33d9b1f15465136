"""Small models of every kind, for the tests of foreign skills."""

from __future__ import annotations

import base64
import json
import pickle
import zipfile
from pathlib import Path

import numpy as np
import torch
from skills.mapped_models import onnx_model

WEIGHT = np.array([[-0.1, 0.1], [-0.2, 0.2], [-2.0, 2.0], [-1.0, 1.0]], np.float32)
"""Logits of CartPole's two actions: a controller that balances."""


def linear(weight=WEIGHT) -> torch.nn.Linear:
    weight = torch.tensor(np.asarray(weight, np.float32))
    module = torch.nn.Linear(*weight.shape, bias=False)
    with torch.no_grad():
        module.weight[:] = weight.T
    return module


def onnx_file(
    path: Path, weight=WEIGHT, batch="n", whole: bool = False, apart: bool = False
) -> Path:
    """obs · weight as an ONNX file; ``whole``: returns the largest one; ``apart``: two files."""
    weight = np.asarray(weight, np.float32)
    largest = "ArgMax", ["logits"], ["action"], {"axis": 1, "keepdims": 0}
    outputs = [("action", [batch]), ("logits", [batch, weight.shape[1]])]
    beside = {"save_as_external_data": True, "location": "w.data", "size_threshold": 0}
    return onnx_model(
        path,
        [("MatMul", ["obs", "w"], ["logits"]), largest],
        {"obs": [batch, weight.shape[0]]},
        dict(outputs if whole else outputs[::-1]),
        {"w": weight},
        **(beside if apart else {}),
    )


def sb3_zip(path: Path, name: str = "ppo", env="CartPole-v1", **settings) -> Path:
    import stable_baselines3

    policy = settings.pop("policy", "MlpPolicy")
    kind = getattr(stable_baselines3, name.upper())
    kind(policy, env, seed=0, device="cpu", **settings).save(path)
    return path


class Evil:
    """Leaves a file behind when it is unpickled."""

    def __init__(self, mark: Path):
        self.mark = mark

    def __reduce__(self):
        return Path.touch, (self.mark,)


def poisoned(path: Path, mark: Path) -> Path:
    """A model's zip that creates ``mark`` when it is opened."""
    sound = sb3_zip(path.with_name("sound.zip"))
    evil = base64.b64encode(pickle.dumps(Evil(mark))).decode()
    with zipfile.ZipFile(sound) as old, zipfile.ZipFile(path, "w") as new:
        for item in old.namelist():
            content = old.read(item)
            if item == "data":
                data = json.loads(content) | {"evil": {":type:": "x", ":serialized:": evil}}
                content = json.dumps(data).encode()
            new.writestr(item, content)
    return path
