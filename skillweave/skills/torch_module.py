"""PyTorch modules as policies."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from gymnasium import Space

from skillweave.arguments import checked_names
from skillweave.errors import DeclarationError, PolicyError, RunError
from skillweave.messages import short, shortened
from skillweave.skills.foreign_policy import Foreign, checksum, qualified
from skillweave.skills.outputs import decoded
from skillweave.types import Array, Memory

if TYPE_CHECKING:
    from torch import nn


class TorchPolicy(Foreign):
    """A module whose forward takes observations and returns logits or actions."""

    kind = "torch"
    suffix = ".safetensors"

    def __init__(
        self, module: nn.Module, observation_space: Any = None, action_space: Any = None
    ) -> None:
        super().__init__(f"module {type(module).__name__}", observation_space, action_space)
        self.module = module

    def bind(self, observation_space: Space[Any], action_space: Space[Any], who: str) -> Self:
        """Return a copy in evaluation mode, independent of later changes of the module."""
        bound = super().bind(observation_space, action_space, who)
        bound.module = copy.deepcopy(self.module).eval()
        return bound

    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> tuple[Array, Memory]:
        """Return the module's actions; logits are sampled with ``rng`` if not ``deterministic``."""
        import torch

        from skillweave.spaces import unpack

        self.must_be_bound()
        state = [*self.module.parameters(), *self.module.buffers()]
        device = state[0].device if state else None
        dtype = next((x.dtype for x in state if x.is_floating_point()), torch.float32)
        with torch.inference_mode():
            output = self.module(_tensors(unpack(self.observation_space, obs), device, dtype))
        if not isinstance(output, torch.Tensor):
            raise PolicyError(
                f"{self._who} returned a {type(output).__name__}; forward must return one tensor"
            )
        output = output.float() if output.is_floating_point() else output
        action = decoded(
            output.cpu().numpy(),
            len(obs),
            self.action_space,
            self._who,
            mask=mask,
            deterministic=deterministic,
            rng=rng,
        )
        return action, memory

    def source(self) -> dict[str, Any]:
        """Return the module's class, and the checksum of its weights."""
        name = qualified(type(self.module))
        return {"kind": self.kind, "name": name, "sha256": checksum(self.content())}

    def content(self) -> bytes:
        """Return its weights."""
        return weights_of(self.module, self._who)

    def restored(self, content: bytes) -> Self:
        """Return a copy with these weights."""
        policy = copy.copy(self)
        policy.module = with_weights(self.module, content, self._who)
        return policy


@checked_names
def from_torch(
    module: nn.Module, *, observation_space: Any = None, action_space: Any = None
) -> TorchPolicy:
    """Return a PyTorch module as a skill's policy; a skill takes the bare module too.

    ``forward`` receives observations (n, *obs_shape) of the type of its weights (float32 without
    weights), images unscaled, for a Dict or Tuple a dict or tuple of such. It returns logits for
    Discrete (concatenated for MultiDiscrete, one for each bit of MultiBinary), actions for Box
    (clipped to its bounds); whole numbers are always actions. Its weights are copied into the run;
    loading the run replaces the weights of the recipe's module by them.

    Args:
        module: acts in evaluation mode, as a copy made when training starts.
        observation_space: None: the environment's.
        action_space: None: the environment's.

    Returns:
        The policy, for a skill's ``policy`` or ``evaluate``.

    Raises:
        DeclarationError: it is not an instance of a module.
    """
    if isinstance(module, type) or not hasattr(module, "state_dict"):
        raise DeclarationError(f"from_torch takes a module made of its class, not {short(module)}")
    return TorchPolicy(module, observation_space, action_space)


def _tensors(obs: Any, device: Any, dtype: Any) -> Any:
    import torch

    if isinstance(obs, dict):
        return {name: _tensors(part, device, dtype) for name, part in obs.items()}
    if isinstance(obs, tuple):
        return tuple(_tensors(part, device, dtype) for part in obs)
    return torch.tensor(obs, dtype=dtype, device=device)


def weights_of(module: nn.Module, who: str) -> bytes:
    """Return the state of a module as a safetensors file.

    Raises:
        PolicyError: it has state that is not a tensor.
    """
    import safetensors.torch
    from torch import Tensor

    state = module.state_dict()
    for name, value in state.items():
        if not isinstance(value, Tensor):
            raise PolicyError(f"{who}: its state {name!r} is a {type(value).__name__}, no tensor")
    # Clones: modules may share tensors, which the format does not support.
    return safetensors.torch.save({k: v.detach().cpu().clone() for k, v in state.items()})


def with_weights(module: nn.Module, content: bytes, who: str) -> nn.Module:
    """Return a copy of a module with the weights of ``weights_of``.

    Raises:
        RunError: the weights have other names or shapes.
    """
    import safetensors
    import safetensors.torch
    import torch

    loaded = copy.deepcopy(module)
    try:
        with torch.device("cpu"):  # the user may have changed the default device
            weights = safetensors.torch.load(content)
        loaded.load_state_dict(weights)
    except (RuntimeError, safetensors.SafetensorError) as error:
        reason = shortened(str(error))
        raise RunError(f"{who}: the weights in the run do not fit it: {reason}") from error
    return loaded
