"""The public API: declare a ``Hierarchy`` or an ``Agent``, train it, get a ``Run``.

The three classes refer to one another, so they are one module.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import gymnasium as gym

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import as_path, short, shown_path
from skillweave._internal.paths import AGENT, join, level_of, name_of
from skillweave._internal.policy_protocol import Memory, Policy
from skillweave._internal.shipped import weights_path
from skillweave._internal.terminal import printable
from skillweave.algorithms.agent_policy import AgentHeader, AgentPolicy
from skillweave.algorithms.config import (
    PPO,
    AlgorithmConfig,
    AlgorithmSettings,
    config_from_json,
)
from skillweave.api.applying import (
    Trained,
    load_policy,
    spec_of,
)
from skillweave.api.learnt_file import learnt_file
from skillweave.api.notebook_tables import declared_html, declared_line, run_html
from skillweave.api.player import Player
from skillweave.api.push_pull import push_run
from skillweave.api.recipe_file import hierarchy_in
from skillweave.api.run_calls import RunCalls
from skillweave.api.running import resume, train
from skillweave.api.starting import StartFrom
from skillweave.api.train_options import TrainOptions
from skillweave.calls.handover import Handover
from skillweave.calls.log import CallLog
from skillweave.calls.record import with_returns
from skillweave.calls.run_log import handover_json, handover_of
from skillweave.envs.make import EngineName, EnvSpec
from skillweave.errors import DeclarationError, RunError
from skillweave.evolution.evolving import Evolve
from skillweave.export.write import Export, write_export
from skillweave.extensions import fetch
from skillweave.hierarchy.assembly import parts_of
from skillweave.hierarchy.declaration import Declaration, with_roles
from skillweave.hierarchy.policy import HierarchyPolicy, SkillAlone
from skillweave.hierarchy.recorded import calls_of
from skillweave.hierarchy.roles import Roles, roles_of
from skillweave.hierarchy.settings import (
    Apart,
    CallSteps,
    Guide,
    Learn,
    Selection,
    SelectorValue,
)
from skillweave.hierarchy.weights import (
    HierarchyHeader,
    open_weights,
    read_agent,
    read_weights,
    write_agent,
    write_weights,
)
from skillweave.reporting.palette import RGB, color_of
from skillweave.reporting.progress import EpisodeProgress
from skillweave.reporting.video import Film, render_policy
from skillweave.runs.command_words import called_by
from skillweave.runs.directory import RunDirectory
from skillweave.runs.files import write_bytes
from skillweave.runs.hub import is_copy_of_hub, must_be_own
from skillweave.runs.manifest import LevelEntry, manifest_in
from skillweave.runs.trackers import track_film
from skillweave.schema import AtLeastOne, as_json
from skillweave.skills import Reflex, Skill
from skillweave.skills.base import RecordedSkill
from skillweave.skills.goal_spaces import shown_goal
from skillweave.skills.own_part import ZERO, part_from_json
from skillweave.training.callback import Callback
from skillweave.training.defaults import TrainDefaults
from skillweave.training.env_check import EnvValue
from skillweave.training.evaluation import Evaluation, evaluate
from skillweave.training.evaluation_file import (
    SavedEvaluation,
    load_evaluations,
    save_evaluation,
)
from skillweave.training.plain_agent import PlainAgent
from skillweave.training.stage import Together
from skillweave.workers.cluster import Ray

if TYPE_CHECKING:  # what extensions return
    from skillweave.data.segmenting import Segments
    from skillweave.planning.planned_run import PlannedRun
    from skillweave.repair.repair_stage import Repair


class Trainable:
    """The methods that hierarchies and plain agents have in common."""

    def __repr__(self: Any) -> str:
        return declared_line(self)

    def _repr_html_(self: Any) -> str:
        """Return tables of the declaration, for notebooks."""
        return declared_html(self)

    @checked_names
    def resume(
        self: Any,
        run_dir: str | Path,
        *,
        quiet: bool = False,
        callback: Callback | None = None,
        evolve: Evolve = None,
        cluster: Ray | None = None,
    ) -> Run:
        """Finish the run in ``run_dir``; the end is the same as if it had not been stopped.

        The run's settings count, its steps too, and the code of this declaration: methods,
        functions, conditions. A message lists settings that differ, except a population's. To train
        for more steps: ``train(run_dir, resume=True)``.

        Args:
            run_dir: the run's directory.
            quiet: no progress.
            callback: see ``train``.
            evolve: needed only where a population evolves by a selection of your own.
            cluster: run collectors, or parts of a population, on ``Ray``; their number is the
                run's.

        Returns:
            The finished run.
        """
        options = TrainOptions(
            as_path(run_dir, "run_dir"),
            quiet=quiet,
            callback=callback,
            evolve=evolve,
            cluster=cluster,
        )
        return run_of(resume(self, options))

    @checked_names
    def load(self: Any, run_dir: str | Path) -> Run:
        """Load the finished run in ``run_dir``, of this declaration, or of its flat baseline."""
        return run_of(load_policy(self, as_path(run_dir, "run_dir")))


class Agent(Trainable, PlainAgent):
    """One plain agent that learns an environment's own reward: declared, trained and watched."""

    @checked_names
    def train(
        self,
        run_dir: str | Path | None = None,
        *,
        resume: bool = False,
        overwrite: bool = False,
        seed: int = 0,
        eval_every: int | None = None,
        eval_episodes: int | None = None,
        checkpoint_every: int | None = None,
        keep: Literal["last", "best"] | None = None,
        log_info: Sequence[str] | None = None,
        quiet: bool = False,
        callback: Callback | None = None,
        evolve: Evolve = None,
        cluster: Ray | None = None,
        track: str | Sequence[str] = (),
        start_from: StartFrom = None,
        data: Any = None,
    ) -> Run:
        """Train the agent and write everything to ``run_dir``.

        Of evaluations, checkpoints and logs, None is what ``train_defaults`` says.

        Args:
            run_dir: a new directory; None: the next number of ``runs/<name>-<n>``, named after the
                recipe, the hierarchy or the environment. A run that has saved nothing yet is
                replaced, unless a process trains it; any other only with ``overwrite``.
            resume: continue the run in this directory if it has learnt something, else start one.
                It keeps its settings, and a message lists those that differ. If steps have grown,
                a finished run continues: in new episodes, with schedules over the new budget.
                Steps of stages whose learners learn again in a later one go to that stage.
            overwrite: replace the run in this directory, also a finished one; not with
                ``resume``. Files there that no run writes stay.
            seed: the root of every random stream.
            eval_every: environment steps between evaluations while training, by the learner's own
                reward; by default there are none. Their results are ``eval_return`` and
                ``eval_success`` in ``metrics.jsonl``.
            eval_episodes: episodes of each of these evaluations, by default 20.
            checkpoint_every: environment steps between checkpoints, by default 100,000.
            keep: "best": each stage ends with the weights whose periodic evaluation was best, by
                the mean return or by what its target is of; the last weights are evaluated, too,
                and policies that were given. It needs ``eval_every``. A population ends with its
                best member in any case. By default "last"; where a policy was given, the best of a
                few evaluations, and what was given where the result is clearly worse.
            log_info: keys of ``info``: the mean of each over the latest 100 episodes is
                ``info/<key>`` in ``metrics.jsonl`` and in trackers. Each episode counts with the
                value in its last step (in a skill's own stage, its call's). None, NaN and
                infinity are left out.
            quiet: no progress.
            callback: a function that is called with a ``TrainEvent`` for each report of training
                and each checkpoint. Where it returns False, the stage ends with what it has
                learnt, as at a target, and the next one starts. An exception in it stops the
                training and leaves ``train`` unchanged; the run can be resumed from its last
                checkpoint. It is called in this process, and is not stored in the run.
            evolve: a population for every stage, or for some by name (a skill's, "selector",
                "agent"). Its budget is the stage's for each member, measuring fitness included.
                Skills and selector of a population cannot learn together yet: they learn apart. A
                run that continues needs it only where the population evolves by a selection of
                your own.
            cluster: run collectors, or parts of a population, on ``Ray``; None: here, in processes
                where it pays. A run that continues keeps their number.
            track: any of "tensorboard", "wandb" and "mlflow": one, or a list.
            start_from: another run, or its directory: a learner that has learnt there, by the same
                name, starts with its policy. Or several runs, by learner: ``{"left": run,
                "right": other}``; a run of a plain agent fits any name. The policy is copied (of
                PPO, DQN and CQL all networks, of SAC and TD3 the actor, of IQL also the values of
                states). The task may be another one; spaces, networks and the names of a selector's
                skills must be the same. In place of a run also ``from_sb3(..., learn=True)`` or
                ``from_torch``'s.
            data: a ``Dataset`` of episodes to begin from; of a hierarchy also what ``segment`` has
                cut out of one. An agent that learns by PPO is cloned from the episodes (behavioural
                cloning); skills from their calls, the selector from the choices. Then all learn on.
                A part of the episodes is held out, and judges the clones. IQL and CQL learn from
                the steps alone, and SAC, TD3 and DQN with ``shared_replay`` from a share of them in
                each batch; the run keeps a copy. Not where a run continues.

        Returns:
            The finished run.

        Raises:
            DeclarationError: a setting is wrong, or the algorithm cannot act in the environment.
            EnvError: the environment cannot be made, or breaks Gymnasium's contract.
            TrainingError: training diverged, or cannot continue.
            RunError: ``run_dir`` holds something else, or no learner can start from
                ``start_from``.
        """
        options = TrainOptions(
            run_dir,
            resume=resume,
            overwrite=overwrite,
            seed=seed,
            eval_every=eval_every,
            eval_episodes=eval_episodes,
            checkpoint_every=checkpoint_every,
            keep=keep,
            log_info=log_info,
            quiet=quiet,
            callback=callback,
            evolve=evolve,
            cluster=cluster,
            track=track,
            start_from=start_from,
            data=data,
        )
        return run_of(train(self, options))

    @classmethod
    def from_manifest(cls, manifest: dict[str, Any]) -> Agent:
        """Return the agent of a run's ``manifest`` (``run.json``), without the user's code."""
        recorded = manifest_in(manifest, "run.json")
        (stage,) = recorded.stages
        agent = cls(spec_of(recorded), config_from_json(stage.algorithm), stage.budget)
        agent.recorded = True
        return agent

    @checked_names
    def load_weights(self, path: str | Path) -> Run:
        """Load this agent with the weights in the file ``path`` (see ``Run.save_weights``)."""
        self.validate()
        path = as_path(path, "path")
        return Run(self, path, read_agent(self.spec, *open_weights(path), path))

    @classmethod
    @checked_names
    def from_weights(cls, path: str | Path) -> Run:
        """Return a plain agent with its environment, from the file that ``Run.save_weights`` wrote.

        Raises:
            RunError: ``path`` is no such file, or the environment needs code.
        """
        path = as_path(path, "path")
        tensors, header = open_weights(path)
        if isinstance(header, HierarchyHeader) or header.env is None:
            raise RunError(
                f"{path} does not name the environment of its agent; declare the agent, and "
                "use its load_weights"
            )
        agent = cls(spec_of(header), config_from_json(header.algorithm, str(path)), 1)
        return Run(agent, path, read_agent(agent.spec, tensors, header, path))


