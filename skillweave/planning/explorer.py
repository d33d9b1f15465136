"""Exploring: calls are chosen that lead to where a skill was not called yet."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave.calls.log import CallLog
from skillweave.calls.neighbors import check_features
from skillweave.calls.record import RecordingSelector
from skillweave.planning.graph import CallGraph
from skillweave.planning.machine import RewardMachine
from skillweave.policies.core import Array
from skillweave.schema import AtLeastOne, Check, Fraction, Positive, fitted

PER_FEATURE = 0.25
"""Standard deviations of each feature from which on a call is new."""
_Temperature = Annotated[float, Check("from 1e-06 to 10", lambda x: 1e-6 <= x <= 10)]


@checked_names
class Explorer(RecordingSelector):
    """A selector for ``record_calls`` that prefers calls which differ from the logged ones.

    Where the nearest logged call of a skill is further than ``radius``, calling it is worth the
    most that can be, 1; other calls are worth what they lead to (R-max: Brafman & Tennenholtz
    2002). It plans again on the calls so far every ``every`` steps, and chooses at random before.
    Of a skill with goals, a new call has a goal that its ``goals`` draws.

    It looks for novelty alone: no task counts, and the value 1 has no unit.

    Args:
        radius: in standard deviations of the features, over all of them; None: a quarter of one
            in each feature, 0.25 √F.
        features: as for ``Planner``; what makes two calls alike, a place for example.
        neighbors: K.
        gamma: γ of one step.
        temperature: as for ``Planner``.
        every: steps after which it plans again.

    Raises:
        DeclarationError: a number is out of its range, or features are none.
    """

    def __init__(
        self,
        radius: float | None = None,
        *,
        features: Any = None,
        neighbors: int = 3,
        gamma: float = 0.997,
        temperature: float = 0.03,
        every: int = 4_000,
    ) -> None:
        check_features(features, "Explorer")
        self.every = fitted(AtLeastOne, every, "Explorer: every")
        self._radius = fitted(Positive | None, radius, "Explorer: radius")
        self._features = features
        self._gamma = fitted(Fraction, gamma, "Explorer: gamma")
        self._neighbors = fitted(AtLeastOne, neighbors, "Explorer: neighbors")
        self._temperature = fitted(_Temperature, temperature, "Explorer: temperature")
        self._choices = 0
        self._graph: CallGraph | None = None
        self._worth = self._far = np.zeros(0)

    def begin(self, choices: int) -> None:
        """Prepare for a recording; ``choices``: of a selector, skills times lengths."""
        self._choices = choices
        self._graph = None

    def learn(self, log: CallLog) -> None:
        """Plan on the calls so far."""
        if len(log) < 2:
            return
        graph = CallGraph(log, self._features, self._neighbors)
        sizes = np.array([each.size for each in graph.maps])[graph.options.skills]
        far = PER_FEATURE * np.sqrt(sizes) if self._radius is None else self._radius
        self._far = np.broadcast_to(np.float32(far), sizes.shape)
        worth = graph.solve(
            RewardMachine({}), self._gamma, graph.terminated, graph.after, graph.may,
            novel=self._far,
        )  # fmt: skip
        self._graph = graph
        self._worth = worth[:, 0]

    def new_share(self) -> float:
        """Return the share of (end of a call, choice) pairs that are new; 1 before planning."""
        if self._graph is None:
            return 1.0
        may = self._graph.may[:, self._graph.choice_of]
        return float((self._graph.after.distance > self._far)[may].mean())

    def decide(
        self, obs: Array, mask: Array | None, rng: np.random.Generator
    ) -> tuple[Array, dict[str, tuple[Array, Array]]]:
        """Return choices (n,), sampled, and goals of logged calls that are made again."""
        graph = self._graph
        if graph is None:
            score = rng.random((len(obs), self._choices))
            return (score if mask is None else np.where(mask, score, -1.0)).argmax(1), {}
        near = graph.near(obs)
        q = (self._worth[near.pieces] * near.weights).sum(2)
        is_new = near.distance > self._far
        q = np.where(is_new, 1.0, q)
        largest = np.maximum(np.abs(q).max(1, keepdims=True), 1e-3)
        score = q / (self._temperature * largest) + rng.gumbel(size=q.shape)
        if mask is not None:
            score = np.where(mask[:, graph.choice_of], score, -np.inf)
        rows = np.arange(len(obs))
        option = score.argmax(1)
        choice = graph.choice_of[option]
        call = near.goal[rows, option]
        again = (call >= 0) & ~is_new[rows, option]
        goals = {}
        for name, numbers in graph.log.goals.items():
            mine = np.flatnonzero(again & (graph.options.skills[option] == graph.log.number(name)))
            goals[name] = mine, numbers[call[mine]]
        return choice, goals
