"""Defaults of ``train``'s arguments: evaluation while training, checkpoints, the flat baseline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal

from skillweave.algorithms.config import AlgorithmSettings
from skillweave.schema import AtLeastOne, Check, annotations_of, fitted, settings

InfoKeys = Annotated[
    Sequence[Annotated[str, Check("a key of info, such as 'distance'", bool)]],
    Check("a list of keys of info, such as ['distance']"),
]
"""Keys of ``info``."""
AGENT_DEFAULTS = ("eval_every", "eval_episodes", "checkpoint_every", "keep", "log_info")
"""The arguments that ``TrainDefaults`` completes, and ``run.json`` records, of a plain agent."""
HIERARCHY_DEFAULTS = (*AGENT_DEFAULTS, "log_calls", "log_calls_info")
"""The arguments that ``TrainDefaults`` completes, and ``run.json`` records, of a hierarchy."""


@settings
class TrainDefaults:
    """Values that ``train`` uses for arguments that its caller leaves out.

    A recipe sets them: ``train_defaults=TrainDefaults(eval_every=50_000)``.

    Raises:
        DeclarationError: a value is out of its range.
    """

    eval_every: AtLeastOne | None = None
    """Environment steps between evaluations while training, by the learner's own reward; None: no
    evaluation. Their results are ``eval_return`` and ``eval_success`` in ``metrics.jsonl``."""
    eval_episodes: AtLeastOne = 20
    """Episodes of each of these evaluations."""
    checkpoint_every: AtLeastOne = 100_000
    """Environment steps between checkpoints."""
    keep: Literal["last", "best"] | None = None
    """"best": each stage ends with the weights whose periodic evaluation was best, by the mean
    return or by what its target is of; the last weights are evaluated, too. It needs
    ``eval_every``. "last": the last weights. None: "last"; but a stage whose policy was given ends
    with the best ones, by a few evaluations where these take at most a tenth of its steps, and with
    what it was given where the result is clearly worse. A population ends with its best member in
    any case."""
    log_info: InfoKeys = ()
    """Keys of ``info``: the mean of each over the latest 100 episodes is ``info/<key>`` in
    ``metrics.jsonl`` and in trackers. Each episode counts with the value in its last step (in a
    skill's own stage, its call's). None, NaN and infinity are left out."""
    log_calls: AtLeastOne | None = None
    """Record the calls in the last steps of training, this many; see ``Hierarchy.train``."""
    log_calls_info: InfoKeys = ()
    """Keys of ``info`` to record with the calls."""
    flat: AlgorithmSettings | None = None
    """Settings of the flat baseline; None: the hierarchy's ``algorithm``."""

    def __post_init__(self) -> None:
        for name in ("log_info", "log_calls_info"):
            object.__setattr__(self, name, tuple(dict.fromkeys(getattr(self, name))))

    def given(self, options: Any) -> TrainDefaults:
        """Return these values, replaced by the attributes of ``options`` that are not None.

        Raises:
            DeclarationError: one of them is wrong; the message calls it by its name alone.
        """
        kinds = annotations_of(TrainDefaults)
        values = {name: getattr(options, name) for name in HIERARCHY_DEFAULTS}
        given = {name: value for name, value in values.items() if value is not None}
        return replace(self, **{name: fitted(kinds[name], given[name], name) for name in given})

    def entries(self, names: Sequence[str]) -> dict[str, Any]:
        """Return the values of ``names``, as fields of a run's manifest."""
        return {name: getattr(self, name) for name in names}
