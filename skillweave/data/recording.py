"""``sw.record``: a policy plays episodes, which become a data set."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave.data.dataset import Dataset
from skillweave.envs.make import EnvSpec
from skillweave.errors import EnvError
from skillweave.experience.play import PlayedStep
from skillweave.schema import AtLeastOne, fitted
from skillweave.training.evaluation import evaluate


@checked_names
def record(
    policy: Any,
    env: Any,
    episodes: int = 100,
    *,
    seed: int = 0,
    max_steps: int | None = None,
    deterministic: bool = True,
    num_envs: int | None = None,
    info: Sequence[str] = (),
) -> Dataset:
    """Let a policy play episodes, and return them as a data set.

    ```python
    import skillweave as sw

    data = sw.record(lambda obs: (obs[:, 2] > 0).astype(int), "CartPole-v1", episodes=5)
    print(data)
    ```

    Args:
        policy: as of ``evaluate``: a function of observations, ``run.policy``, or one of
            ``from_onnx`` and its like.
        env: an ``EnvSpec``, a Gymnasium id, or a function that makes an environment.
        episodes: how many are played.
        seed: of the episodes.
        max_steps: an episode without an end by then is cut; None: see ``evaluate``.
        deterministic: act greedily, else sample.
        num_envs: environments side by side; None: up to 16.
        info: keys of the environment's ``info`` to keep.

    Raises:
        DeclarationError: an argument is wrong.
        PolicyError: the policy does not fit the environment.
        EnvError: the environment cannot be made, or sets no such key of ``info``.
    """
    episodes = fitted(AtLeastOne, episodes, "record(): episodes")
    fitted(Sequence[str], info, "record(): info")
    spec = env if isinstance(env, EnvSpec) else EnvSpec(env)
    rows: list[list[tuple[Any, ...]]] = [[] for _ in range(episodes)]
    kept: list[dict[str, list[Any]]] = [{key: [] for key in info} for _ in range(episodes)]

    def keep(played: PlayedStep) -> None:
        """Keep a step of each environment."""
        step = played.step
        columns = step.obs, step.next_obs, step.action, step.reward, step.terminated, step.truncated
        for k, episode in enumerate(played.episode.tolist()):
            rows[episode].append(tuple(np.array(column[k]) for column in columns))
            for key in info:
                if key not in step.info:
                    raise EnvError(f"{spec.name} sets no {key!r} in the info of a step")
                kept[episode][key].append(np.array(step.info[key][k]))

    evaluate(
        policy,
        spec,
        episodes=episodes,
        seed=seed,
        max_steps=max_steps,
        deterministic=deterministic,
        num_envs=num_envs,
        watch=keep,
    )
    recorded = []
    for steps, infos in zip(rows, kept, strict=True):
        obs, next_obs, action, reward, terminated, truncated = (
            np.stack(column) for column in zip(*steps, strict=True)
        )
        recorded.append(
            {
                "observations": np.concatenate([obs, next_obs[-1:]]),
                "actions": action,
                "rewards": reward,
                "terminations": terminated,
                "truncations": truncated,
                "infos": {key: np.stack(values) for key, values in infos.items()},
            }
        )
    return Dataset(recorded, spec, name=f"{episodes} episodes of {spec.name}")
