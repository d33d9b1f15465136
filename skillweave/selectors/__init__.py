"""Ready selectors: functions, automata and behaviour trees that choose skills without training."""

from skillweave.policies.core import LastCall
from skillweave.selectors import tree
from skillweave.selectors.automaton import Automaton
from skillweave.selectors.base import ReadySelector
from skillweave.selectors.ready import ready_selector

__all__ = ["Automaton", "LastCall", "ReadySelector", "ready_selector", "tree"]
