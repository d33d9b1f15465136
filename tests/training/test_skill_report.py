"""What evaluation reports of each skill: by hand, and against one environment in plain Python."""

from collections import Counter as Tally, defaultdict
from dataclasses import replace

import numpy as np
import pytest
from gymnasium.spaces import Discrete
from reference_calls import (
    POSITION,
    TAG,
    Counter,
    Left,
    Right,
    Scalar,
    T,
    Walk,
    Zigzag,
    scripted,
    shy,
)
from toys import skills_of

from skillweave import EnvSpec, Skill, evaluate
from skillweave.errors import RunError
from skillweave.hierarchy.policy import HierarchyPolicy, SkillAlone
from skillweave.schema import fit
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.skills.skill_set import SkillSet
from skillweave.training.evaluation import FIRST_SEED
from skillweave.training.skill_report import (
    SkillReport,
    hints,
    idle_calls,
    skill_rows,
    skill_table,
    useless_skills,
)

# A walk shows the number of its episode. Selectors here also choose skills that may not start.
pytestmark = pytest.mark.filterwarnings(
    "ignore:.*(starts another episode|two resets|action mask forbids)"
)
NONE = {"own": 0, "limit": 0, "interrupted": 0, "episode": 0}


class Paid(Left):
    """Three steps; its reward tells the time that it counts, and whether its limit is reached."""

    name = "paid"

    def reward(self, step):
        return step.elapsed + 100.0 * step.timed_out

    def success(self, step):
        return step.next_obs[:, POSITION] < -2


class Lucky(Counter):
    """Stops by its own; the last step counts."""

    name = "lucky"

    def success(self, step):
        return step.reward > 0


def wish(obs, count):
    return (obs[:, TAG] + 5 * obs[:, T] + 7 * obs[:, POSITION]).astype(np.int64) % count


def chooser(count):
    return ScriptedPolicy(lambda obs: wish(obs, count), Walk.observation_space, Discrete(count))


def woven(*kinds, call_steps=4, **more):
    skills = tuple(k() for k in kinds)
    policies = tuple(s.policy for s in skills)
    whole = SkillSet(skills, policies, call_steps=call_steps, **more)
    return HierarchyPolicy(chooser(len(skills)), whole)


class Steady(Skill):
    """Only its own termination ends it."""

    policy = scripted(2)

    def termination(self, step):
        return step.next_obs[:, POSITION] >= 2

    def success(self, step):
        return step.reward > 0


KINDS = (Paid, Lucky, Zigzag, Steady)


def reference(kinds, episodes, call_steps, reflexes):
    """The same, one environment and one call after the other, from what a call means."""
    skills = tuple(k() for k in kinds)
    found = {s.name: defaultdict(list) for s in skills}
    for e in range(episodes):
        one = Scalar(Walk(), skills, call_steps, reflexes, FIRST_SEED + e)
        while not one.over:
            i = int(wish(one.obs[None], len(skills))[0])
            steps = one.call(i)
            skill, told, last = skills[i], found[skills[i].name], steps[-1]
            own = bool(skill.termination(last)[0])
            told["ended"].append("own" if own else "episode" if one.over else "limit")
            told["both"].append(own and one.over)
            told["steps"].append(len(steps))
            told["success"].append(bool(skill.success(last)[0]))
            told["return"].append(sum(float(np.float32(skill.reward(s)[0])) for s in steps))
    return found


