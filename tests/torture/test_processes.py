"""Cases in processes of their own: whatever a case does, its outcome is told and the rest go on."""

import faulthandler
import os
import time
from collections import Counter

from living import all_end

from scripts.torture.processes import (
    fork as start,
    group_is_gone,
    kill_group,
    note,
    run_cases,
    wait,
)
from scripts.torture.report import CRASH, EQUAL, HANG, TRACEBACK, Outcome

WHAT = {3: "raises", 5: "hangs", 7: "aborts", 8: "leaves", 11: "ignores the end"}


def abort():
    """End as a crash does, without a page of stacks in the output of the tests."""
    faulthandler.disable()
    os.abort()


def case(number):
    note(f"case {number}")
    match WHAT.get(number):
        case "raises":
            raise ValueError("seven")
        case "hangs":
            time.sleep(600)
        case "aborts":
            abort()
        case "leaves":
            os._exit(0)
    return Outcome(EQUAL, f"case {number}")


def test_every_case_has_one_outcome_and_those_that_end_their_process_are_named():
    cases = run_cases(case, range(20), jobs=2, limit=3.0, prepare=lambda: None)
    found = dict(cases)
    assert sorted(found) == list(range(20))
    assert Counter(o.category for o in found.values()) == {
        EQUAL: 16,
        TRACEBACK: 1,
        HANG: 1,
        CRASH: 2,
    }
    assert "ValueError: seven" in found[3].said
    assert (found[5].category, found[5].what) == (HANG, "case 5")
    assert (found[7].what, found[7].said) == ("case 7", "its process ended: SIGABRT")
    assert (found[8].what, found[8].said) == ("case 8", "its process ended: code 0")


def test_what_a_case_leaves_running_is_ended_with_its_process():
    told, tell = os.pipe()

    def leave(number):
        if (child := os.fork()) == 0:
            time.sleep(600)
        os.write(tell, child.to_bytes(4, "little"))
        abort()

    ((_, found),) = run_cases(leave, [0], jobs=1, limit=30.0, prepare=lambda: None)
    assert found.category == CRASH
    child = int.from_bytes(os.read(told, 4), "little")
    assert all_end([child])


def test_a_child_s_exit_code_and_output_are_those_of_its_job(tmp_path):
    def job():
        print("seven")
        return 7

    assert wait(start(job, tmp_path / "log"), 30.0) == 7
    assert (tmp_path / "log").read_text() == "seven\n"

    def fail():
        raise ValueError("eight")

    assert wait(start(fail, tmp_path / "log"), 30.0) == 70
    assert "ValueError: eight" in (tmp_path / "log").read_text()


def test_a_group_that_does_not_end_by_itself_is_noticed():
    def job():
        if os.fork() == 0:
            time.sleep(600)

    pid = start(job)
    assert wait(pid, 30.0) == 0
    assert not group_is_gone(pid, 0.2)
    kill_group(pid)
    assert group_is_gone(pid)