@checked_names
@dataclass(repr=False)
class Hierarchy(Trainable, Declaration):
    """Skills, reflexes and a selector on one environment: declared, then trained and watched.

    ```python
    import skillweave as sw


    class Middle(sw.Skill):
        def reward(self, step):
            return 1.0 - abs(step.next_obs[:, 0])


    run = sw.Hierarchy("CartPole-v1", [Middle()]).train("runs/middle")
    ```

    Raises:
        DeclarationError: the declaration is wrong; the message names the skill and the field.
    """

    env: EnvValue
    """A Gymnasium id, a function that makes an environment, or an ``EnvSpec`` for more."""
    skills: Sequence[Skill]
    """The skills that the selector chooses from; a hierarchy among them is trained inside."""
    call_steps: CallSteps = 40
    """Steps of a skill before the selector decides again; None: until the skill ends by itself."""
    steps: AtLeastOne | None = None
    """Training steps in all, split by ``learn``; None: 1,000,000. A budget that a skill, ``apart``
    or ``together`` sets replaces that part and leaves the others as they are; where all parts are
    set, leave this out."""
    learn: Learn = "together"
    """Train skills and selector from the same steps ("together"); or skills one by one, then the
    selector ("apart"); or one after the other, half of the steps each ("apart, then together").
    Where no skill learns, the selector trains alone."""
    algorithm: AlgorithmSettings = field(default_factory=PPO)
    """The algorithm of every skill that sets no other."""
    selector: SelectorValue = field(default_factory=PPO)
    """The algorithm of the selector; its γ and n_steps count environment steps. Or a ready
    selector, not trained: a function of observations, an ``Automaton``, or a ``tree.Sequence``."""
    reflexes: Sequence[Reflex] = ()
    """Rules that override the running skill's action, also while skills train."""
    rest: Any = "zero"
    """The numbers of an action that the running skill does not write (``Skill.acts``): "zero";
    "hold", as they were in the last action, zero in an episode's first; a number; or a list with a
    number or "hold" for each number of the action, a dict of these for a Dict action. Zero is what
    pushes nothing where actions are forces or speeds; hold what is a place, or a grip."""
    apart: Apart = field(default_factory=Apart)
    """Settings of learning apart: budgets, and the start of skills."""
    together: Together = field(default_factory=Together)
    """Settings of learning together: budget, the task's weight, interruption, exploration."""
    selection: Selection = field(default_factory=Selection)
    """Settings of the selector's choices: cost of a call, greedy or sampling."""
    guide: Guide | None = None
    """A ready selector that guides one that learns."""
    train_defaults: TrainDefaults = field(default_factory=TrainDefaults)
    """Values for arguments of ``train`` that its caller leaves out."""
    predicates: Mapping[str, Any] = field(default_factory=dict)
    """Words for missions as texts (``Run.plan``): functions of observations or of a ``Step``, by
    name. The name of each skill is such a word already: its ``success``."""
    features: Any = None
    """Numbers by which plans compare observations, as for ``planning.Planner``: a function of
    observations (n, …) to numbers (n, F), or a dict of these by skill. Skills that see images
    need it."""
    name: str = "hierarchy"
    """Its name where it is a skill of another hierarchy."""

    @checked_names
    def train(
        self,
        run_dir: str | Path | None = None,
        *,
        resume: bool = False,
        overwrite: bool = False,
        seed: int = 0,
        eval_every: int | None = None,
        eval_episodes: int | None = None,
        checkpoint_every: int | None = None,
        keep: Literal["last", "best"] | None = None,
        log_info: Sequence[str] | None = None,
        log_calls: int | None = None,
        log_calls_info: Sequence[str] | None = None,
        quiet: bool = False,
        callback: Callback | None = None,
        evolve: Evolve = None,
        cluster: Ray | None = None,
        track: str | Sequence[str] = (),
        start_from: StartFrom = None,
        data: Any = None,
        flat: bool | AlgorithmConfig = False,
    ) -> Run:
        """Train skills and selector and write everything to ``run_dir``.

        Of evaluations, checkpoints and logs, None is what ``train_defaults`` says.

        Args:
            run_dir: a new directory; None: the next number of ``runs/<name>-<n>``, named after the
                recipe, the hierarchy or the environment. A run that has saved nothing yet is
                replaced, unless a process trains it; any other only with ``overwrite``.
            resume: continue the run in this directory if it has learnt something, else start one.
                It keeps its settings, and a message lists those that differ. If steps have grown,
                a finished run continues: in new episodes, with schedules over the new budget.
                Steps of stages whose learners learn again in a later one go to that stage.
            overwrite: replace the run in this directory, also a finished one; not with
                ``resume``. Files there that no run writes stay.
            seed: the root of every random stream.
            eval_every: environment steps between evaluations while training, by the learner's own
                reward; by default there are none. Their results are ``eval_return`` and
                ``eval_success`` in ``metrics.jsonl``.
            eval_episodes: episodes of each of these evaluations, by default 20.
            checkpoint_every: environment steps between checkpoints, by default 100,000.
            keep: "best": each stage ends with the weights whose periodic evaluation was best, by
                the mean return or by what its target is of; the last weights are evaluated, too,
                and policies that were given. It needs ``eval_every``. A population ends with its
                best member in any case. By default "last"; where a policy was given, the best of a
                few evaluations, and what was given where the result is clearly worse.
            log_info: keys of ``info``: the mean of each over the latest 100 episodes is
                ``info/<key>`` in ``metrics.jsonl`` and in trackers. Each episode counts with the
                value in its last step (in a skill's own stage, its call's). None, NaN and
                infinity are left out.
            log_calls: steps: the calls in the last steps in which the selector acted, this many,
                are the run's log of calls afterwards, as if ``Run.log_calls`` had recorded them;
                so ``Run.plan`` needs no further steps. Calls that are open at the end are left
                out. Skills that learnt in these steps have changed since: ``handover`` may count
                their calls, but ``plan`` refuses them. A run that was interrupted logs the calls
                after it was continued. Nothing else changes. By default there is no log.
            log_calls_info: keys of ``info`` to record with the calls.
            quiet: no progress.
            callback: a function that is called with a ``TrainEvent`` for each report of training
                and each checkpoint. Where it returns False, the stage ends with what it has
                learnt, as at a target, and the next one starts. An exception in it stops the
                training and leaves ``train`` unchanged; the run can be resumed from its last
                checkpoint. It is called in this process, and is not stored in the run.
            evolve: a population for every stage, or for some by name (a skill's, "selector",
                "agent"). Its budget is the stage's for each member, measuring fitness included.
                Skills and selector of a population cannot learn together yet: they learn apart. A
                run that continues needs it only where the population evolves by a selection of
                your own.
            cluster: run collectors, or parts of a population, on ``Ray``; None: here, in processes
                where it pays. A run that continues keeps their number.
            track: any of "tensorboard", "wandb" and "mlflow": one, or a list.
            start_from: another run, or its directory: a learner that has learnt there, by the same
                name, starts with its policy. Or several runs, by learner: ``{"left": run,
                "right": other}``; a run of a plain agent fits any name. The policy is copied (of
                PPO, DQN and CQL all networks, of SAC and TD3 the actor, of IQL also the values of
                states). The task may be another one; spaces, networks and the names of a selector's
                skills must be the same. In place of a run also ``from_sb3(..., learn=True)`` or
                ``from_torch``'s.
            data: a ``Dataset`` of episodes to begin from; of a hierarchy also what ``segment`` has
                cut out of one. An agent that learns by PPO is cloned from the episodes (behavioural
                cloning); skills from their calls, the selector from the choices. Then all learn on.
                A part of the episodes is held out, and judges the clones. IQL and CQL learn from
                the steps alone, and SAC, TD3 and DQN with ``shared_replay`` from a share of them in
                each batch; the run keeps a copy. Not where a run continues.
            flat: train one plain agent for the same number of steps instead: the baseline. True:
                with the settings of ``train_defaults``; or its settings.

        Returns:
            The finished run.

        Raises:
            DeclarationError: a setting is wrong, or the declaration does not fit the environment.
            EnvError: the environment cannot be made, or breaks Gymnasium's contract.
            SkillError: a skill's code failed, or returned something unusable.
            TrainingError: training diverged, or cannot continue.
            RunError: ``run_dir`` holds something else, or no learner can start from
                ``start_from``.
        """
        options = TrainOptions(
            run_dir,
            resume=resume,
            overwrite=overwrite,
            seed=seed,
            eval_every=eval_every,
            eval_episodes=eval_episodes,
            checkpoint_every=checkpoint_every,
            keep=keep,
            log_info=log_info,
            log_calls=log_calls,
            log_calls_info=log_calls_info,
            quiet=quiet,
            callback=callback,
            evolve=evolve,
            cluster=cluster,
            track=track,
            start_from=start_from,
            data=data,
            flat=flat,
        )
        return run_of(train(self, options))

    @checked_names
    def segment(
        self, data: Any, *, shortest: int = 1, goals: Mapping[str, Any] | None = None
    ) -> Segments:
        """Cut episodes that were recorded elsewhere into calls of skills, by what these declare.

        In each episode, from its first step on: among the skills that may start there
        (``initiation``), the one whose call ends with success first makes the next call; of several
        the first in the list. Calls end as they do when skills act: by ``termination``, at a limit,
        or with the episode. A call has succeeded where ``success`` is true at its end; of a skill
        without it, where its ``termination`` ended it. Where no call would succeed, no skill claims
        the step, and the next one is tried.

        Args:
            data: a ``Dataset`` of the same environment.
            shortest: the fewest steps of a call.
            goals: of skills that have goals, by name: a function of observations (n, *obs_shape)
                that returns the goals (n, *goal_shape) of calls that start there. A skill without
                one is left out.

        Returns:
            The calls, as a log too, and what the data do not show.

        Raises:
            DeclarationError: the data have other spaces, or lack a key of ``info`` that a skill
                reads; or an argument is wrong.
            SkillError: a method of a skill failed.
        """
        found: Segments = fetch("segment")(self, data, shortest=shortest, goals=goals)
        return found

    def plain_agent(self, algorithm: AlgorithmConfig | None = None) -> Agent:
        """Return the flat baseline: one agent on the task itself, without skills and reflexes.

        ``algorithm``: its settings; None: those of ``train_defaults``, or of the skills.
        """
        return Agent(**vars(super().plain_agent(algorithm)))

    @checked_names
    def load_weights(self, path: str | Path) -> Run:
        """Load this hierarchy with the weights in the file ``path`` (see ``Run.save_weights``)."""
        self.validate()
        path = as_path(path, "path")
        tensors, header = open_weights(path)
        if isinstance(header, AgentHeader):
            agent = read_agent(self.spec, tensors, header, path)
            return Run(self.plain_agent(), path, agent)
        # The file sets how skills are called.
        roles, policy = read_weights(roles_of(self), tensors, header, path)
        return Run(with_roles(self, roles), path, policy)

    @staticmethod
    @checked_names
    def pretrained(name: str) -> Run:
        """Load the shipped recipe ``name`` with its shipped weights."""
        return hierarchy_in(name, Hierarchy).load_weights(weights_path(name))

    @classmethod
    def from_manifest(cls, manifest: dict[str, Any]) -> Hierarchy:
        """Return the hierarchy of a run's ``manifest``, without the user's code."""
        recorded = manifest_in(manifest, "run.json")
        spec = spec_of(recorded)
        skills: dict[str, list[Skill]] = {}  # by the path of their level
        rests: dict[str, Any] = {}  # as well
        for entry in reversed(recorded.skills):  # the skills of a hierarchy follow it
            name, level = name_of(entry.name), level_of(entry.name)
            attributes: dict[str, Any] = {"name": name, "max_steps": entry.max_steps}
            if entry.call_steps is not None:
                attributes["call_steps"] = entry.call_steps
            if entry.fade is not None:
                attributes["fade"] = entry.fade
            attributes |= part_from_json(entry.sees, entry.acts, entry.learns_on)
            rests[level] = rests.get(level, ZERO) if entry.rest is None else entry.rest
            if entry.hierarchy is not None:
                attributes["policy"] = cls._recorded(
                    spec, entry.hierarchy, skills.pop(entry.name), rests[entry.name]
                )
            skills.setdefault(level, []).insert(0, type(name, (RecordedSkill,), attributes)())
        assert recorded.hierarchy is not None
        return cls._recorded(spec, recorded.hierarchy, skills[""], rests[""])

    @classmethod
    def _recorded(
        cls, spec: EnvSpec, entry: LevelEntry, skills: list[Skill], rest: Any
    ) -> Hierarchy:
        """Return a run's hierarchy, or one below it, from its entry and its skills."""
        hierarchy = cls(spec, skills, call_steps=calls_of(entry), rest=rest)
        hierarchy.recorded = True
        return hierarchy


