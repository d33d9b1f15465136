"""The words of a mission's text: names of skills, the hierarchy's own words, and given ones."""

import numpy as np
import pytest
from call_logs.untrained import run_of
from ready_selectors.chain import PLACE, GetKey, OpenDoor, Wait, at_four

from skillweave.errors import DeclarationError


class Then(Wait):
    name = "then"  # a word of missions

    def success(self, step):
        return np.ones(len(step.reward), bool)


class ToKey(GetKey):
    def success(self, step):
        return step.next_obs[:, 1] == 1


def at_five(obs):
    return obs[:, PLACE] == 5


def test_skills_names_mean_their_success_and_a_hierarchy_has_words():
    run = run_of(ToKey(), OpenDoor(), Then(), predicates={"four": at_four})
    log = run.log_calls(2_000, info=("door",))
    planned = run.plan("to_key then four")
    assert planned.evaluate(10, quiet=True).success_rate == 1.0
    given = run.plan("to_key then five", log, predicates={"five": at_five})
    assert given.evaluate(10, quiet=True).success_rate == 1.0
    with pytest.raises(DeclarationError, match="'fiv' is no known predicate; there are: to_key"):
        run.plan("to_key then fiv")
    # A word that is given replaces one of its name.
    other = run.plan("four", log, predicates={"four": lambda obs: obs[:, PLACE] == 3})
    assert other.evaluate(10, quiet=True).lengths != run.plan("four", log).evaluate(10).lengths
    again = planned.plan("four", log)
    assert again.evaluate(5, quiet=True).success_rate == 1.0


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ({"four": 4}, "predicates: 'four': 4 is no predicate"),
        ({"to_key": at_four}, "'to_key' is the name of a skill"),
        ({"4": at_four}, "a name is one word that begins with a letter"),
        (at_four, "predicates is "),
    ],
)
def test_wrong_words_are_refused_where_they_are_declared(words, says):
    with pytest.raises(DeclarationError, match=says):
        run_of(ToKey(), OpenDoor(), Then(), predicates=words)
