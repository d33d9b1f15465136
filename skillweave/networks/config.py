"""Architectures as data; this module does not import torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any, Literal, TypeVar

import numpy as np

from skillweave._internal.named import named
from skillweave.errors import DeclarationError
from skillweave.schema import Check, Count, check, settings

T = TypeVar("T")
WIDEST = 65_536
"""The most units of a layer."""
Activation = Literal["tanh", "relu", "elu", "silu", "gelu"]
Width = Annotated[int, Check(f"at least 1 and at most {WIDEST:,}", lambda x: 1 <= x <= WIDEST)]
"""Units of a layer, channels, or pixels of a kernel."""


def _seen(value: Any) -> Any:
    """Return one place, several, or a key as a tuple."""
    if isinstance(value, slice):
        value = range(value.start or 0, value.stop, value.step or 1)
    if isinstance(value, range | np.ndarray):
        return tuple(np.ravel(value))
    one = isinstance(value, str | int | np.integer) and not isinstance(value, bool)
    return (value,) if one else value


Key = Annotated[str, Check("the key of a part of the observation", lambda x: x != "")]
Seen = Annotated[
    tuple[Count | Key, ...],
    Check(
        "places in an observation, from 0, and keys of its parts, each once: sees=(0, 1, 4), "
        "slice(0, 8) or ('joints', 'arm.speed')",
        lambda x: 0 < len(x) == len(set(x)),
        _seen,
    ),
]
"""Places of numbers in an observation, and keys of its parts."""
EncoderValue = Annotated[
    str | Callable[[Any], Any],
    Check(
        "a function f(observation_space) that returns a torch.nn.Module, or the name of a "
        "registered encoder"
    ),
]
"""An encoder as the user passes it."""


@settings
class CNN:
    """A convolutional network for images; ``CNN()`` is Nature's (Mnih et al. 2015).

    Raises:
        DeclarationError: a setting is wrong or out of its range; the message names it.
    """

    _from_dict = True

    kind: Literal["plain", "impala"] = "plain"
    """plain: convolutions in a row; impala: residual stages, each halving the image."""
    channels: tuple[Width, ...] = (32, 64, 64)
    """Channels of each convolution, or of each residual stage."""
    kernels: tuple[Width, ...] = (8, 4, 3)
    """Kernel size of each convolution, in pixels; impala's are always 3."""
    strides: tuple[Width, ...] = (4, 2, 1)
    """Stride of each convolution, in pixels."""

    def __post_init__(self) -> None:
        check(self, "channels", len(self.channels) > 0, "a list of at least one layer")
        sizes = {len(self.channels), len(self.kernels), len(self.strides)}
        if self.kind == "plain" and len(sizes) > 1:
            raise DeclarationError(
                f"CNN.channels, kernels and strides have {len(self.channels)}, "
                f"{len(self.kernels)} and {len(self.strides)} entries; give the same number of each"
            )

    @classmethod
    def impala(cls, channels: tuple[int, ...] = (16, 32, 32)) -> CNN:
        """Return the residual network of IMPALA (Espeholt et al. 2018, fig. 3).

        Args:
            channels: the channels of each block.

        Returns:
            The settings.
        """
        return cls("impala", channels, (), ())

    @classmethod
    def small(cls) -> CNN:
        """Return one 3×3 layer of 16 channels, for images of about ten pixels (Young & Tian 2019).

        Returns:
            The settings.
        """
        return cls("plain", (16,), (3,), (1,))


@settings
class RNN:
    """A recurrent layer after the hidden layers.

    Raises:
        DeclarationError: a setting is wrong or out of its range; the message names it.
    """

    _from_dict = True

    kind: Literal["lstm", "gru"] = "lstm"
    """lstm (Hochreiter & Schmidhuber 1997) or gru (Cho et al. 2014)."""
    size: Width = 64
    """Width of its output."""


