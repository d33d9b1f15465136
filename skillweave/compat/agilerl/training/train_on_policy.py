"""AgileRL's training from whole episodes."""

from typing import Any

from skillweave.compat.agilerl.training.epochs import Epochs, Result


def train_on_policy(
    env: Any,
    env_name: str,
    algo: str,
    pop: list[Any],
    INIT_HP: Any = None,
    MUT_P: Any = None,
    swap_channels: bool = False,
    n_episodes: int = 2000,
    max_steps: int = 500,
    evo_epochs: int = 5,
    evo_loop: int = 1,
    target: float | None = 200.0,
    tournament: Any = None,
    mutation: Any = None,
    checkpoint: int | None = None,
    checkpoint_path: str | None = None,
    save_elite: bool = False,
    elite_path: str | None = None,
    wb: bool = False,
    verbose: bool = True,
    accelerator: Any = None,
    wandb_api_key: str | None = None,
) -> Result:
    """Train agents by ``max_steps`` steps and one ``learn`` per episode; agents and fitnesses."""
    epochs = Epochs(**locals())

    def episode(agent: Any, past: int) -> Any:
        states, acted, rewards, after, ended = zip(*epochs.steps(agent.getAction), strict=True)
        actions, log_probs, _, values = zip(*acted, strict=True)
        return agent.learn((states, actions, log_probs, rewards, ended, values, after[-1]))

    return epochs.run(episode)
