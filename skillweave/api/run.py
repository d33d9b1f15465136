"""What training and loading give back: a ``Run``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from skillweave.api.labels import labels_of
from skillweave.api.notebook_tables import run_html
from skillweave.api.player import Player
from skillweave.arguments import checked_names
from skillweave.envs.make import EngineName
from skillweave.errors import DeclarationError
from skillweave.export.write import Export, write_export
from skillweave.hierarchy.policy import HierarchyPolicy, SkillAlone
from skillweave.hierarchy.schedule import stages_of
from skillweave.hierarchy.weights import write_weights
from skillweave.messages import as_path, shown_path, whole_number
from skillweave.reporting.film import Film
from skillweave.reporting.progress import EpisodeProgress
from skillweave.reporting.report.single import write_report
from skillweave.reporting.video import render_policy
from skillweave.runs.directory import RunDirectory
from skillweave.runs.hub import is_copy_of_hub, must_be_own
from skillweave.runs.trackers import track_film
from skillweave.skills import Skill
from skillweave.terminal import printable
from skillweave.training.evaluation import Evaluation, evaluate
from skillweave.training.evaluation_file import load_evaluation, save_evaluation
from skillweave.training.plain_agent import PlainAgent
from skillweave.types import Policy

if TYPE_CHECKING:
    from skillweave.api import Agent, Hierarchy


class Run:
    """A trained policy with its declaration: evaluate, watch or save it, use it as a skill.

    Args:
        declaration: what was trained.
        path: its directory, or its weights file.
        policy: who acts.
    """

    def __init__(self, declaration: Hierarchy | Agent, path: Path, policy: Policy) -> None:
        self.declaration, self.path, self.policy = declaration, path, policy
        self._player: Player | None = None

    def __repr__(self) -> str:
        return printable(f"<Run {shown_path(self.path)}: {str(self.declaration).strip('<>')}>")

    def _repr_html_(self) -> str:
        """Return a table of what it is, and of its stages, for notebooks."""
        return run_html(self.path, self.declaration)

    @property
    def hierarchy(self) -> Hierarchy:
        """The hierarchy that was trained.

        Raises:
            DeclarationError: this is the run of a plain agent.
        """
        if isinstance(self.declaration, PlainAgent):
            raise DeclarationError("this is the run of a plain agent: it has no hierarchy")
        return self.declaration

    @checked_names
    def evaluate(
        self,
        episodes: int = 100,
        *,
        seed: int = 0,
        deterministic: bool = True,
        skill: str | None = None,
        num_envs: int | None = None,
        max_steps: int | None = None,
        save: bool = False,
        engine: EngineName = "sync",
        quiet: bool = False,
    ) -> Evaluation:
        """Score it in whole episodes.

        Args:
            episodes: whole episodes.
            seed: picks them.
            deterministic: act greedily, else sample. Of a hierarchy it is about the selector;
                ``greedy_skills`` is about its skills.
            skill: score this skill alone, as if the selector always chose it. The hierarchy's
                reflexes are in force, also where it was trained without them. Returns are the
                environment's; ``skills`` has its call in each episode, by its own reward and
                success: from where it may start to its own end.
            num_envs: environments that exist at once; None: at most as many as in training. It
                does not change the result of a greedy policy; what is sampled differs with it.
            max_steps: an episode that nothing has ended by then is cut; None: see ``evaluate``.
            save: keep the result in the run's directory, where ``info`` finds it, instead of the
                one before. A sampled one is kept beside the score, and does not replace it. Not
                with ``skill`` or another engine.
            engine: sync: Gymnasium's environment; envpool, auto: see ``evaluate``.
            quiet: no progress; else it is shown where an evaluation takes longer than a second.

        Returns:
            Returns, lengths, and what each skill did.

        Raises:
            DeclarationError: no such skill or engine; or ``save`` where it cannot be.
        """
        if save and (skill is not None or engine != "sync"):
            raise DeclarationError("save keeps a whole policy's score: leave out skill and engine")
        if save:
            must_be_own(self.path)  # said before anything is played
        policy = self._policy(skill)
        with EpisodeProgress(episodes, quiet=quiet) as progress:
            found = evaluate(
                policy,
                self.declaration.spec,
                episodes=episodes,
                seed=seed,
                deterministic=deterministic,
                num_envs=self._training_envs() if num_envs is None else num_envs,
                max_steps=max_steps,
                watch=progress.watch,
                engine=engine,
            )
        if save:
            save_evaluation(RunDirectory.open(self.path), found, seed, deterministic)
        return found

    @checked_names
    def render(
        self,
        path: str | Path | None = None,
        *,
        episodes: int = 1,
        seed: int = 0,
        deterministic: bool = True,
        skill: str | None = None,
        max_steps: int | None = None,
        quiet: bool = False,
    ) -> Film:
        """Write a captioned film; one in the run's own folder goes to its trackers, too.

        A notebook shows the film that is returned.

        Args:
            path: the file; its ending says which, ``.gif`` or ``.mp4``. None: ``film.gif`` in the
                run's folder, with a skill's name where it acts alone. A policy without a folder of
                its own (a weights file, a copy of the hub's) writes its film where Python runs.
            episodes: how many, one after another.
            seed: picks them.
            deterministic: act greedily, else sample.
            skill: show this skill alone, as in ``evaluate``.
            max_steps: an episode that nothing has ended by then is cut.
            quiet: no progress; else it is shown where a film takes longer than a second.

        Returns:
            ``path``, and what was filmed, as plain JSON.
        """
        policy = self._policy(skill)
        path = self._film_path(skill) if path is None else as_path(path, "path")
        must_be_own(path.parent)
        seed = whole_number(seed, "seed", 0)
        plain = isinstance(self.declaration, PlainAgent)
        skills = () if plain else self.hierarchy.skills
        told = render_policy(
            self.declaration.spec,
            policy,
            path,
            episodes=episodes,
            seed=seed,
            deterministic=deterministic,
            label=labels_of(policy, skills, skill),
            max_steps=max_steps,
            rng=np.random.default_rng(seed),
            quiet=quiet,
        )
        if path.parent.resolve() == self.path.resolve():
            track_film(RunDirectory.open(self.path), path)
        return Film(told)

    def _film_path(self, skill: str | None) -> Path:
        """Return where a film is written if nobody says where."""
        ending = "" if skill is None else "-" + skill.replace("/", ".")
        if self.path.is_dir() and not is_copy_of_hub(self.path):
            return self.path / f"film{ending}.gif"
        return Path(f"{self.path.name.removesuffix('.safetensors')}{ending}.gif")

    @checked_names
    def act(self, obs: Any, **told: Any) -> Any:
        """The greedy action for one observation.

        It remembers what a policy remembers, so call ``reset`` where an episode begins.

        Args:
            obs: what the environment's ``reset`` or ``step`` returned.
            **told: ``reward``, ``info``, ``mask``: see ``Player.act``.

        Returns:
            The action, as the environment takes it.
        """
        if self._player is None:
            self._player = self.player()
        return self._player.act(obs, **told)

    @checked_names
    def reset(self) -> None:
        """For ``act``: a new episode begins."""
        if self._player is not None:
            self._player.reset()

    @checked_names
    def player(self, *, deterministic: bool = True, seed: int = 0) -> Player:
        """The policy for one environment, with a memory of its own.

        Args:
            deterministic: act greedily, else sample; as in ``evaluate``.
            seed: of what is sampled.

        Returns:
            The player; call its ``reset`` where an episode begins.
        """
        return Player(self.policy, deterministic=deterministic, seed=seed)

    @checked_names
    def export(self, path: str | Path) -> Export:
        """Write ONNX files, ``policy.json`` and ``runner.py``, which needs only onnxruntime.

        What is Python code (initiation, termination, reflexes' conditions, functions) is not
        written: ``Export.code`` lists it, and the ``Runner`` is given it by name.

        Args:
            path: a folder; files of the same names are replaced.

        Returns:
            The folder, its files, and what is code.

        Raises:
            PolicyError: a part cannot be exported; the message says which, and what to do.
        """
        path = as_path(path, "path")
        must_be_own(path)
        return write_export(path, self.policy, self.declaration.spec.name)

    @checked_names
    def report(
        self,
        path: str | Path | None = None,
        *,
        episodes: int = 20,
        films: int = 3,
        seed: int = 0,
        deterministic: bool = True,
        quiet: bool = False,
    ) -> dict[str, Any]:
        """Write one HTML file about the run: film, calls, skills, curves, settings.

        Args:
            path: the file; None: ``report.html`` in the run.
            episodes: to play, with seeds that training never used.
            films: how many of them to film, from the worst to the best.
            seed: picks the episodes.
            deterministic: act greedily, else sample.
            quiet: no progress; else it is shown where a part takes longer than a second.

        Returns:
            ``path``, ``bytes``, ``seconds``, ``verdict``: a sentence on what the policy does, and
            ``missing``: sentences on what is not in it.

        Raises:
            RunError: this is no run but a weights file, or the file cannot be written.
        """
        run = RunDirectory.open(self.path)
        return write_report(
            run,
            run.path / "report.html" if path is None else as_path(path, "path"),
            self.policy,
            self.declaration.spec,
            episodes=episodes,
            filmed=films,
            seed=seed,
            deterministic=deterministic,
            quiet=quiet,
        )

    @checked_names
    def save_weights(self, path: str | Path) -> Path:
        """Write every policy into one file for ``Hierarchy.load_weights``.

        Args:
            path: the file to write.

        Returns:
            The path.
        """
        path = as_path(path, "path")
        must_be_own(path.parent)
        write_weights(path, self.declaration, self.policy)
        return path

    @checked_names
    def push(self, name: str, *, private: bool = False) -> dict[str, Any]:
        """Put the run on the Hugging Face Hub, where ``from_hub`` finds it; by the extra ``hub``.

        Up go weights, metrics, the saved evaluation, films that lie in the run's folder, figures,
        and a page about all that: safetensors, JSON and pictures, in one commit. Log in first:
        ``hf auth login``, or set ``HF_TOKEN``.

        Args:
            name: ``owner/name``; made if it is not there. An older run there is replaced.
            private: others may not read it.

        Returns:
            ``url``, ``commit``, ``files``, and ``missing``: sentences on what is not there.

        Raises:
            RunError: the run is not finished or damaged, ``name`` may not be written or
                holds something else, or the hub does not answer.
        """
        from skillweave.api.hub import push_run

        return push_run(self.path, name, private)

    @checked_names
    def as_skill(self, name: str, **attributes: Any) -> Skill:
        """All of it as one skill of another hierarchy.

        Args:
            name: of the skill.
            **attributes: of the skill, ``max_steps=50`` for example.

        Returns:
            The skill, which needs no training.
        """
        kind = type(name, (Skill,), {"name": name, "policy": self.policy, **attributes})
        skill: Skill = kind()
        return skill

    @checked_names
    def info(self) -> dict[str, Any]:
        """Return its manifest, with the latest saved evaluation under ``evaluation``.

        One that sampled actions on request is under ``evaluation_sampled``.
        """
        run = RunDirectory.open(self.path)
        told = {
            "evaluation": load_evaluation(run),
            "evaluation_sampled": load_evaluation(run, deterministic=False),
        }
        return run.manifest | {k: v.to_json() for k, v in told.items() if v is not None}

    def _training_envs(self) -> int | None:
        """As many environments as stood side by side in training; None: nothing was trained."""
        if self.path.is_dir():
            return RunDirectory.open(self.path).num_envs
        declared = self.declaration
        stages = declared.stages() if isinstance(declared, PlainAgent) else stages_of(declared)
        return max((stage.config.num_envs for stage in stages), default=None)

    def _policy(self, skill: str | None) -> Policy:
        if skill is None:
            return self.policy
        policy = self.policy
        if not isinstance(policy, HierarchyPolicy):
            raise DeclarationError("this is a plain agent: it has no skills")
        self.hierarchy.skill(skill)
        *nodes, name = skill.split("/")
        for node in nodes:
            below = policy.skills.policies[policy.labels.index(node)]
            assert isinstance(below, HierarchyPolicy)
            policy = below
        return SkillAlone(policy.skills, name, skill)
