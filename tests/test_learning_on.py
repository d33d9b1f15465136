"""Apart, then together: who learns on goes on with all it has learnt, also after a kill."""

from __future__ import annotations

import pytest
import torch
from declaring import Other, declare
from small_runs import Heard, Left, Push, assert_same, new_run

from skillweave import SkillweaveError
from skillweave._internal.prefixes import unprefixed
from skillweave.hierarchy import select_best, training
from skillweave.runs.directory import RunDirectory
from skillweave.training.joint import JointLearner


def then(**how):
    return declare(Left(), Other(), Push(), learn="apart, then together", **how)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An uninterrupted run, and the states that stages ended and began with."""
    ended, begun = {}, {}
    with pytest.MonkeyPatch.context() as patch:
        save, init = RunDirectory.save_checkpoint, JointLearner.__init__

        def saved(self, header, tensors):
            ended[header.stage] = unprefixed(f"state.{header.stage}", tensors)
            save(self, header, tensors)

        def made(self, parts, how, *more):
            for name, part in parts.items():
                begun[name] = {k: v.clone() for k, v in vars(part.stacks[0].state).items()}
            init(self, parts, how, *more)

        patch.setattr(RunDirectory, "save_checkpoint", saved)
        patch.setattr(JointLearner, "__init__", made)
        path = tmp_path_factory.mktemp("then") / "run"
        then().train(path, seed=3, quiet=True)
    return path, ended, begun


@pytest.mark.parametrize("name", ["left", "other", "selector"])
def test_the_whole_state_of_the_stage_before_is_what_it_begins_with(whole, name):
    _, ended, begun = whole
    for field, value in ended[name].items():
        assert torch.equal(begun[name][field], value), field
    assert float(begun[name]["mu"].abs().sum()) > 0
    assert int(begun[name]["count"].max()) > 0
    if name != "other":  # of DQN's returns nothing is kept
        assert float(begun[name]["return_count"][0]) > 10


class StopAfter(Heard):
    """A listener that raises when a stage is done."""

    def __init__(self, stage):
        super().__init__()
        self.at = stage

    def done(self, name, *told):
        if name == self.at:
            raise KeyboardInterrupt


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["left", "selector", "together"])
def test_a_run_killed_between_stages_ends_as_if_it_had_not_been(whole, stage, tmp_path):
    run = new_run(then(), tmp_path / "run")
    with pytest.raises(KeyboardInterrupt):
        training.train(then(), run, (StopAfter(stage),))
    run.close()
    then().resume(run.path, quiet=True)
    assert_same(run.path, whole[0])
    assert not (run.path / "states").exists()


@pytest.mark.slow
def test_a_run_killed_while_it_was_judged_is_judged_when_it_is_resumed(
    whole, tmp_path, monkeypatch
):
    def killed(*args, **named):
        raise KeyboardInterrupt

    run = new_run(then(), tmp_path / "run")
    with monkeypatch.context() as patch:
        patch.setattr(select_best, "evaluate", killed)
        with pytest.raises(KeyboardInterrupt):
            training.train(then(), run)
    run.close()
    assert not run.finished
    with pytest.raises(SkillweaveError, match=r"not judged yet.*resume=True"):
        then().load(run.path)
    then().resume(run.path, quiet=True)
    assert_same(run.path, whole[0])
    assert then().load(run.path).evaluate(3) == then().load(whole[0]).evaluate(3)
