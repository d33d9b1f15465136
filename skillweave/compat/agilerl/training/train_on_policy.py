"""AgileRL's training from whole episodes."""

from __future__ import annotations

from typing import Any

from skillweave.compat.agilerl.training.epochs import Epochs, Result, swapped


def train_on_policy(
    env: Any, env_name: str, algo: str, pop: list[Any], INIT_HP: Any = None, MUT_P: Any = None,
    swap_channels: bool = False, n_episodes: int = 2000, max_steps: int = 500, evo_epochs: int = 5,
    evo_loop: int = 1, target: float | None = 200.0, tournament: Any = None, mutation: Any = None,
    checkpoint: int | None = None, checkpoint_path: str | None = None, save_elite: bool = False,
    elite_path: str | None = None, wb: bool = False, verbose: bool = True, accelerator: Any = None,
    wandb_api_key: str | None = None,
) -> Result:  # fmt: skip
    """Train agents by ``max_steps`` steps and one ``learn`` an episode; them, their fitnesses."""
    epochs = Epochs(**locals())

    def episode(agent: Any, done: int) -> tuple[Any, Any, Any]:
        record: list[Any] = []
        state = swapped(epochs.env.reset()[0], swap_channels)
        for _ in range(max_steps):
            action, log_prob, _, value = agent.getAction(state)
            after, reward, ended, _, _ = epochs.env.step(action)
            record.append((state, action, log_prob, reward, ended, value))
            state = swapped(after, swap_channels)
        columns = tuple(zip(*record, strict=True))
        return columns[3], columns[4], agent.learn((*columns, state))

    return epochs.run(episode)
