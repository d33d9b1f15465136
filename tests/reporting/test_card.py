"""The page of a run on the hub: what it says, and that nothing in it is read as code."""

from __future__ import annotations

import json
import re

import pytest
from small_runs import level_entry, small_manifest

from skillweave.reporting.card import text, write_card
from skillweave.runs.directory import RunDirectory
from skillweave.runs.manifest import SkillEntry, StageEntry
from skillweave.skills.foreign_policy import Source
from skillweave.training.evaluation import Evaluation
from skillweave.training.evaluation_file import save_evaluation
from skillweave.training.skill_report import SkillReport

STAGE = StageEntry(
    "land", "skill", ["land"], None, 1000, {"algorithm": "PPO"}, None, "done",
    steps=1024, seconds=2.0, steps_per_second=512.0, final={"return": 12.5},
)  # fmt: skip


@pytest.fixture
def run(tmp_path):
    skill = SkillEntry("land", 10)
    hop = SkillEntry("hop", 5, policy=Source("onnx", file="hop.onnx"))
    manifest = small_manifest(
        STAGE,
        seed=3,
        needs_recipe=True,
        resume_needs_recipe=True,
        recipe="/home/ada/secret/my_recipe.py",
        hierarchy=level_entry(call_steps=7),
        skills=[skill, hop],
    )
    return RunDirectory.create(tmp_path / "run", manifest)


def card(run: RunDirectory, *films: str) -> str:
    return write_card(run, "ada/cart", films=films, figures=["figures/land.png"])


def evaluate(run: RunDirectory) -> None:
    ended = {"own": 3, "limit": 5, "interrupted": 0, "episode": 2}
    land = SkillReport(steps=30, calls=10, succeeded=4, ended=ended, return_sum=25.0)
    hop = SkillReport(steps=10, calls=2, succeeded=None, ended={}, return_sum=None)
    found = Evaluation((1.0, 3.0), (20, 20), None, {"land": land, "hop": hop})
    save_evaluation(run, found, 5, True)


def test_the_header_is_what_the_hub_reads(run):
    yaml = pytest.importorskip("yaml")
    evaluate(run)
    _, header, _ = card(run).split("---\n", 2)
    told = yaml.safe_load(header)
    assert told["library_name"] == "skillweave"
    assert told["pipeline_tag"] == "reinforcement-learning"
    assert "CartPole-v1" in told["tags"]
    ((result,),) = ([r for m in told["model-index"] for r in m["results"]],)
    assert result["dataset"] == {"name": "CartPole-v1", "type": "CartPole-v1"}
    (metric,) = result["metrics"]
    assert (metric["type"], metric["value"]) == ("mean_reward", "2.00 +/- 1.41")


def test_it_says_what_each_skill_was_measured_to_do(run):
    assert "It was not evaluated." in card(run)
    assert "model-index" not in card(run)
    evaluate(run)
    page = card(run)
    assert "over 2 episodes" in page
    assert "(greedy, seed 5)" in page
    rows = [[c.strip() for c in r.strip("|").split("|")] for r in page.splitlines() if "|" in r]
    (land,) = (r for r in rows if r[0] == "land" and len(r) == 10)
    assert land == ["land", "75 %", "10", "3.0", "30 %", "50 %", "0 %", "20 %", "40 %", "2.5"]
    (hop,) = (r for r in rows if r[0] == "hop")
    assert hop == ["hop", "25 %", "2", "5.0", "–", "–", "–", "–", "–", "–"]


def test_it_says_how_to_load_it_and_what_is_not_there(run):
    page = card(run, "a film.gif", "b.mp4")
    assert 'run = sw.from_hub("ada/cart", hierarchy)' in page
    assert "ONNX files of hop" in page
    assert "![a film](./a%20film.gif)" in page
    assert "\n[b](./b.mp4)" in page
    assert "![land](./figures/land.png)" in page
    assert "| land | PPO | 1,024 | 2.0 | 12.5 |" in page
    assert "| call\\_steps | 7 |" in page
    assert "my\\_recipe.py" in page
    assert "secret" not in page


def test_nothing_of_a_run_is_read_as_markdown_or_html(run):
    run.manifest.env_kwargs = {"x": "<script>alert(1)</script>|[a](http://b)\n# c"}
    run.manifest.env = '"\n---\n<b>'
    page = card(run)
    assert "<script" not in page
    assert "](http" not in page
    assert re.findall(r"^#+ .*", page, flags=re.M) == [
        "# cart", "## Use", "## Measured", "## Training",
    ]  # fmt: skip
    assert page.count("\n---\n") == 1  # the header's end
    assert json.loads(page.splitlines()[3].partition(": ")[2])[-1] == run.manifest.env
    assert text("a|b *c*\n<d>") == r"a\|b \*c\* &lt;d&gt;"