class TrainedPolicy:
    """A policy with its declaration, of a run or of a planned one: it acts, records and plans."""

    _kind = "Run"
    _mark = ""
    """In names of files, where this is not what is written under ``path``."""

    def __init__(self, declaration: Hierarchy | Agent, path: Path, policy: Policy) -> None:
        self.declaration = declaration
        self.path = path
        self.policy = policy
        self._calls = RunCalls(path)
        self._player: Player | None = None

    def __repr__(self) -> str:
        return printable(
            f"<{self._kind} {shown_path(self.path)}: {str(self.declaration).strip('<>')}>"
        )

    def _repr_html_(self) -> str:
        """Return tables of the declaration and the stages, for notebooks."""
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
        goal: Any = None,
        num_envs: int | None = None,
        max_steps: int | None = None,
        save: bool = False,
        engine: EngineName = "sync",
        log_calls: bool = False,
        info: Sequence[str] = (),
        quiet: bool = False,
    ) -> Evaluation:
        """Score the policy in whole episodes.

        Args:
            episodes: whole episodes.
            seed: the seed that picks the episodes.
            deterministic: act greedily, else sample. In a hierarchy this is about the selector;
                ``greedy_skills`` is about its skills.
            skill: score this skill alone, as if the selector always chose it. The hierarchy's
                reflexes are in force, also where it was trained without them. Returns are the
                environment's; ``skills`` has its call in each episode, from the step in which it
                may start to its own end, by its own reward and success.
            goal: of this skill in all episodes, where it has goals; None: its ``goals()`` draw one
                for each. ``goals`` and ``reached`` of the result are of each episode.
            num_envs: environments that exist at once; None: at most as many as in training. It
                does not change the result of a greedy policy; what is sampled differs with it.
            max_steps: an episode that nothing has ended by then is cut; None: see ``evaluate``.
            save: keep the result in the run's directory, where ``info`` finds it, instead of the
                one before. A sampled one is kept beside the score, and does not replace it. Not
                with ``skill`` or another engine.
            engine: sync: Gymnasium's environment; envpool, auto: see ``evaluate``.
            log_calls: record the calls of the skills: ``Evaluation.calls`` is a log as of
                ``Run.log_calls``. The selector made them, so it may hold few calls of some skills.
            info: keys of the environment's ``info`` to record with the calls.
            quiet: no progress; else it is shown where an evaluation takes longer than a second.

        Returns:
            Returns, lengths, and what each skill did.

        Raises:
            DeclarationError: no such skill or engine; a goal without a skill that has goals; or
                ``save`` or ``log_calls`` where it cannot be.
        """
        if save and (skill is not None or engine != "sync"):
            raise DeclarationError("save keeps a whole policy's score: leave out skill and engine")
        if save:
            self._check_written()
            must_be_own(self.path)  # an error comes before anything is played
        policy = self._policy(skill, goal, "evaluate()")
        if log_calls:
            self._check_logged()
        with EpisodeProgress(episodes, quiet=quiet) as progress:
            score = evaluate(
                policy,
                self.declaration.spec,
                episodes=episodes,
                seed=seed,
                deterministic=deterministic,
                num_envs=self._training_envs() if num_envs is None else num_envs,
                max_steps=max_steps,
                watch=progress.watch,
                engine=engine,
                log_calls=log_calls,
                info=info,
            )
        if save:
            save_evaluation(RunDirectory.open(self.path), score, seed, deterministic)
        return score.comparing(self.hierarchy.features) if log_calls else score

    @checked_names
    def render(
        self,
        path: str | Path | None = None,
        *,
        episodes: int = 1,
        seed: int = 0,
        deterministic: bool = True,
        skill: str | None = None,
        goal: Any = None,
        max_steps: int | None = None,
        quiet: bool = False,
    ) -> Film:
        """Write a captioned film; one in the run's own folder goes to its trackers, too.

        A notebook shows the film that is returned.

        Args:
            path: the file, ``.gif`` or ``.mp4``. None: ``film.gif`` in the
                run's folder, with a skill's name where it acts alone. A policy without a folder of
                its own (a weights file, a copy of the hub's) writes its film where Python runs.
            episodes: how many, one after another.
            seed: picks them.
            deterministic: act greedily, else sample.
            skill: show this skill alone, as in ``evaluate``.
            goal: of this skill, as in ``evaluate``.
            max_steps: an episode that nothing has ended by then is cut.
            quiet: no progress; else it is shown where a film takes longer than a second.

        Returns:
            ``path``, and what was filmed, as plain JSON.
        """
        policy = self._policy(skill, goal, "render()")
        path = self._film_path(skill) if path is None else as_path(path, "path")
        must_be_own(path.parent)
        plain = isinstance(self.declaration, PlainAgent)
        roles = None if plain else roles_of(self.hierarchy)
        film = render_policy(
            self.declaration.spec,
            policy,
            path,
            _labels_of(policy, roles, skill),
            episodes=episodes,
            seed=seed,
            deterministic=deterministic,
            max_steps=max_steps,
            quiet=quiet,
        )
        if path.parent.resolve() == self.path.resolve():
            track_film(RunDirectory.open(self.path), path)
        return film

    def _film_path(self, skill: str | None) -> Path:
        """Return the default path of a film."""
        ending = "" if skill is None else "-" + skill.replace("/", ".")
        if not self._mark and self.path.is_dir() and not is_copy_of_hub(self.path):
            return self.path / f"film{ending}.gif"
        return Path(f"{self.path.name.removesuffix('.safetensors')}{self._mark}{ending}.gif")

    @checked_names
    def act(self, obs: Any, **given: Any) -> Any:
        """Return the greedy action for one observation.

        A policy with a memory needs ``reset`` at the start of each episode.

        Args:
            obs: what the environment's ``reset`` or ``step`` returned.
            **given: ``reward``, ``info``, ``mask``, ``skill``, ``goal``: see ``Player.act``.

        Returns:
            The action, as the environment takes it.
        """
        if self._player is None:
            self._player = self.player()
        return self._player.act(obs, **given)

    @checked_names
    def reset(self) -> None:
        """Start a new episode for ``act``."""
        if self._player is not None:
            self._player.reset()

    @checked_names
    def player(
        self,
        *,
        skill: str | None = None,
        goal: Any = None,
        deterministic: bool = True,
        seed: int = 0,
        nan: Literal["error", "zero"] = "error",
    ) -> Player:
        """Return a player: the policy for one environment, with a memory of its own.

        Args:
            skill: the skill that acts alone; None: the whole policy.
            goal: of this skill, where it has goals; None: its ``goals()`` draw one.
            deterministic: act greedily, else sample; as in ``evaluate``.
            seed: of what is sampled.
            nan: what a NaN in an observation is: an error, or a zero.

        Returns:
            The player; call its ``reset`` where an episode begins.
        """
        policy = self._policy(skill)
        return Player(policy, deterministic=deterministic, seed=seed, goal=goal, nan=nan)

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
            PolicyError: a part cannot be exported; the message names it, and what to do.
        """
        path = as_path(path, "path")
        must_be_own(path)
        return write_export(path, self.policy, self.declaration.spec.name)

    @checked_names
    def as_skill(self, name: str, **attributes: Any) -> Skill:
        """Return the whole policy as one skill of another hierarchy.

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
    def log_calls(
        self,
        steps: int = 20_000,
        *,
        choose: Any = "random",
        num_envs: int = 16,
        seed: int | None = None,
        info: Sequence[str] = (),
    ) -> CallLog:
        """Let the skills act without the selector, record their calls, and keep them in the run.

        The run's directory keeps all recorded calls, the latest million steps, in
        ``calls.safetensors``; ``calls`` reads them. Calls of the skills before they learnt on, or
        without a key of ``info`` that is asked for now, are replaced. If the code of the
        environment or of the skills has changed, earlier calls are put aside, in
        ``calls-1.safetensors``. Both are said. A run without
        a directory of its own (a weights file, a copy of the hub's) keeps calls in memory.

        Args:
            steps: environment steps to record; open calls are completed, so there are a few more.
            choose: "random": uniformly among the skills that may start; "explore": what is unlike
                the calls so far; or a selector: any policy over the skills, a ready selector, or a
                ``planning.Explorer``.
            num_envs: environments side by side.
            seed: of the environments and of all that is sampled; None: 0, or a new one if the run
                has calls, so that more are recorded. With the same seed the same calls are
                recorded, which the run keeps once.
            info: keys of the environment's ``info`` to record, so that tasks may read them; those
                of earlier calls are added.

        Returns:
            The calls that were recorded now; ``calls`` has all.

        Raises:
            DeclarationError: this is a plain agent, or an argument is wrong.
            RunError: the run's file of calls is damaged, or cannot be written.
            Interrupted: Ctrl-C has stopped it; what was recorded is kept.
        """
        spec = self._own_spec()
        seed, info = self._calls.begin(self.policy, seed, info)
        how: dict[str, Any] = {"own_rewards": False, "keep": self._calls.add}
        log, _ = with_returns(spec, self.policy, steps, choose, num_envs, seed, info, **how)
        return replace(log, features=self.hierarchy.features)

    @property
    def calls(self) -> CallLog:
        """All calls that ``log_calls`` recorded in this run.

        Raises:
            DeclarationError: this is the run of a plain agent.
            RunError: none were recorded, or their file is damaged or of other skills.
        """
        features = self.hierarchy.features
        return replace(self._calls.read(self.policy, self._own_spec()), features=features)

    @property
    def has_calls(self) -> bool:
        """True if ``log_calls`` recorded calls in this run.

        Raises:
            RunError: their file is damaged or of other skills.
        """
        return self._calls.has_any()

    @checked_names
    def plan(
        self,
        task: Any,
        log: CallLog | None = None,
        *,
        predicates: Mapping[str, Any] | None = None,
        features: Any = None,
        neighbors: int = 5,
        gamma: float = 0.999,
        caution: float = 0.03,
        temperature: float = 0.0,
    ) -> PlannedRun:
        """Return the skills with a selector that plans a new task on logged calls; no training.

        Evaluations, films and players are about the task: its reward, its end, its success. Nothing
        is written, so ``evaluate(save=True)`` and ``report`` are not for it; ``export`` is.

        Args:
            task: a ``planning.Mission`` or its text, a ``RewardMachine``, a ``GoalTask``, a
                predicate, or a function of a ``Step`` that returns the reward.
            log: calls of these skills; None: all that ``log_calls`` recorded in this run.
            predicates: by name, for a text, beside the hierarchy's own and the names of its
                skills, which mean their success.
            features: by what calls are near one another; None: the hierarchy's ``features``.
            neighbors: nearest logged calls of each choice that are compared.
            gamma: γ of one step.
            caution: the share by which a value falls, about, where the nearest call is as far as
                the last of the ``neighbors`` usually is.
            temperature: choices are sampled by exp(Q / (temperature · the largest |Q|)); 0: the
                best is chosen.

        Raises:
            DeclarationError: this is a plain agent, or a setting is wrong.
            RunError: there is no log, it is of other skills, or no step of it does what the task
                needs.
        """
        made: PlannedRun = fetch("plan")(
            self,
            task,
            log,
            predicates=predicates,
            features=features,
            neighbors=neighbors,
            gamma=gamma,
            caution=caution,
            temperature=temperature,
        )
        return made

    def _own_spec(self) -> EnvSpec:
        """Return the environment of the hierarchy's own task."""
        return self.hierarchy.spec

    def _check_written(self) -> None:
        """Raise a RunError where the policy is a planned one, which the run's files do not hold."""

    def _check_logged(self) -> None:
        """Raise a DeclarationError where evaluations do not show whole calls."""

    def _training_envs(self) -> int | None:
        """Return the number of environments in training; None: nothing was trained."""
        if self.path.is_dir():
            return RunDirectory.open(self.path).num_envs
        stages = self.declaration.stages()
        return max((stage.config.num_envs for stage in stages), default=None)

    def _policy(self, skill: str | None, goal: Any = None, who: str = "") -> Policy:
        """Return the policy, or that of one skill alone, with this goal, for a method ``who``."""
        if goal is not None:
            if skill is None:
                raise DeclarationError(
                    f"{who}: goal is {short(goal)}, and one skill that acts alone is given a goal: "
                    'name it, skill="go_to"'
                )
            return self._alone(skill).with_goal(goal, who)
        return self.policy if skill is None else self._alone(skill)

    def _alone(self, skill: str) -> SkillAlone:
        """Return the policy of one skill of the hierarchy, which acts alone."""
        if not isinstance(self.policy, HierarchyPolicy):
            raise DeclarationError("this is a plain agent: it has no skills")
        self.hierarchy.skill(skill)
        level = parts_of(roles_of(self.hierarchy), self.policy)[level_of(skill)]
        assert isinstance(level, HierarchyPolicy)
        return SkillAlone(level.skills, name_of(skill), skill)


