"""Words that people of other tools type, and what to write here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields

from skillweave._internal.messages import ELSEWHERE, suggest

COMMANDS = {
    "enjoy": "evaluate, or render for a film",
    "fit": "train",
    "learn": "train",
    "play": "render",
    "record": "render, or log for calls",
    "test": "evaluate",
    "tune": "sweep, or train with --evolve population=8",
    "version": "skillweave --version",
}
"""By commands of other tools, the words for it here."""
OPTIONS = {
    "algo": "--set selector=DQN, and --set skills.NAME=SAC for a skill",
    "capture-video": "--render",
    "checkpoint": "skillweave resume RUN, or --start-from RUN",
    "config": "--set NAME=VALUE, once for each setting",
    "cuda": "--set selector.device=cuda, and --set skills.NAME.device=cuda for a skill",
    "env": "a Python file with a Hierarchy in it, and skillweave train FILE.py",
    "exp-name": "--out DIR",
    "gpu": "--set selector.device=cuda, and --set skills.NAME.device=cuda for a skill",
    "num-workers": "--collectors N",
    "seeds": "skillweave sweep RECIPE --seeds 0:5",
    "tensorboard": "--track tensorboard",
    "timesteps": "--set steps=N",
    "wandb": "--track wandb",
}
"""By options of other tools, the words for it here."""
SAME = {
    "algorithm": "algo",
    "env-id": "env",
    "load": "checkpoint",
    "log-dir": "exp-name",
    "max-steps": "timesteps",
    "n-timesteps": "timesteps",
    "name": "exp-name",
    "output-dir": "exp-name",
    "run-name": "exp-name",
    "steps": "timesteps",
    "total-steps": "timesteps",
    "total-timesteps": "timesteps",
    "video": "capture-video",
    "workers": "num-workers",
}
"""Other names of these options."""
OF_TRAIN = ("eval_every", "eval_episodes", "checkpoint_every", "keep", "log_info")
"""Arguments of ``train`` that ``--set train.NAME`` sets: ``training.defaults.AGENT_DEFAULTS``."""
SETTINGS = (
    "batch_size",
    "buffer_size",
    "clip_coef",
    "device",
    "ent_coef",
    "gae_lambda",
    "gamma",
    "learning_rate",
    "n_steps",
    "num_envs",
    "tau",
    "update_epochs",
)
"""Settings of algorithms that are options elsewhere; here is no list of all, to start quickly."""


def foreign_words(words: Sequence[str], commands: Mapping[str, type]) -> str:
    """Return a sentence on a command or an option of another tool; empty: there is none.

    Args:
        words: the command line.
        commands: by name, the dataclass of its options.
    """
    if not words or words[0].startswith("-"):
        return ""
    name, *rest = words
    if name not in commands:
        way = COMMANDS.get(name)
        meant = f": write {way}" if way else suggest(name, commands)
        return f"no command {name!r}{meant} (skillweave --help)"
    known = {field.name.replace("_", "-") for field in fields(commands[name])}
    for word in rest:
        option = word.partition("=")[0].removeprefix("--").replace("_", "-").lower()
        if not word.startswith("--") or option in known:
            continue
        if way := _way(option, "set" in known):
            return f"{name} has no option --{option}: write {way} (skillweave {name} --help)"
    return ""


def _way(option: str, trains: bool) -> str | None:
    """Return advice in place of another tool's option; None: the option is unknown.

    Args:
        option: without dashes before it.
        trains: the command has settings.
    """
    if not trains:
        return None
    if way := OPTIONS.get(SAME.get(option, option)):
        return way
    setting = option.replace("-", "_")
    setting = ELSEWHERE.get(setting, setting)
    if setting in OF_TRAIN:
        return f"--set train.{setting}=VALUE"
    if setting in SETTINGS:
        return f"--set selector.{setting}=VALUE, and --set skills.NAME.{setting}=VALUE for a skill"
    return None
