"""AgileRL's training from a replay buffer."""

from typing import Any

import numpy as np

from skillweave.compat.agilerl.training.epochs import Epochs, Result


def train_off_policy(
    env: Any,
    env_name: str,
    algo: str,
    pop: list[Any],
    memory: Any,
    INIT_HP: Any = None,
    MUT_P: Any = None,
    swap_channels: bool = False,
    n_episodes: int = 2000,
    max_steps: int = 500,
    evo_epochs: int = 5,
    evo_loop: int = 1,
    eps_start: float = 1.0,
    eps_end: float = 0.1,
    eps_decay: float = 0.995,
    target: float | None = 200.0,
    n_step: bool = False,
    per: bool = False,
    noisy: bool = False,
    n_step_memory: Any = None,
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
    """Train agents that share one buffer; returns agents and their fitnesses by evaluation."""
    epochs = Epochs(**locals())
    if mutation is not None:
        epochs.pop = mutation.mutation(pop, pre_training_mut=True)

    def episode(agent: Any, past: int) -> float:
        """Let an agent act and learn for an episode, by AgileRL's rules; return the mean loss."""
        losses = []
        how = () if noisy else (max(eps_end, eps_start * eps_decay**past),)
        for transition in epochs.steps(lambda state: agent.getAction(state, *how)):
            for buffer in (memory, n_step_memory):
                if buffer is not None:
                    buffer.save2memoryVectEnvs(*transition)
            if per:
                agent.beta += (1.0 - agent.beta) * (past + 1) / n_episodes
            if memory.counter % agent.learn_step == 0 and len(memory) >= agent.batch_size:
                losses.append(_learn(agent, memory, n_step_memory, n_step, per))
        return float(np.mean(losses or [0.0]))

    return epochs.run(episode)


def _learn(agent: Any, memory: Any, n_step_memory: Any, n_step: bool, per: bool) -> float:
    """Make one gradient step; return its loss, or the critics' loss where there is an actor."""
    if not per and n_step_memory is None:
        result = agent.learn(memory.sample(agent.batch_size))
        losses = [x for x in (result if isinstance(result, tuple) else (result,)) if x is not None]
        return float(losses[-1])
    batch = memory.sample(agent.batch_size, agent.beta if per else True)
    if n_step_memory is not None:
        batch += n_step_memory.sample_from_indices(batch[-1])
    loss, idxs, priorities = agent.learn(batch, n_step=n_step, per=per)
    if per:
        memory.update_priorities(idxs, priorities)
    return float(loss)