class Run(TrainedPolicy):
    """A trained policy with its declaration: evaluate, watch or save it, use it as a skill.

    Args:
        declaration: what was trained.
        path: its directory, or its weights file.
        policy: the trained policy.
    """

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
        written: dict[str, Any] = fetch("report")(
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
        return written

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
        if isinstance(self.policy, AgentPolicy):
            write_agent(path, self.declaration.spec, self.policy)
            return path
        assert isinstance(self.policy, HierarchyPolicy)
        write_weights(path, roles_of(self.hierarchy), self.policy, self.hierarchy.recipe)
        return path

    @checked_names
    def save_onnx(self, skill: str, path: str | Path) -> Path:
        """Write the ONNX file from which a skill learnt on, with the weights that it has now.

        The skill's policy is ``from_onnx(..., learn=True)``. Inputs, outputs, names, shapes, opset
        and metadata stay as they are, also outputs that are not of the policy: what runs the old
        file runs the new one, with the same mapping. Its action is the skill's greedy one. Where
        ``goal=`` is fixed, the policy has learnt for this goal, and others may act otherwise.

        Args:
            skill: the skill's path: ``walk``, or ``inner/walk`` in a hierarchy that is a skill.
            path: the file to write.

        Returns:
            The path.

        Raises:
            DeclarationError: no such skill, or one that did not learn on from an ONNX file.
            RunError: the run is a file of weights, or its copy of the ONNX file is damaged.
        """
        path = as_path(path, "path")
        content = learnt_file(self.path, roles_of(self.hierarchy), self.policy, skill)
        must_be_own(path.parent)
        write_bytes(path, content)
        return path

    @checked_names
    def push(self, name: str, *, private: bool = False, calls: bool = False) -> dict[str, Any]:
        """Put the run on the Hugging Face Hub, where ``from_hub`` finds it; by the extra ``hub``.

        Up go weights, metrics, the saved evaluation, films that lie in the run's folder, figures,
        and a page about all that: safetensors, JSON and pictures, in one commit. Log in first:
        ``hf auth login``, or set ``HF_TOKEN``.

        Args:
            name: ``owner/name``; made if it is not there. An older run there is replaced.
            private: others may not read it.
            calls: with the log of calls, so that others can plan without recording one.

        Returns:
            ``url``, ``commit``, ``files``, and ``missing``: sentences on what is not there.

        Raises:
            RunError: the run is not finished or damaged, ``name`` may not be written or
                holds something else, or the hub does not answer.
        """
        return push_run(self.path, name, private, calls)

    @checked_names
    def info(self) -> dict[str, Any]:
        """Return its manifest, with the latest saved evaluation under ``evaluation``.

        One that sampled actions on request is under ``evaluation_sampled``. ``handover`` has the
        counts of the log of calls, if there is one: see ``CallLog.handover``.
        """
        run = RunDirectory.open(self.path)
        return info_json(run, load_evaluations(run), handover_of(run))

    @checked_names
    def repair(
        self,
        skill: str,
        *,
        after: str,
        steps: int | None = None,
        run_dir: str | Path | None = None,
        done: Mapping[str, Any] | None = None,
        calls: int = 200,
        seed: int = 0,
        resume: bool = False,
        quiet: bool = False,
        callback: Callback | None = None,
    ) -> Run:
        """Train a skill on from where another one ends, and keep the result if it is better.

        Most episodes begin after a call of the other skill, the others as usual; half of them where
        it does not rehearse. The skill is paid its own reward, and a bonus in each step in which
        the event that its calls are for is true: as much per step as calls that were done earned
        more than those that failed. A skill of PPO without a memory also rehearses: the KL from its
        earlier policy has a cost in the observations of its calls that were done after other skills
        (kickstarting, Schmitt et al. 2018), so that it does not forget. Before and after, calls are
        recorded, and the handovers counted: the new weights are kept if this one is clearly better
        and no other one clearly worse. All other weights stay as they are. What was done is in
        ``Run.repairs``.

        Args:
            skill: the skill that fails, by its path.
            after: the skill after which it fails, of the same selector.
            steps: environment steps of training; measuring takes more. None: 200,000.
            run_dir: a new directory; None: the next number of ``runs/<name>-repair-<n>``.
            done: by skill, the event that a call is for, in place of the skill's ``success``; as
                for ``planning.handover``.
            calls: calls of the pair to measure at least, before and after; fewer where 500,000
                steps do not hold them.
            seed: the root of every random stream.
            resume: finish the repair in ``run_dir``, with its own steps and settings.
            quiet: no progress.
            callback: see ``Hierarchy.train``.

        Returns:
            The new run, with the repaired weights or the earlier ones.

        Raises:
            DeclarationError: no such skill, one that does not learn, one that may not start after
                the other, seldom does, or needs no repair; or too few steps.
            RunError: the run was planned, or loaded without its code; or ``run_dir`` holds
                something else.
        """
        repaired: Run = fetch("repair")(
            self,
            skill=skill,
            after=after,
            steps=steps,
            run_dir=run_dir,
            done=done,
            calls=calls,
            seed=seed,
            resume=resume,
            quiet=quiet,
            callback=callback,
        )
        return repaired

    @property
    def repairs(self) -> list[Repair]:
        """The repairs of its skills, the latest last: both matrices, the reason, the result."""
        if not self.path.is_dir():
            return []
        repairs: list[Repair] = fetch("repairs")(RunDirectory.open(self.path))
        return repairs


def info_json(
    run: RunDirectory, saved: Mapping[str, SavedEvaluation], matrix: Handover | str | None
) -> dict[str, Any]:
    """Return a run's manifest, its saved evaluations and the counts of its log of calls."""
    content: dict[str, Any] = as_json(run.manifest)
    return content | {k: v.to_json() for k, v in saved.items()} | handover_json(matrix)


def run_of(trained: Trained[Hierarchy | Agent]) -> Run:
    """Return a trained or loaded declaration and its policy as a ``Run``."""
    declared, run, policy = trained
    if run.manifest.hierarchy is None and isinstance(declared, Hierarchy):
        declared = declared.plain_agent()  # the flat baseline
    return Run(declared, run.path, policy)


def _labels_of(
    policy: Policy, roles: Roles | None, alone: str | None
) -> Callable[[Memory], tuple[str, RGB, str]]:
    """Return a function from a policy's memory to the acting skill's name, colour and goal.

    Args:
        roles: of the hierarchy that acts; None: a plain agent acts.
        alone: the skill that acts alone.
    """
    skills = {} if roles is None else roles.skills
    colors = {path: color_of(i, s.color) for i, (path, s) in enumerate(skills.items())}

    def label(memory: Memory) -> tuple[str, RGB, str]:
        """Return the acting skill's path, colour and goal, by the policy's memory."""
        if roles is None:
            return AGENT, color_of(0, None), ""
        acting = policy.policy if isinstance(policy, SkillAlone) else policy
        below = acting.acts(memory) if isinstance(acting, HierarchyPolicy) else None
        name = join(alone or "", below or "")
        known = name
        while known not in colors:  # a run that is a ready skill has skills of its own
            known = level_of(known)
        goal = policy.goal_now(memory) if isinstance(policy, HierarchyPolicy | SkillAlone) else None
        return name, colors[known], "" if goal is None else shown_goal(goal)

    return label


@checked_names
def train_agent(
    env: str | Callable[[], gym.Env[Any, Any]] | EnvSpec,
    algorithm: AlgorithmConfig,
    steps: int,
    run_dir: str | Path | None = None,
    *,
    resume: bool = False,
    overwrite: bool = False,
    seed: int = 0,
    eval_every: int | None = None,
    eval_episodes: int | None = None,
    checkpoint_every: int | None = None,
    keep: Literal["last", "best"] | None = None,
    log_info: Sequence[str] | None = None,
    quiet: bool = False,
    callback: Callback | None = None,
    evolve: Evolve = None,
    cluster: Ray | None = None,
    track: str | Sequence[str] = (),
    start_from: StartFrom = None,
    data: Any = None,
    target_return: float | None = None,
    target_success: float | None = None,
) -> Run:
    """Train one plain agent on an environment's own reward; the run is like any other.

    Args:
        env: a Gymnasium id, a function that makes an environment, or an ``EnvSpec``.
        algorithm: its settings, ``SAC()`` for example.
        steps: training budget in environment steps.
        run_dir: a new directory; None: the next number of ``runs/<name>-<n>``, named after the
            recipe, the hierarchy or the environment. A run that has saved nothing yet is
            replaced, unless a process trains it; any other only with ``overwrite``.
        resume: continue the run in this directory if it has learnt something, else start one.
            It keeps its settings, and a message lists those that differ. If steps have grown,
            a finished run continues: in new episodes, with schedules over the new budget.
            Steps of stages whose learners learn again in a later one go to that stage.
        overwrite: replace the run in this directory, also a finished one; not with
            ``resume``. Files there that no run writes stay.
        seed: the root of every random stream.
        eval_every: environment steps between evaluations while training, by the learner's own
            reward; by default there are none. Their results are ``eval_return`` and
            ``eval_success`` in ``metrics.jsonl``.
        eval_episodes: episodes of each of these evaluations, by default 20.
        checkpoint_every: environment steps between checkpoints, by default 100,000.
        keep: "best": each stage ends with the weights whose periodic evaluation was best, by
            the mean return or by what its target is of; the last weights are evaluated, too,
            and policies that were given. It needs ``eval_every``. A population ends with its
            best member in any case. By default "last"; where a policy was given, the best of a
            few evaluations, and what was given where the result is clearly worse.
        log_info: keys of ``info``: the mean of each over the latest 100 episodes is
            ``info/<key>`` in ``metrics.jsonl`` and in trackers. Each episode counts with the
            value in its last step (in a skill's own stage, its call's). None, NaN and
            infinity are left out.
        quiet: no progress.
        callback: a function that is called with a ``TrainEvent`` for each report of training
            and each checkpoint. Where it returns False, the stage ends with what it has
            learnt, as at a target, and the next one starts. An exception in it stops the
            training and leaves ``train`` unchanged; the run can be resumed from its last
            checkpoint. It is called in this process, and is not stored in the run.
        evolve: a population for every stage, or for some by name (a skill's, "selector",
            "agent"). Its budget is the stage's for each member, measuring fitness included.
            Skills and selector of a population cannot learn together yet: they learn apart. A
            run that continues needs it only where the population evolves by a selection of
            your own.
        cluster: run collectors, or parts of a population, on ``Ray``; None: here, in processes
            where it pays. A run that continues keeps their number.
        track: any of "tensorboard", "wandb" and "mlflow": one, or a list.
        start_from: another run, or its directory: a learner that has learnt there, by the same
            name, starts with its policy. Or several runs, by learner: ``{"left": run,
            "right": other}``; a run of a plain agent fits any name. The policy is copied (of
            PPO, DQN and CQL all networks, of SAC and TD3 the actor, of IQL also the values of
            states). The task may be another one; spaces, networks and the names of a selector's
            skills must be the same. In place of a run also ``from_sb3(..., learn=True)`` or
            ``from_torch``'s.
        data: a ``Dataset`` of episodes to begin from; of a hierarchy also what ``segment`` has
            cut out of one. An agent that learns by PPO is cloned from the episodes (behavioural
            cloning); skills from their calls, the selector from the choices. Then all learn on.
            A part of the episodes is held out, and judges the clones. IQL and CQL learn from
            the steps alone, and SAC, TD3 and DQN with ``shared_replay`` from a share of them in
            each batch; the run keeps a copy. Not where a run continues.
        target_return: stop early at this mean return of the periodic evaluation.
        target_success: stop early at this share of episodes with a true ``info["success"]``, or
            ``info["is_success"]`` where that is missing.

    Returns:
        The finished run.

    Raises:
        DeclarationError: the algorithm cannot act in the environment; the message names others.
    """
    options = TrainOptions(
        run_dir,
        resume=resume,
        overwrite=overwrite,
        seed=seed,
        eval_every=eval_every,
        eval_episodes=eval_episodes,
        checkpoint_every=checkpoint_every,
        keep=keep,
        log_info=log_info,
        quiet=quiet,
        callback=callback,
        evolve=evolve,
        cluster=cluster,
        track=track,
        start_from=start_from,
        data=data,
    )
    agent = Agent(env, algorithm, steps, target_return, target_success)
    with called_by("train_agent"):
        return run_of(train(agent, options))


__all__ = ["Agent", "Hierarchy", "Run", "train_agent"]