@settings
class Network:
    """A network: a CNN for images, then hidden layers on all numbers, then a recurrent layer.

    Dict and Tuple observations need no setting: their parts are joined before the hidden layers.
    Lists count as tuples, and a dict as the settings that it names.

    ```python
    import skillweave as sw

    wide = sw.Network((256, 256), "relu", layer_norm=True)
    with_memory = sw.Network((64,), rnn=sw.algorithms.RNN("lstm", 32))
    pixels = sw.Network((512,), "relu", cnn=sw.algorithms.CNN())
    from_yaml = sw.PPO(network={"hidden": [64, 64], "rnn": {"kind": "gru"}})
    ```

    Raises:
        DeclarationError: a setting is wrong or out of its range; the message names it.
    """

    _from_dict = True

    hidden: tuple[Width, ...] = (64, 64)
    """Width of each hidden layer."""
    activation: Activation = "tanh"
    """Nonlinearity after each hidden layer, and after each convolution."""
    layer_norm: bool = False
    """Normalise each hidden layer before its nonlinearity."""
    cnn: CNN | None = None
    """The encoder of images; None: CNN() from 36 pixels upwards, CNN.small() below, with a smaller
    kernel where an image has fewer than 3 pixels."""
    rnn: RNN | None = None
    """A recurrent layer, for PPO; None: the policy sees one observation at a time."""
    encoder: EncoderValue | None = None
    """A network of your own in front of the hidden layers: a function ``f(observation_space)`` that
    returns a ``torch.nn.Module``, or such a class. Its ``forward`` turns observations (B, *shape)
    into features (B, F), as a features extractor of Stable-Baselines3 does. The space describes
    the input of ``forward``, all of it float32: numbers after the algorithm's ``normalize_obs``,
    images as (C, H, W) from 0 to 1, choices one-hot, a Dict or Tuple as a dict or tuple. Its
    parameters are learnt and saved with the policy; a run records its name, and needs its code to
    be loaded. Or the name of a registered encoder; see ``register_encoder``."""
    sees: Seen | None = None
    """The numbers that the network sees in the observation: places, a slice, or keys of a Dict or
    Tuple, ``("joints", "arm.speed")``; None: all. Places count in the flat vector: parts of a Dict
    or Tuple one after another, a Discrete one-hot, without images, which are always seen. A skill
    with goals observes a Dict of ``observation`` and ``goal``: ``("observation.joints", "goal")``.
    For a skill that must not depend on the task around it."""
    planes: Literal["first", "last"] | None = None
    """The axis of an image that holds its channels, or a board's planes; None: derived from the
    shape, as of (8, 8, 111) and (3, 210, 160). Applies to images of ambiguous shape, such as
    (3, 3, 3); if no shape is ambiguous, to all."""

    def __post_init__(self) -> None:
        if self.encoder is not None:
            object.__setattr__(self, "encoder", _encoder(self.encoder))
        if self.sees is not None and self.encoder is not None:
            raise DeclarationError("Network: give sees or encoder, not both")


def check_critic(config: Any) -> None:
    """Raise a DeclarationError where the ``critic`` of settings does not fit the ``network``."""
    critic = getattr(config, "critic", None)
    if critic is not None:
        check(config, "critic", critic.rnn is None, "without rnn")
        same = critic.planes in (None, config.network.planes)
        check(config, "critic", same, "without planes: Network.planes of network counts for both")


def _encoder(value: Any) -> str:
    """Return the name of an encoder; for a function of the user, a name that leads to it."""
    if not isinstance(value, str) and hasattr(value, "state_dict") and not isinstance(value, type):
        raise DeclarationError(
            f"Network.encoder is a {type(value).__name__}, a module; give the class, or a function "
            "f(observation_space) that makes the module, because each network needs its own"
        )
    name: str = named(value, "Network.encoder")
    return name


def seeing_all(algorithm: T) -> T:
    """Return an algorithm's settings with networks that see the whole observation."""
    networks = {k: getattr(algorithm, k, None) for k in ("network", "critic")}
    seeing = {k: replace(v, sees=None) for k, v in networks.items() if isinstance(v, Network)}
    return replace(algorithm, **seeing)  # type: ignore[type-var]
