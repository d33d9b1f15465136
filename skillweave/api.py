"""What users call: declare a ``Hierarchy``, train it, get a ``Run``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave import recipes
from skillweave.algorithms.config import AlgorithmConfig
from skillweave.envs.make import EnvSpec
from skillweave.evolution.plan import Evolve, plan, trainer
from skillweave.hierarchy import training
from skillweave.hierarchy.declaration import Declaration, check_budgets
from skillweave.hierarchy.policy import HierarchyPolicy, SkillAlone
from skillweave.hierarchy.weights import read_weights, write_weights
from skillweave.messages import short, whole_number
from skillweave.reporting.progress import Progress
from skillweave.reporting.video import color_of, render_policy
from skillweave.runs.directory import RunDirectory
from skillweave.runs.trackers import make_trackers
from skillweave.skills import Skill
from skillweave.training.evaluation import Evaluation, evaluate
from skillweave.training.stage import check_replay
from skillweave.types import Memory, Policy, SkillweaveError


class Hierarchy(Declaration):
    """Skills, reflexes and a selector on one environment: declared, then trained and watched."""

    recipe: str | None = None
    """Where it was declared: a shipped recipe's name or a file; written into runs."""

    def train(
        self,
        run_dir: str | Path,
        *,
        seed: int = 0,
        flat: bool = False,
        quiet: bool = False,
        track: Sequence[str] = (),
        evolve: Evolve = None,
    ) -> Run:
        """Train every skill, then the selector; everything goes to ``run_dir``.

        Args:
            run_dir: a new directory; an existing run is never overwritten.
            seed: the root of every random stream.
            flat: train one plain agent on the same number of steps instead: the baseline.
            quiet: no progress.
            track: "tensorboard", "wandb".
            evolve: a population for every agent, or by stage (a skill's name, "selector", "flat")
                for some. Its budget is the stage's for each member, measuring fitness included.

        Raises:
            SkillweaveError: the declaration does not fit the environment, or training diverged.
        """
        seed = whole_number(seed, "seed", 0)
        run_dir = _as_path(run_dir, "run_dir")
        observation_space, action_space = self.check_spaces()
        content = training.manifest(self, seed=seed, flat=flat)
        plan(content["stages"], evolve)
        check_budgets(content["stages"])
        for stage in content["stages"]:
            chooses = stage["name"] == "selector"
            acts = gym.spaces.Discrete(len(self.skills)) if chooses else action_space
            check_replay(stage, observation_space, acts)
        if isinstance(track, str) or not isinstance(track, Sequence):
            raise SkillweaveError(f"track is {short(track)}; it must be a list: track=['wandb']")
        track = tuple(track)
        make_trackers(track, None)  # a missing extra is said before anything is written
        run = RunDirectory.create(run_dir, content | {"recipe": self.recipe, "track": track})
        return self._go_on(run, quiet, evolve)

    def resume(self, run_dir: str | Path, *, quiet: bool = False, evolve: Evolve = None) -> Run:
        """Finish a run that was stopped; the end is the same as if it had not been.

        ``evolve`` is needed only where the population evolves by a selection of your own.
        """
        run = RunDirectory.open(_as_path(run_dir, "run_dir"))
        self._must_fit(run)
        return self._go_on(run, quiet, evolve)

    def load(self, run_dir: str | Path) -> Run:
        """A finished run of this hierarchy."""
        run = RunDirectory.open(_as_path(run_dir, "run_dir"))
        self._must_fit(run)
        return Run(self, run.path, training.load(self, run))

    def load_weights(self, path: str | Path) -> Run:
        """This hierarchy with the weights of one file (see ``Run.save_weights``)."""
        path = _as_path(path, "path")
        return Run(self, path, read_weights(self, path))

    @staticmethod
    def pretrained(name: str) -> Run:
        """A shipped recipe with its shipped weights."""
        return recipes.load(name).load_weights(recipes.weights_path(name))

    @classmethod
    def from_manifest(cls, manifest: dict[str, Any]) -> Hierarchy:
        """The hierarchy of a run that needs none of the user's code (plain data says it all)."""
        spec = EnvSpec(manifest["env"], kwargs=manifest["env_kwargs"])
        if not spec.is_data:
            raise SkillweaveError(f"the environment {spec.name!r} names code; give the recipe")
        flat = manifest["kind"] == "flat"
        call_steps = 1 if flat else manifest["call_steps"]
        described = manifest.get("skills") or [{"name": "task", "max_steps": None}]
        skills = [
            type(s["name"], (Skill,), {"name": s["name"], "max_steps": s["max_steps"]})()
            for s in described
        ]
        return cls(spec, skills, call_steps=call_steps)

    def _go_on(self, run: RunDirectory, quiet: bool, evolve: Evolve) -> Run:
        with ExitStack() as stack:
            stack.callback(run.close)
            run.begin()
            progress = stack.enter_context(Progress(quiet=quiet))
            trackers = make_trackers(run.manifest.get("track", ()), run)
            for tracker in trackers:
                stack.callback(tracker.close)
            policy = training.train(self, run, (progress, *trackers), trainer(run, evolve))
        return Run(self, run.path, policy)

    def _must_fit(self, run: RunDirectory) -> None:
        mine = [s.name for s in self.skills]
        theirs = [s["name"] for s in run.manifest["skills"]]
        if mine != theirs:
            raise SkillweaveError(
                f"{run.path} was trained with the skills {', '.join(theirs)}, but this hierarchy "
                f"has {', '.join(mine)}"
            )
        if run.manifest["env"] != self.spec.name:
            raise SkillweaveError(
                f"{run.path} was trained on {run.manifest['env']}, but this hierarchy is on "
                f"{self.spec.name}"
            )
        self.call_steps = run.manifest["call_steps"]
        self.reflexes_in_training = run.manifest.get("reflexes_in_training", True)
        self.greedy_skills = run.manifest["greedy_skills"]