@pytest.mark.parametrize("reflexes", [(), (shy(),)], ids=["", "reflex"])
@pytest.mark.parametrize(("call_steps", "num_envs"), [(4, 7), (4, 1), (None, 40)])
def test_reports_are_those_of_calls_played_one_after_another(call_steps, num_envs, reflexes):
    kinds = KINDS if call_steps else (Paid, Lucky, Steady)
    policy = woven(*kinds, call_steps=call_steps, reflexes=reflexes)
    found = evaluate(policy, EnvSpec(Walk), episodes=40, num_envs=num_envs)
    wanted = reference(kinds, 40, call_steps, reflexes)
    seen = Tally()
    for name, report in found.skills.items():
        told = wanted[name]
        assert (report.steps, report.calls) == (sum(told["steps"]), len(told["steps"]))
        assert report.ended == NONE | Tally(told["ended"])
        assert report.own_with_episode == sum(told["both"])
        defines = name in ("paid", "lucky", "steady")
        assert report.succeeded == (sum(told["success"]) if defines else None)
        assert report.return_sum == pytest.approx(sum(told["return"]), rel=1e-6, abs=1e-4)
        seen.update(told["ended"])
    assert min(seen[end] for end in ("own", "limit", "episode")) > 5, "the case is too tame"


class Endless(Walk):
    """Pays 1, and nothing ends it."""

    def reset(self, **how):
        obs, info = super().reset(**how)
        self.length = 10**9
        return obs, info

    def step(self, action):
        obs, _, *rest = super().step(action)
        return obs, 1.0, *rest


@pytest.mark.parametrize(("limit", "cut"), [(7, 1), (6, 0)])
def test_by_hand_a_call_that_the_step_limit_cuts_ends_with_the_episode(limit, cut):
    # calls of 3 steps pay 1 + 2 + (3 + 100); a call of one step pays 1
    skills = (Paid(), Zigzag())
    always = ScriptedPolicy(
        lambda obs: np.zeros(len(obs), int), Walk.observation_space, Discrete(2)
    )
    policy = HierarchyPolicy(always, skills_of(*skills))
    found = evaluate(policy, EnvSpec(Endless), episodes=2, max_steps=limit)
    calls = 2 * (2 + cut)
    ended = NONE | {"limit": 4, "episode": 2 * cut}
    # it is 3 left of the start after the first call, and ever further
    paid = SkillReport(2 * limit, calls, ended, calls, 2 * (2 * 106.0 + cut))
    assert found.skills == {"paid": paid, "zigzag": SkillReport(0, 0, NONE, None, 0.0)}
    assert found.to_json()["skills"] == {
        "paid": {
            "share": 1.0, "steps": 2 * limit, "calls": calls, "length_mean": 2 * limit / calls,
            "ended": ended, "success_rate": 1.0, "return_mean": paid.return_sum / calls,
        },
        "zigzag": {
            "share": 0.0, "steps": 0, "calls": 0, "length_mean": None, "ended": NONE,
            "success_rate": None, "return_mean": None,
        },
    }  # fmt: skip
    assert found.cut == 2


def test_the_table_for_people():
    ended = NONE | {"own": 1, "limit": 3}
    some = {
        "go": SkillReport(3_000, 1_200, ended | {"own": 300, "limit": 900}, 600, -1_800.0),
        "stand": SkillReport(1_000, 0, NONE, None, 0.0),
    }
    assert skill_table(some).splitlines() == [
        "skill  share  calls  length  own  limit  interrupted  episode  success  return",
        "go       75%  1,200     2.5  25%    75%           0%       0%      50%    -1.5",
        "stand    25%      0       -    -      -            -        -        -       -",
    ]
    both = replace(some["go"], own_with_episode=120)
    assert skill_rows({"go": both})[0]["ends"][0] == "25% (10% last step)"


class Far(Steady):
    """Goes to 4."""

    name = "far"

    def termination(self, step):
        return step.next_obs[:, POSITION] >= 4


class Move(Steady):
    """One step is all that it does."""

    name = "move"

    def termination(self, step):
        return np.ones(len(step.reward), bool)


def told(choose, *kinds, call_steps=50):
    skills = tuple(k() for k in kinds)
    whole = skills_of(*skills, call_steps=call_steps)
    selector = ScriptedPolicy(choose, Walk.observation_space, Discrete(len(kinds)))
    policy = HierarchyPolicy(selector, whole)
    return policy, evaluate(policy, EnvSpec(Walk), episodes=20)


