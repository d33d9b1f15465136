"""Data sets of Minari, read and written."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from skillweave._internal.messages import short
from skillweave.buffers.ram import check_memory
from skillweave.errors import DeclarationError, RunError, needs_extra
from skillweave.spaces import obs_dtype, obs_shape, unpack


def read_minari(source: Any) -> dict[str, Any]:
    """Return the arguments of ``Dataset`` for a data set of Minari, or its id.

    Raises:
        RunError: it is not there, or cannot be read.
    """
    with needs_extra("a data set of Minari", "data"):
        import minari
    found = source
    if isinstance(source, str):
        try:
            found = minari.load_dataset(source)
        except Exception as error:  # Minari's own errors have no common class
            raise RunError(
                f"Minari cannot load {short(source)}: {str(error)[:300]}. Download it first: "
                f"minari.download_dataset({source!r})"
            ) from error
    if not hasattr(found, "iterate_episodes"):
        raise DeclarationError(
            f"from_minari(): source is {short(source)}; it must be the id of a data set, or what "
            "minari.load_dataset() returned"
        )
    space = found.spec.observation_space
    each = 2 * obs_dtype(space).itemsize * int(np.prod(obs_shape(space), dtype=np.int64))
    what = f"the data set {found.spec.dataset_id}"
    check_memory(int(found.total_steps), each, what, "its episodes, minari_set.filter_episodes()")
    return {
        "episodes": _episodes(found),
        "observation_space": space,
        "action_space": found.spec.action_space,
        "name": str(found.spec.dataset_id),
    }


def _episodes(found: Any) -> Iterator[dict[str, Any]]:
    """Yield the episodes of a data set of Minari."""
    for one in found.iterate_episodes():
        yield {
            "observations": one.observations,
            "actions": one.actions,
            "rewards": one.rewards,
            "terminations": one.terminations,
            "truncations": one.truncations,
            "infos": one.infos or {},
        }


def write_minari(data: Any, name: str, about: dict[str, Any]) -> Any:
    """Write episodes as a data set of Minari, and return it; see ``Dataset.to_minari``.

    Raises:
        RunError: Minari refuses it.
    """
    with needs_extra("a data set of Minari", "data"):
        import minari
        from minari.data_collector import EpisodeBuffer
    buffers = []
    for i in range(len(data)):
        episode = data.episode(i)
        # Minari has an observation more than steps, and infos that belong to observations.
        seen = episode["observations"]
        if len(seen) == len(episode["rewards"]):
            seen = np.concatenate([seen, seen[-1:]])
        infos = {k: np.concatenate([x[:1], x]) for k, x in episode["infos"].items()}
        buffers.append(
            EpisodeBuffer(
                id=i,
                observations=unpack(data.observation_space, seen),
                actions=unpack(data.action_space, episode["actions"]),
                rewards=list(episode["rewards"].astype(float)),
                terminations=list(episode["terminations"]),
                truncations=list(episode["truncations"]),
                infos=infos or None,
            )
        )
    how = {"observation_space": data.observation_space, "action_space": data.action_space} | about
    try:
        return minari.create_dataset_from_buffers(name, buffers, **how)
    except Exception as error:  # Minari's own errors have no common class
        raise RunError(f"Minari does not write {short(name)}: {str(error)[:300]}") from error
