"""Declarations of users: skills, reflexes, ready selectors, and policies from elsewhere.

Begin with ``base``, the classes; ``skill_set`` makes policies of the skills below a selector.
"""

from skillweave.policies.core import LastCall
from skillweave.skills import tree
from skillweave.skills.automaton import Automaton
from skillweave.skills.base import Reflex, Skill, call_method, is_trained, path_of
from skillweave.skills.onnx_file import from_onnx
from skillweave.skills.ready import ready_policy
from skillweave.skills.residual import Residual
from skillweave.skills.sb3 import from_sb3
from skillweave.skills.scripted import from_function
from skillweave.skills.selector import ReadySelector, ready_selector
from skillweave.skills.torch_module import from_torch

__all__ = [
    "Automaton",
    "LastCall",
    "ReadySelector",
    "Reflex",
    "Residual",
    "Skill",
    "call_method",
    "from_function",
    "from_onnx",
    "from_sb3",
    "from_torch",
    "is_trained",
    "path_of",
    "ready_policy",
    "ready_selector",
    "tree",
]
