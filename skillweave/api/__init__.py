"""What users call: declare a ``Hierarchy`` or an ``Agent``, train it, get a ``Run``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym

from skillweave.algorithms.config import AlgorithmConfig, config_from_json
from skillweave.algorithms.policy import AgentPolicy
from skillweave.api.adoption import adopted, check_run, spec_of, told_differences
from skillweave.api.loading import load
from skillweave.api.notebook_tables import agent_html, agent_line, hierarchy_html, hierarchy_line
from skillweave.api.recipe_file import hierarchy_in
from skillweave.api.run import Run
from skillweave.api.running import begin, evolving, go_on
from skillweave.api.starting import StartFrom
from skillweave.arguments import checked_names
from skillweave.collecting.cluster import Ray
from skillweave.collecting.lengths import calls_from_json
from skillweave.envs.make import EnvSpec
from skillweave.errors import RunError
from skillweave.evolution.plan import Evolve
from skillweave.hierarchy import training
from skillweave.hierarchy.declaration import Declaration
from skillweave.hierarchy.nesting import below, copied
from skillweave.hierarchy.weights import open_weights, read_agent, read_weights
from skillweave.messages import as_path, whole_number
from skillweave.runs.command_words import called_by
from skillweave.runs.directory import RunDirectory
from skillweave.shipped import weights_path
from skillweave.skills.base import RecordedSkill
from skillweave.training.callback import Callback
from skillweave.training.plain_agent import PlainAgent


class Agent(PlainAgent):
    """One plain agent that learns an environment's own reward: declared, trained and watched."""

    recipe: str | None = None

    def __repr__(self) -> str:
        return agent_line(self)

    def _repr_html_(self) -> str:
        """Return a table of what it declares, for notebooks."""
        return agent_html(self)

    @checked_names
    def train(
        self,
        run_dir: str | Path | None = None,
        *,
        resume: bool = False,
        seed: int = 0,
        eval_every: int | None = None,
        eval_episodes: int | None = None,
        checkpoint_every: int | None = None,
        quiet: bool = False,
        track: Sequence[str] = (),
        evolve: Evolve = None,
        cluster: Ray | None = None,
        start_from: StartFrom = None,
        callback: Callback | None = None,
        keep: Literal["last", "best"] | None = None,
        log_info: Sequence[str] | None = None,
    ) -> Run:
        """Train the agent and write everything to ``run_dir``.

        ``run_dir``, ``resume``, ``seed``, ``eval_every``, ``eval_episodes``, ``checkpoint_every``,
        ``quiet``, ``track``, ``evolve``, ``cluster``, ``start_from``, ``callback``, ``keep`` and
        ``log_info`` are as in
        ``Hierarchy.train``.
        """
        self.validate()
        how = self.train_defaults.given(
            eval_every=eval_every,
            eval_episodes=eval_episodes,
            checkpoint_every=checkpoint_every,
            keep=keep,
            log_info=log_info,
        )
        content = self.manifest(whole_number(seed, "seed", 0), how)
        return begin(
            self,
            content,
            run_dir,
            quiet,
            track,
            evolve,
            cluster,
            start_from,
            callback=callback,
            resume=resume,
        )

    @checked_names
    def resume(
        self,
        run_dir: str | Path,
        *,
        quiet: bool = False,
        evolve: Evolve = None,
        cluster: Ray | None = None,
        callback: Callback | None = None,
    ) -> Run:
        """Finish the run in ``run_dir``.

        ``quiet``, ``evolve``, ``cluster`` and ``callback`` are as in ``Hierarchy.resume``.
        """
        self.validate()
        run = RunDirectory.open(as_path(run_dir, "run_dir"))
        check_run(self, run)
        note = told_differences(self, run)
        return go_on(self, run, quiet, evolve, cluster, note, callback)

    @checked_names
    def load(self, run_dir: str | Path) -> Run:
        """Load the finished run of this agent in ``run_dir``."""
        return load(run_dir, self)

    @classmethod
    def from_manifest(cls, manifest: dict[str, Any]) -> Agent:
        """The agent of a run's ``manifest`` (``run.json``) that needs none of the user's code."""
        (stage,) = manifest["stages"]
        config = config_from_json(stage["algorithm"])
        found = cls(spec_of(manifest), config, int(stage["budget"]))
        found.recorded = True
        return found

    @checked_names
    def load_weights(self, path: str | Path) -> Run:
        """This agent with the weights in the file ``path`` (see ``Run.save_weights``)."""
        self.validate()
        path = as_path(path, "path")
        return Run(self, path, read_agent(self.spec, *open_weights(path), path))

    @classmethod
    @checked_names
    def from_weights(cls, path: str | Path) -> Run:
        """A plain agent with its environment, from the file that ``Run.save_weights`` wrote.

        Raises:
            RunError: ``path`` is no such file, or the environment needs code.
        """
        path = as_path(path, "path")
        tensors, header = open_weights(path)
        if header["kind"] != "agent" or "env" not in header:
            raise RunError(f"{path} does not say which environment its agent is for")
        agent = cls(spec_of(header), config_from_json(header["algorithm"], str(path)), 1)
        return Run(agent, path, read_agent(agent.spec, tensors, header, path))