class AtOnce(Far):
    """Its termination is always true, so that it never gets to 4."""

    name = "at_once"

    def termination(self, step):
        return np.ones(len(step.reward), bool)

    def success(self, step):
        return step.next_obs[:, POSITION] >= 4


class Nod(AtOnce):
    """One step is all that it does, and it has no success."""

    name = "nod"
    success = Skill.success


def test_a_termination_that_is_always_true_is_told_and_moves_of_one_step_are_right():
    found = told(by_turns, AtOnce, Left)[1]
    calls = found.skills["at_once"].calls
    sentence = (
        f"Every call of 'at_once' ({calls:,}) ended after one step: its termination() is true "
        "there. If that is so everywhere, its condition is wrong, and no call can do more."
    )
    assert sentence in found.for_people().splitlines()
    assert useless_skills(found.skills, 20, selector_learns=True)[0] == sentence
    for kind in (Move, Nod, Far):
        right = told(by_turns, kind, Left)[1]
        assert "ended after one step: its termination" not in right.for_people()


def test_episodes_in_which_a_skill_never_began_are_counted():
    class Later(Far):
        def initiation(self, obs):
            return (obs[:, TAG] % 2 == 0) & (obs[:, T] == 0)

    found = evaluate(SkillAlone(skills_of(Later()), "later"), EnvSpec(Walk), episodes=20)
    began = found.skills["later"].calls
    assert 0 < began < 20
    assert f"in {20 - began} of 20 episodes it never began, as its initiation() was False" in (
        str(found)
    )
    always = evaluate(SkillAlone(skills_of(Far()), "far"), EnvSpec(Walk), episodes=20)
    assert "never began" not in str(always)


def first(obs):
    return np.zeros(len(obs), np.int64)


def until_it_is_there(obs):
    return (obs[:, POSITION] >= 4).astype(np.int64)


def until_there_and_once_more(obs):
    return (obs[:, T] >= 5).astype(np.int64)


def by_turns(obs):
    return obs[:, T].astype(np.int64) % 2


@pytest.mark.parametrize("call_steps", [50, 3])
def test_a_skill_that_is_called_where_its_work_is_done_is_told(call_steps):
    found = told(first, Far, Left, call_steps=call_steps)[1]
    far = found.skills["far"]
    # Four steps, the fourth perhaps in a call of its own, which a limit made necessary. Then one
    # call for each step.
    before = [1 + (call_steps == 3 and n > 3) for n in found.lengths]
    assert far.calls == sum(k + max(0, n - 4) for k, n in zip(before, found.lengths, strict=True))
    assert far.idle == sum(max(0, n - 4) for n in found.lengths) > far.calls / 2
    if call_steps == 3:
        return  # its other calls are about as short
    assert found.for_people().splitlines()[-1] == (
        f"{far.idle:,} of {far.calls:,} calls of 'far' ended after one step, right after a call of "
        "it had ended. If its work is done there, let its initiation() be False there; some other "
        "skill must be able to start."
    )


@pytest.mark.parametrize(
    ("choose", "kinds", "call_steps"),
    [
        (until_it_is_there, (Far, Left), 50),
        (until_there_and_once_more, (Far, Left), 50),
        (first, (Left, Far), 3),  # a limit ends its calls
        (first, (Left, Far), 1),
        (first, (Move, Left), 50),  # as all its calls
    ],
)
def test_calls_that_end_otherwise_are_not_told(choose, kinds, call_steps):
    found = told(choose, *kinds, call_steps=call_steps)[1]
    assert found.for_people() == "\n".join([str(found), skill_table(found.skills)])


def test_a_call_after_another_skill_is_not_idle_within_a_hierarchy():
    class Nested(Skill):
        policy = told(first, Far, Left)[0]
        max_steps = 1

    alone = told(first, Nested, Left)[1].skills["nested/far"]
    assert alone.calls > alone.idle > 20
    mixed = told(by_turns, Nested, Right)[1].skills["nested/far"]
    assert mixed.calls > 20
    assert mixed.idle == 0


