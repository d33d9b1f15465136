"""What goes wrong in processes that step environments is a sentence; nothing waits for ever."""

import ctypes
import faulthandler
import multiprocessing
import os
import signal
import sys
import tempfile
import time

import numpy as np
import pytest
import torch
from toys import World

import skillweave as sw
from skillweave.workers import processes
from skillweave.workers.host import Workers

SMALL = sw.PPO(num_envs=4, n_steps=16, batch_size=32, update_epochs=1, network=sw.Network((4,)))


class Ramp(World):
    def step(self, action):
        if self.t == 4 and multiprocessing.parent_process() is not None:
            self.at_five()
        return super().step(action)

    def at_five(self):
        """Something happens, in processes alone."""


def crash(how):
    """End as C code does whose memory is damaged; without a page of stacks in the output."""
    faulthandler.disable()
    how()


def does(what):
    return type("Odd", (Ramp,), {"at_five": lambda self: what()})


def train(env, folder, workers=2, quiet=True, **how):
    spec = sw.EnvSpec(env, engine="sync", workers=workers)
    return sw.train_agent(spec, SMALL, 128, folder, quiet=quiet, **how)


def assert_same(run, other):
    for name, value in other.policy.weights.items():
        assert torch.equal(run.policy.weights[name], value)


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize(
    ("what", "says"),
    [
        (lambda: os._exit(7), r"died with exit code 7 while it was .*checking its env.*os\._exit"),
        (lambda: crash(lambda: ctypes.string_at(0)), r"SIGSEGV"),
        (lambda: crash(os.abort), r"SIGABRT"),
        (lambda: os.kill(os.getpid(), signal.SIGKILL), r"SIGKILL, Killed\), perhaps .* memory"),
    ],
)
def test_a_process_that_ends_says_why(what, says, tmp_path):
    with pytest.raises(sw.SkillweaveError, match=r"worker 0 |in worker 0") as found:
        train(does(what), tmp_path / "run")
    assert found.match(says)


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("call", ["step", "reset", "__init__"])
def test_an_environment_that_calls_sys_exit_is_an_error(call, workers, tmp_path):
    class Exits(Ramp):
        def __init__(self):
            super().__init__()
            self.at("__init__")

        def reset(self, *, seed=None, options=None):
            self.at("reset")
            return super().reset(seed=seed)

        def step(self, action):
            if self.t == 3:
                self.at("step")
            return super().step(action)

        def at(self, here):
            if here == call and (workers == 1 or multiprocessing.parent_process() is not None):
                sys.exit("enough")

    says = {"step": "environment 0, step 4 of its episode: step", "reset": "reset", "__init__": ""}
    with pytest.raises(sw.SkillweaveError) as found:
        train(Exits, tmp_path / "run", workers)
    assert found.match(r"Exits.* SystemExit: enough \(test_processes_fail\.py, line \d+\)")
    assert found.match(says[call])


def test_ctrl_c_in_an_environment_stops_the_run(tmp_path):
    class Interrupts(Ramp):
        def step(self, action):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(Interrupts, tmp_path / "run", workers=1)


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("how", [RuntimeError("the window is gone"), SystemExit(3)])
def test_an_environment_whose_close_raises_costs_no_weights(workers, how, tmp_path, capsys):
    class Odd(Ramp):
        def close(self):
            raise how

    run = train(Odd, tmp_path / "run", workers, quiet=False)
    said = capsys.readouterr().err
    assert said.count("Odd: close() raised") == 1
    assert type(how).__name__ in said
    assert_same(run, train(Ramp, tmp_path / "tidy", workers))


def test_a_process_that_ends_in_the_check_after_training_costs_no_weights(tmp_path):
    class Once(Ramp):
        closed = False

        def __init__(self):
            super().__init__()
            if type(self).closed:
                os._exit(7)

        def close(self):
            type(self).closed = multiprocessing.parent_process() is not None

    run = train(Once, tmp_path / "run")
    assert_same(run, train(Ramp, tmp_path / "tidy"))


def test_what_does_not_answer_is_named_with_what_it_was_asked(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(processes, "SILENCE", 0.3)
    waits = iter([3.0])  # the silence until a notice doubles with each
    slow = does(lambda: time.sleep(next(waits, 0.0)))
    train(slow, tmp_path / "run", quiet=False)
    said = capsys.readouterr().err
    assert "Odd: worker 0 (environments 0 to 1) (process " in said
    assert "it is making 16 steps in each" in said


def test_a_task_that_cannot_be_sent_is_an_error_with_its_cause(tmp_path, monkeypatch):
    ask = Workers.ask

    def odd(self, what, tasks, kept=True):
        return ask(self, what, [lambda: 0 for _ in tasks] if what == "collect" else tasks, kept)

    monkeypatch.setattr(Workers, "ask", odd)
    monkeypatch.setattr(processes, "_described", lambda what, task: "asked for something odd")
    with pytest.raises(sw.SkillweaveError, match=r"could not be sent: .*lambda"):
        train(Ramp, tmp_path / "run")


def in_daemon(folder, workers, tell):
    run = train(Ramp, folder, workers, quiet=False)
    tell.send({k: v.numpy() for k, v in run.policy.weights.items()})


def test_a_daemon_trains_without_processes_and_finds_the_same(tmp_path, capfd):
    context = multiprocessing.get_context("fork")
    told, tell = context.Pipe(duplex=False)
    daemon = context.Process(target=in_daemon, args=(tmp_path / "d", 2, tell), daemon=True)
    daemon.start()
    assert told.poll(60), "it never ended"
    found = told.recv()
    daemon.join()
    assert capfd.readouterr().err.count("daemon of multiprocessing") == 1
    for name, value in train(Ramp, tmp_path / "here").policy.weights.items():
        np.testing.assert_array_equal(value, found[name])


def no_memory(*_):
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("missing", ["memory without a name", "temporary files", "room"])
def test_without_shared_memory_the_weights_are_the_same(missing, tmp_path, monkeypatch):
    before = train(Ramp, tmp_path / "with")
    if missing == "room":
        monkeypatch.setattr(os, "posix_fallocate", no_memory, raising=False)
    else:
        monkeypatch.delattr(os, "memfd_create", raising=False)
    if missing == "temporary files":
        monkeypatch.setattr(tempfile, "tempdir", "/proc/none")
    assert_same(train(Ramp, tmp_path / "without"), before)


def test_an_environment_in_a_process_may_have_processes(tmp_path):
    class Simulator(Ramp):
        def __init__(self):
            super().__init__()
            context = multiprocessing.get_context("fork")
            self.other = context.Process(target=time.sleep, args=(100,))
            self.other.start()

        def close(self):
            self.other.kill()
            self.other.join()

    train(Simulator, tmp_path / "run")