class Hierarchy(Declaration):
    """Skills, reflexes and a selector on one environment: declared, then trained and watched.

    ```python
    import skillweave as sw


    class Middle(sw.Skill):
        def reward(self, step):
            return 1.0 - abs(step.next_obs[:, 0])


    run = sw.Hierarchy("CartPole-v1", [Middle()]).train("runs/middle")
    ```
    """

    recipe: str | None = None
    """Where it was declared: a shipped recipe's name or a file; written into runs."""

    def __repr__(self) -> str:
        return hierarchy_line(self)

    def _repr_html_(self) -> str:
        """Return tables of what it declares, for notebooks."""
        return hierarchy_html(self)

    @checked_names
    def train(
        self,
        run_dir: str | Path | None = None,
        *,
        resume: bool = False,
        seed: int = 0,
        flat: bool | AlgorithmConfig = False,
        eval_every: int | None = None,
        eval_episodes: int | None = None,
        checkpoint_every: int | None = None,
        quiet: bool = False,
        track: Sequence[str] = (),
        evolve: Evolve = None,
        cluster: Ray | None = None,
        start_from: StartFrom = None,
        callback: Callback | None = None,
        keep: Literal["last", "best"] | None = None,
        log_info: Sequence[str] | None = None,
    ) -> Run:
        """Train skills and selector and write everything to ``run_dir``.

        Args:
            run_dir: a new directory; None: the next number of ``runs/<name>-<n>``, named after the
                recipe, the hierarchy or the environment. A run that has learnt something is never
                replaced; one without a checkpoint, which no process trains, is.
            resume: continue the run in ``run_dir`` if it has learnt something, else begin. Its
                settings count, and those that differ are named. If steps have grown, a finished run
                learns on: in new episodes, with schedules over the new budget. Steps of stages
                whose learners learn again in a later one go to that stage.
            seed: the root of every random stream.
            flat: train one plain agent for the same number of steps instead: the baseline. True:
                with the settings of ``train_defaults``; or its settings.
            eval_every: environment steps between evaluations while training, by the learner's own
                reward; None: as ``train_defaults`` says, by default none.
            eval_episodes: episodes of each of these evaluations; None: 20.
            checkpoint_every: environment steps between checkpoints; None: 100,000.
            quiet: no progress.
            track: any of "tensorboard", "wandb" and "mlflow".
            evolve: a population for every stage, or for some by name (a skill's, "selector",
                "agent"). Its budget is the stage's for each member, measuring fitness included.
                Skills and selector of a population cannot learn together yet: they learn apart.
            cluster: run collectors, or parts of a population, on ``Ray``; None: here, in processes
                where it pays.
            start_from: another run, or its directory: whoever learns here and has learnt there, by
                the same name, begins with its policy. Or several runs, by the name of who begins:
                ``{"left": run, "right": other}``; a run of a plain agent fits any name. What is
                taken over is the policy (of PPO and DQN all networks, of SAC and TD3
                the actor). The task may be another one; spaces, networks and the names of a
                selector's skills must be the same.
            callback: a function that is called with a ``TrainEvent`` for each report of training
                and each checkpoint. Where it returns False, the stage ends with what it has
                learnt, as at a target, and the next one starts. An exception in it stops the
                training and leaves ``train`` as it is; the run can be resumed from its last
                checkpoint. It is called in this process, and is not stored in the run.
            keep: "best": each stage ends with the weights whose periodic evaluation was best, by
                the mean return or by what its target is of; the last weights are evaluated, too.
                It needs ``eval_every``. A population ends with its best member in any case. None:
                as ``train_defaults`` says, by default "last".
            log_info: keys of ``info``: the mean of each over the latest 100 episodes is
                ``info/<key>`` in ``metrics.jsonl`` and in trackers. Of an episode the value in its
                last step counts (in a skill's own stage: of its call). None, NaN and infinity are
                left out.

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
        self.validate()
        seed = whole_number(seed, "seed", 0)
        how = self.train_defaults.given(
            eval_every=eval_every,
            eval_episodes=eval_episodes,
            checkpoint_every=checkpoint_every,
            keep=keep,
            log_info=log_info,
        )
        own, note = (self, "") if flat is not False else evolving(self, evolve)
        content = training.manifest(own, seed=seed, flat=flat, how=how)
        return begin(
            own,
            content,
            run_dir,
            quiet,
            track,
            evolve,
            cluster,
            start_from,
            note,
            callback,
            resume=resume,
        )

    @checked_names
    def resume(
        self,
        run_dir: str | Path,
        *,
        quiet: bool = False,
        evolve: Evolve = None,
        cluster: Ray | None = None,
        callback: Callback | None = None,
    ) -> Run:
        """Finish the run in ``run_dir``; the end is the same as if it had not been stopped.

        The run's settings count, its steps too, and the code of this hierarchy: methods, functions,
        conditions. Settings that differ are named, but for those of a population. To train for more
        steps: ``train(run_dir, resume=True)``.

        ``quiet``: no progress. ``evolve`` is needed only where the population evolves by a
        selection of your own. ``cluster``: where its collectors run from now on; their number
        stays. ``callback``: as in ``train``; the one of ``train`` is not stored.
        """
        self.validate()
        run = RunDirectory.open(as_path(run_dir, "run_dir"))
        own = adopted(self, run)
        note = told_differences(self, run)
        return go_on(own, run, quiet, evolve, cluster, note, callback)

    @checked_names
    def load(self, run_dir: str | Path) -> Run:
        """Load the finished run in ``run_dir``, of this hierarchy or of its flat baseline."""
        return load(run_dir, self)

    def plain_agent(self, algorithm: AlgorithmConfig | None = None) -> Agent:
        """Return the flat baseline: one agent on the task itself, without skills and reflexes.

        ``algorithm``: its settings; None: those of ``train_defaults``, or of the skills.
        """
        return Agent(**vars(super().plain_agent(algorithm)))

    @checked_names
    def load_weights(self, path: str | Path) -> Run:
        """This hierarchy with the weights in the file ``path`` (see ``Run.save_weights``)."""
        self.validate()
        path = as_path(path, "path")
        own = copied(self)  # it takes over how skills are called
        policy = read_weights(own, path)
        plain = isinstance(policy, AgentPolicy)
        return Run(self.plain_agent() if plain else own, path, policy)

    @staticmethod
    @checked_names
    def pretrained(name: str) -> Run:
        """The shipped recipe ``name`` with its shipped weights."""
        return hierarchy_in(name, Hierarchy).load_weights(weights_path(name))

    @classmethod
    def from_manifest(cls, manifest: dict[str, Any]) -> Hierarchy:
        """The hierarchy of a run's ``manifest`` that needs none of the user's code."""
        entries = {s["name"]: s for s in manifest["skills"]}
        return cls._recorded(spec_of(manifest), manifest, entries)

    @classmethod
    def _recorded(
        cls, spec: EnvSpec, told: dict[str, Any], entries: dict[str, dict[str, Any]]
    ) -> Hierarchy:
        """A hierarchy of a run, or one below it, from the entries of its skills by their paths."""
        skills = []
        for name, entry in entries.items():
            if "/" in name:
                continue
            own = {k: entry[k] for k in ("max_steps", "call_steps") if k in entry} | {"name": name}
            if "hierarchy" in entry:
                own["policy"] = cls._recorded(spec, entry["hierarchy"], below(entries, name))
            skills.append(type(name, (RecordedSkill,), own)())
        found = cls(spec, skills, call_steps=calls_from_json(told))
        found.recorded = True
        return found


@checked_names
def train_agent(
    env: str | Callable[[], gym.Env[Any, Any]] | EnvSpec,
    algorithm: AlgorithmConfig,
    steps: int,
    run_dir: str | Path | None = None,
    *,
    resume: bool = False,
    target_return: float | None = None,
    target_success: float | None = None,
    eval_every: int | None = None,
    eval_episodes: int = 20,
    checkpoint_every: int = 100_000,
    seed: int = 0,
    quiet: bool = False,
    track: Sequence[str] = (),
    evolve: Evolve = None,
    cluster: Ray | None = None,
    start_from: StartFrom = None,
    callback: Callback | None = None,
    keep: Literal["last", "best"] = "last",
    log_info: Sequence[str] = (),
) -> Run:
    """Train one plain agent on an environment's own reward; the run is like any other.

    Args:
        env: a Gymnasium id, a function that makes an environment, or an ``EnvSpec``.
        algorithm: its settings, ``SAC()`` for example.
        steps: training budget in environment steps.
        target_return: stop early at this mean return of the periodic evaluation.
        target_success: stop early at this share of episodes whose ``info["success"]`` is true.
        eval_every: environment steps between these evaluations; None: none.
        eval_episodes: episodes of each.
        checkpoint_every: environment steps between checkpoints.
        run_dir: a new directory; None: the next number of ``runs/<environment>-<n>``.
        resume: continue the run in ``run_dir`` if it has learnt something, for more ``steps`` if
            they have grown, else begin; see ``Hierarchy.train``.
        seed: the root of every random stream.
        quiet: no progress.
        track: any of "tensorboard", "wandb" and "mlflow".
        evolve: an ``Evolution``: a population in place of one agent.
        cluster: run collectors, or parts of a population, on ``Ray``; None: here, in processes
            where it pays.
        start_from: another plain agent's run, or its directory: it begins with that policy; see
            ``Hierarchy.train``.
        callback: is called with a ``TrainEvent`` for each report and each checkpoint; returning
            False ends the training; see ``Hierarchy.train``.
        keep: "best": end with the weights whose periodic evaluation was best.
        log_info: keys of ``info`` that are logged; see ``Hierarchy.train``.

    Returns:
        The finished run.

    Raises:
        DeclarationError: the algorithm cannot act in the environment; the message says which can.
    """
    agent = Agent(
        env,
        algorithm,
        steps,
        target_return=target_return,
        target_success=target_success,
    )
    with called_by("train_agent"):
        return agent.train(
            run_dir,
            resume=resume,
            seed=seed,
            eval_every=eval_every,
            eval_episodes=eval_episodes,
            checkpoint_every=checkpoint_every,
            quiet=quiet,
            track=track,
            evolve=evolve,
            cluster=cluster,
            start_from=start_from,
            callback=callback,
            keep=keep,
            log_info=log_info,
        )


__all__ = ["Agent", "Hierarchy", "Run", "load", "train_agent"]