class Reaching(Skill):
    """Says that it is there, and does not stop there."""

    policy = scripted(2)

    def success(self, step):
        return step.next_obs[:, POSITION] >= 4


class Away(Reaching):
    """Succeeds far away only."""

    def success(self, step):
        return step.next_obs[:, POSITION] >= 9


class Stopping(Reaching):
    termination = Reaching.success


class Failing(Reaching):
    def termination(self, step):
        return step.next_obs[:, POSITION] < -99


class Passing(Reaching):
    """Has succeeded in its fifth step only."""

    def success(self, step):
        return step.next_obs[:, POSITION] == 5


class Lasting(Reaching):
    max_steps = 6


class Called(Reaching):
    call_steps = 6


def test_a_skill_that_does_not_stop_where_it_has_succeeded_is_told():
    found = told(first, Reaching, Left, call_steps=6)[1]
    there = found.skills["reaching"]
    # Where the episode ends with the sixth step, that is why the call ended.
    assert there.late == sum((n - 1) // 6 for n in found.lengths) > there.calls / 4
    assert found.for_people().splitlines()[-1] == (
        f"{there.late:,} of {there.calls:,} calls of 'reaching' went on to their limit after they "
        "had succeeded. If its work is done then, let its termination() be True where success() "
        "is; if it is meant to last, give it max_steps."
    )


@pytest.mark.parametrize("kind", [Stopping, Failing, Lasting, Called, Passing])
def test_a_skill_that_says_when_it_stops_or_has_not_succeeded_then_is_not_told(kind):
    choose = first if kind is Passing else until_it_is_there
    found = told(choose, kind, Left, call_steps=6)[1]
    assert found.skills[kind.name].late == 0
    assert found.for_people() == "\n".join([str(found), skill_table(found.skills)])


@pytest.mark.parametrize("call_steps", [1, 3, 4])
def test_calls_that_succeed_with_their_last_step_are_not_late(call_steps):
    found = told(first, Reaching, Left, call_steps=call_steps)[1]
    ends = [e for n in found.lengths for e in range(call_steps, n, call_steps)]
    # It is there with the fourth step, so calls that end with a later one had been there before.
    late = sum(e > 4 for e in ends) if call_steps > 1 else 0
    assert found.skills["reaching"].late == late
    assert len(ends) > late


def test_a_few_late_calls_are_not_told():
    found = told(first, Away, Left, call_steps=2)[1]
    assert 4 * found.skills["away"].late < found.skills["away"].calls
    assert found.skills["away"].late > 0
    assert found.for_people() == "\n".join([str(found), skill_table(found.skills)])


def test_a_hierarchy_that_stops_as_nobody_may_start_is_not_late():
    class Nested(Skill):
        policy = woven(Right, call_steps=None)
        initiation = Right.initiation

        def success(self, step):
            return step.next_obs[:, POSITION] >= 0

    def choose(obs):
        return (obs[:, POSITION] >= 2).astype(np.int64)

    found = told(choose, Nested, Left, call_steps=1_000)[1].skills["nested"]
    assert found.succeeded == found.calls > found.ended["limit"] > 10
    assert found.late == 0


def test_a_hierarchy_as_a_skill_has_a_report_and_so_have_its_own_skills():
    inner = woven(Paid, Lucky, Zigzag)

    class Nested(Skill):
        max_steps = 5
        policy = inner

        def reward(self, step):
            return np.full(len(step.reward), 2.0)

    outer = woven(Nested, Right, call_steps=None)
    found = evaluate(outer, EnvSpec(Walk), episodes=20).skills
    assert list(found) == ["nested", "nested/paid", "nested/lucky", "nested/zigzag", "right"]
    below = [found[f"nested/{name}"] for name in inner.labels]
    assert sum(x.steps for x in below) == found["nested"].steps
    for report in below:
        assert sum(report.ended.values()) == report.calls
    assert sum(report.calls for report in below) > 20
    assert found["nested"].return_sum == 2.0 * found["nested"].steps > 0
    assert sum(found["nested"].ended.values()) == found["nested"].calls
    alone = evaluate(SkillAlone(outer.skills, "nested"), EnvSpec(Walk), episodes=20)
    bare = evaluate(inner, EnvSpec(Walk), episodes=20)
    assert (alone.returns, alone.lengths) == (bare.returns, bare.lengths)
    assert list(alone.skills) == ["nested", "nested/paid", "nested/lucky", "nested/zigzag"]
    report, *below = alone.skills.values()
    assert report.calls == 20 > report.ended["episode"]
    assert report.return_sum == 2.0 * report.steps == 2.0 * sum(x.steps for x in below)
    for own in below:
        assert sum(own.ended.values()) == own.calls


def test_reports_of_inner_skills_agree_with_the_log_of_their_calls():
    class Nested(Skill):
        max_steps = 5
        policy = woven(*KINDS)

    outer = woven(Nested, Reaching, Left)
    found = evaluate(outer, EnvSpec(Walk), episodes=40, log_calls=True)
    assert any(log.succeeded[log.end_reason == 2].any() for log in found.inner_calls.values())
    for path, log in {"": found.calls, **found.inner_calls}.items():
        for name in log.skills:
            report, own = found.skills[f"{path}/{name}".strip("/")], log.of(name)
            assert (report.calls, report.steps, report.ended) == (len(own), own.steps, own.reasons)
            assert report.succeeded in (None, own.succeeded.sum())


def test_calls_below_a_skill_alone_count_from_where_it_may_start():
    class Later(Skill):
        policy = woven(Right, Left, call_steps=9)

        def initiation(self, obs):
            return obs[:, T] >= 2

    skills = woven(Later, Zigzag).skills
    report, *below = evaluate(
        SkillAlone(skills, "later"), EnvSpec(Walk), episodes=20
    ).skills.values()
    assert report.calls > 10
    assert sum(one.steps for one in below) == report.steps
    assert sum(one.first for one in below) == report.calls
    for own in below:
        assert sum(own.ended.values()) == own.calls


class Labelled(ScriptedPolicy):
    """Names skills, but has no declarations of them."""

    labels = ("low", "high")

    def acting(self, memory):
        return np.ones(len(next(iter(memory.values()))), np.int64)

    def start(self, n):
        return {"elapsed": np.zeros(n, np.int64)}

    def observe(self, memory, step):
        return {"elapsed": (memory["elapsed"] + 1) % 2}


def test_of_a_policy_that_is_no_hierarchy_only_steps_and_calls_are_known():
    policy = Labelled(scripted(1).function, Walk.observation_space, Walk.action_space)
    found = evaluate(policy, EnvSpec(Walk), episodes=3)
    calls = sum((n + 1) // 2 for n in found.lengths)
    high = SkillReport(sum(found.lengths), calls, {}, None, None)
    assert found.skills == {"low": SkillReport(0, 0, {}, None, None), "high": high}
    assert (high.success_rate, high.return_mean) == (None, None)
    assert " - " in found.for_people()
    plain = evaluate(scripted(1), EnvSpec(Walk), episodes=3)
    told = plain.to_json()
    assert (plain.skills, plain.skill_steps, plain.skill_calls) == ({}, {}, {})
    assert (told["skills"], told["skill_usage"]) == ({}, {})
    assert plain.for_people() == str(plain)
    assert "skills" not in str(plain)


class Fleeing(Skill):
    """Ends at once, and each step costs."""

    policy = scripted(2)
    ends, pay, won = 1, -1.0, False

    def reward(self, step):
        return np.full(len(step.reward), self.pay)

    def termination(self, step):
        return step.elapsed >= self.ends

    def success(self, step):
        return np.full(len(step.reward), self.won)


class Slower(Fleeing):
    ends = 2


class Silent(Skill):
    """Does not say what success is."""

    policy = scripted(2)
    reward, termination = Fleeing.reward, Fleeing.termination
    ends, pay = 1, -1.0


class Lingering(Fleeing):
    ends = 3


class Sometimes(Fleeing):
    """Ends at once in a quarter of the environments."""

    def termination(self, step):
        return step.elapsed >= np.where(step.obs[:, TAG] % 4 == 0, 1, 3)


class Paying(Fleeing):
    pay = 0.0


class Winning(Fleeing):
    won = True


@pytest.mark.parametrize("kind", [Fleeing, Slower, Silent])
def test_a_skill_for_which_it_is_best_to_end_at_once_is_told(kind):
    name = kind.__name__.lower()
    found = told(by_turns, kind, Left)[1]
    there = found.skills[name]
    # In an episode's last step it has no choice.
    assert there.hasty == there.ended["own"] - there.own_with_episode > there.calls / 2
    failed = "" if kind is Silent else ", without success"
    sentence = (
        f"{there.hasty:,} of {there.calls:,} calls of {name!r} ended by its termination() within "
        f"two steps{failed}, and their last reward was below 0. Let success alone end it. If it "
        "was called where its work was done, let its initiation() be False there."
    )
    assert sentence in found.for_people().splitlines()


def test_hasty_calls_within_a_hierarchy_are_counted():
    class Nested(Skill):
        policy = told(by_turns, Slower, Left)[0]

    there = told(by_turns, Nested, Left)[1].skills["nested/slower"]
    assert there.calls >= there.hasty > 0


@pytest.mark.parametrize("kind", [Lingering, Paying, Winning, Sometimes])
def test_calls_that_last_or_pay_are_not_hasty_and_less_than_half_of_them_not_told(kind):
    found = told(by_turns, kind, Left)[1]
    there = found.skills[kind.__name__.lower()]
    assert (there.hasty > 0) == (kind is Sometimes)
    assert 2 * there.hasty < there.calls
    assert "within two steps" not in found.for_people()


@pytest.mark.parametrize("selector_learns", [True, False])
@pytest.mark.parametrize("learns", [True, False])
@pytest.mark.parametrize("has_goals", [True, False])
def test_only_remedies_that_the_declaration_has_are_named(selector_learns, learns, has_goals):
    bad = SkillReport(9_000, 99, {}, 0, None, idle=90, hasty=90, learns=learns, has_goals=has_goals)
    uncalled = SkillReport(0, 0, {}, 0, None, learns=learns, has_goals=has_goals)
    text = " ".join(hints({"a": bad, "b": uncalled}))
    assert ("initiation()" in text) == (not has_goals)
    assert ("pay for success" in text) == learns
    assert "initiation()" not in " ".join(idle_calls({"a": bad}))  # no other skill could start
    text = " ".join(useless_skills({"a": bad, "b": uncalled}, 9, selector_learns=selector_learns))
    assert ("give it more steps" in text) == ("a reward that" in text) == learns
    assert ("Residual" in text) == ("learn=True" in text) == (not learns)
    assert ("epsilon_final" in text) == selector_learns


def test_moves_that_have_no_reward_of_their_own_are_not_hasty():
    there = told(by_turns, Move, Left)[1].skills["move"]
    assert there.calls > 20 > 0 > there.return_sum  # the environment's
    assert there.hasty == 0


def test_a_file_with_other_ends_of_calls_is_refused() -> None:
    ends = {"own": 2, "limit": 0, "interrupted": 0, "episode": 1}
    data = {"steps": 9, "calls": 3, "succeeded": None, "return_sum": None}
    for right in (ends, {}):
        assert fit(SkillReport, data | {"ended": right}, "evaluation.json").ended == right
    for wrong in ({"own": 3}, ends | {"other": 0}, ends | {"own": -1}):
        with pytest.raises(RunError, match=r"evaluation\.json: ended"):
            fit(SkillReport, data | {"ended": wrong}, "evaluation.json")