def _as_path(path: str | Path, name: str) -> Path:
    if not isinstance(path, str | Path) or "\0" in str(path) or len(str(path)) > 4_096:
        raise SkillweaveError(f"{name} is {short(path)}; it must be a path")
    return Path(path)


class Task(Skill):
    """The environment's own reward and ends."""


def train_agent(
    env: str | Callable[[], gym.Env[Any, Any]] | EnvSpec,
    algorithm: AlgorithmConfig,
    steps: int,
    run_dir: str | Path,
    *,
    seed: int = 0,
    quiet: bool = False,
    track: Sequence[str] = (),
    evolve: Evolve = None,
) -> Run:
    """Train one plain agent on an environment's own reward; the run is like any other.

    Args:
        env: a Gymnasium id, a function that makes an environment, or an ``EnvSpec``.
        algorithm: its settings, ``SAC()`` for example.
        steps: training budget in environment steps.
        run_dir, seed, quiet, track, evolve: as in ``Hierarchy.train``.

    Raises:
        SkillweaveError: the algorithm cannot act in the environment; the message says which can.
    """
    hierarchy = Hierarchy(env, [Task()], algorithm=algorithm, flat_steps=steps)
    how: Any = {"seed": seed, "quiet": quiet, "track": track, "evolve": evolve}
    return hierarchy.train(run_dir, flat=True, **how)


class Run:
    """A trained policy with its hierarchy: evaluate it, watch it, save it, use it as a skill."""

    def __init__(self, hierarchy: Hierarchy, path: Path, policy: Policy) -> None:
        self.hierarchy, self.path, self.policy = hierarchy, path, policy

    def evaluate(
        self,
        episodes: int = 100,
        *,
        seed: int = 0,
        deterministic: bool = True,
        skill: str | None = None,
        max_steps: int | None = None,
    ) -> Evaluation:
        """Score it on Gymnasium's environment.

        Args:
            episodes: whole episodes.
            seed: picks them.
            deterministic: act greedily, else sample. Of a hierarchy it is about the selector;
                ``greedy_skills`` is about its skills.
            skill: score this skill alone, as if the selector always chose it: the hierarchy's
                reflexes are in force, also where the skill was trained without them
                (``reflexes_in_training=False``).
            max_steps: an episode that nothing has ended by then is cut, and the result says so;
                None: the environment's own time limit, or 100,000 steps.
        """
        return evaluate(
            self._policy(skill),
            self.hierarchy.spec,
            episodes=episodes,
            seed=seed,
            deterministic=deterministic,
            max_steps=max_steps,
        )

    def render(
        self,
        path: str | Path,
        *,
        episodes: int = 1,
        seed: int = 0,
        deterministic: bool = True,
        skill: str | None = None,
        max_steps: int | None = None,
    ) -> dict[str, Any]:
        """Write a captioned GIF or MP4; ``skill`` shows one skill alone, as in ``evaluate``."""
        names = [s.name for s in self.hierarchy.skills]
        colors = {s.name: color_of(i, s.color) for i, s in enumerate(self.hierarchy.skills)}

        def label(memory: Memory) -> tuple[str, tuple[int, int, int]]:
            if skill is not None:
                return skill, colors[skill]
            acting = policy.acting(memory)
            if acting is None:
                return "flat", color_of(len(names), None)
            name = policy.labels[int(acting[0])]
            return name, colors[name]

        policy, path = self._policy(skill), _as_path(path, "path")
        seed = whole_number(seed, "seed", 0)
        return render_policy(
            self.hierarchy.spec,
            policy,
            path,
            episodes=episodes,
            seed=seed,
            deterministic=deterministic,
            label=label,
            max_steps=max_steps,
            rng=np.random.default_rng(seed),
        )

    def save_weights(self, path: str | Path) -> Path:
        """Write every policy into one file for ``Hierarchy.load_weights``."""
        path = _as_path(path, "path")
        write_weights(path, self.hierarchy, self.policy, self.hierarchy.recipe)
        return path

    def as_skill(self, name: str, **attributes: Any) -> Skill:
        """The whole hierarchy as one skill of another."""
        kind = type(name, (Skill,), {"name": name, "policy": self.policy, **attributes})
        skill: Skill = kind()
        return skill

    def info(self) -> dict[str, Any]:
        """The manifest of its run."""
        return RunDirectory.open(self.path).manifest

    def _policy(self, skill: str | None) -> Policy:
        if skill is None:
            return self.policy
        if not isinstance(self.policy, HierarchyPolicy):
            raise SkillweaveError("this is a flat agent: it has no skills")
        self.hierarchy.skill(skill)
        return SkillAlone(self.policy.skills, skill)


__all__ = ["Hierarchy", "Run", "train_agent"]
