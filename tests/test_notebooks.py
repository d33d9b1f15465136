"""What objects show in a notebook: tables of escaped text, a film, progress that leaves a table."""

from __future__ import annotations

import base64
import json
import os
import sys
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_runs import stage_entry

from skillweave import PPO, Agent, Hierarchy, Network, Run, Skill, tree
from skillweave._internal import notebooks as module
from skillweave._internal.notebooks import facts, in_notebook, joined, table
from skillweave.reporting.progress import EpisodeProgress, Progress
from skillweave.reporting.video import Film
from skillweave.types import Evaluation

TINY = PPO(num_envs=2, n_steps=16, batch_size=32, update_epochs=1, network=Network(hidden=(8,)))


class Center(Skill):
    """Keeps the cart in <b>the middle</b> & upright."""

    max_steps = 20

    def reward(self, step):
        return 1.0 - abs(step.next_obs[:, 0])


class Idle(Skill):
    def policy(self, obs):
        return np.zeros(len(obs), int)


class Well(HTMLParser):
    """Reads HTML, and sees what is not closed, and what is loaded from elsewhere."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.words: list[str] = []
        self.sources: list[str] = []
        self.tags: set[str] = set()
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.tags.add(tag)
        if tag != "img":
            self.open.append(tag)
        told = dict(attrs)
        self.sources += [told[k] for k in ("src", "href") if k in told]
        assert "color" not in told.get("style", ""), "the notebook's own colours"

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def read(thing: Any) -> Well:
    found = Well(thing._repr_html_())
    assert found.tags <= {"div", "table", "thead", "tbody", "tr", "th", "td", "b", "p", "img"}
    assert all(source.startswith("data:") for source in found.sources)
    return found


def hierarchy(**how: Any) -> Hierarchy:
    return Hierarchy("CartPole-v1", [Center(), Idle()], algorithm=TINY, selector=TINY, **how)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return hierarchy(steps=200).train(tmp_path_factory.mktemp("runs") / "run", quiet=True)


def test_a_skill_and_an_agent_tell_what_they_declare_and_all_is_escaped():
    text = table(["<a>"], [["<script>alert(1)</script>", 3], ['"&', None]])
    assert "<script>" not in text
    assert "&lt;script&gt;" in text
    assert "&quot;&amp;" in text
    assert Well(joined([text, facts([("<x>", "<y>")])])).words[0] == "<a>"
    agent = Agent("CartPole-v1", TINY, 3_000)
    assert repr(agent) == "<Agent of PPO on CartPole-v1>"
    assert "3,000" in read(agent).words
    assert repr(Center()) == "<Skill 'center': reward, max_steps=20>"
    assert repr(Skill()) == "<Skill '': all defaults>"
    assert repr(Idle()).startswith("<Skill 'idle': policy=")
    words = read(Center()).words
    assert "Keeps the cart in <b>the middle</b> & upright." in words
    assert words[-2:] == ["max_steps", "20"]


def test_a_hierarchy_tells_its_skills_at_all_levels():
    inner = hierarchy(name="inner")
    outer = Hierarchy("CartPole-v1", [inner, Center()], selector=tree.Sequence("inner", "center"))
    assert repr(inner) == "<Hierarchy of center, idle on CartPole-v1>"
    words = read(outer).words
    assert {"inner", "inner/center", "inner/idle", "center", "ready: Sequence"} <= set(words)
    at = words.index("inner/idle")
    assert words[at + 1] == "ready"
    assert words[words.index("inner") + 1] == "hierarchy"


def test_a_run_tells_its_stages_and_its_evaluation_damaged_or_gone_or_without_code(run, tmp_path):
    assert repr(run) == f"<Run {run.path}: Hierarchy of center, idle on CartPole-v1>"
    assert "evaluation" not in "".join(read(run).words)
    run.evaluate(2, save=True)
    words = read(run).words
    assert {str(run.path), "center", "idle", "together", "done"} <= set(words)
    assert words[-1].startswith("evaluation: ")
    gone = Run(run.declaration, tmp_path / "gone", run.policy)
    assert "center" in read(gone).words
    (tmp_path / "run.json").write_text("{")
    assert "run.json" in read(Run(run.declaration, tmp_path, run.policy)).words[-1]
    again = Hierarchy.from_manifest({**run.info(), "needs_recipe": False})
    assert "learnt" in read(again).words


def test_an_evaluation_is_a_line_and_a_table_of_its_skills(run):
    plain = Evaluation((1.0, 2.0), (3, 4), None)
    assert repr(plain) == f"<Evaluation: {plain}>"
    assert read(plain).words == [str(plain)]
    found = run.evaluate(2)
    words = read(found).words
    assert words[0] == str(found)
    assert words[1:4] == ["skill", "share", "calls"]
    assert {"center", "idle"} <= set(words)


def test_render_without_a_path_writes_into_the_run_and_shows_the_film(run):
    pytest.importorskip("PIL")
    film = run.render(max_steps=5)
    assert film["path"] == str(run.path / "film.gif")
    assert isinstance(film, dict)
    assert json.loads(json.dumps(film)) == film
    assert repr(film).startswith(f"<Film {film['path']}: {film['frames']} frames, return ")
    (source,) = read(film).sources
    head, _, data = source.partition(",")
    assert head == "data:image/gif;base64"
    assert base64.b64decode(data) == Path(film["path"]).read_bytes()
    assert run.render(skill="idle", max_steps=5)["path"] == str(run.path / "film-idle.gif")


def test_render_of_a_weights_file_writes_here(run, tmp_path, monkeypatch):
    pytest.importorskip("PIL")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "elsewhere").mkdir()
    path = run.save_weights(tmp_path / "elsewhere" / "cart.safetensors")
    assert hierarchy().load_weights(path).render(max_steps=5)["path"] == "cart.gif"
    assert (tmp_path / "cart.gif").exists()


def test_an_mp4_is_a_video_and_a_film_that_is_gone_is_told(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"film")
    film = Film(path=str(tmp_path / "a.mp4"), frames=3, episodes=[{"return": 1.0}])
    assert f"data:video/mp4;base64,{base64.b64encode(b'film').decode()}" in film._repr_html_()
    (tmp_path / "a.mp4").unlink()
    assert "cannot be read" in film._repr_html_()


# A notebook as a user writes one


EXAMPLE = Path(__file__).parents[1] / "examples" / "notebook.ipynb"


BRIEFLY = {
    "STEPS = 120_000": """STEPS = 4_096
from skillweave.hierarchy import select_best
select_best.MOST = 4""",
    "run.evaluate(50)": "run.evaluate(5)",
    "run.render(episodes=2)": "run.render(max_steps=20)",
}
"""What takes long in the example, and what the test does instead."""


@pytest.fixture
def outputs(tmp_path_factory: pytest.TempPathFactory) -> list[list[Any]]:
    """What each cell of code of the example shows, with few steps."""
    client = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    nbformat = pytest.importorskip("nbformat")
    notebook = nbformat.read(EXAMPLE, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "clear all outputs, then save"
    for cell in notebook.cells:
        for long, brief in BRIEFLY.items():
            cell.source = cell.source.replace(long, brief)
    text = "".join(cell.source for cell in notebook.cells)
    assert all(brief in text for brief in BRIEFLY.values())
    path = os.pathsep.join(filter(None, (str(EXAMPLE.parents[1]), os.environ.get("PYTHONPATH"))))
    folder = str(tmp_path_factory.mktemp("notebook"))
    running = client.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": folder}})
    running.execute(env=os.environ | {"PYTHONPATH": path})
    return [cell.outputs for cell in notebook.cells if cell.cell_type == "code"]


@pytest.mark.slow
def test_the_example_shows_tables_films_and_its_last_progress_and_nothing_raw(outputs):
    shown = [output for cell in outputs for output in cell]
    assert {output.output_type for output in shown} == {"execute_result", "display_data"}
    for output in shown:
        assert "text/html" in output.data
        assert " at 0x" not in output.data["text/plain"]
        assert "<script" not in output.data["text/html"]
    results = {
        output.data["text/plain"].split()[0]: output.data["text/html"]
        for output in shown
        if output.output_type == "execute_result"
    }
    assert set(results) == {"<Hierarchy", "<Run", "<Evaluation:", "<Film"}
    assert all("<table>" in results[k] for k in ("<Hierarchy", "<Run", "<Evaluation:"))
    assert "data:image/gif;base64,R0lGOD" in results["<Film"]
    html = outputs[2][0].data["text/html"]
    assert "<progress" in html
    assert "done in" in html
    assert "get_key" in html


# Progress


class Kernel:
    """Stands in for IPython in a notebook: keeps what is displayed."""

    def __init__(self) -> None:
        self.outputs: list[dict[str, str]] = []
        self.updates = 0

    def display(self, data: dict[str, str], *, raw: bool, display_id: bool) -> Any:
        assert raw
        assert display_id
        place = len(self.outputs)
        self.outputs.append(data)

        def update(data: dict[str, str], *, raw: bool) -> None:
            self.updates += 1
            self.outputs[place] = data

        return SimpleNamespace(update=update)


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Kernel:
    kernel = Kernel()
    shell = SimpleNamespace(kernel=kernel)
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(display=kernel.display))
    return kernel


def test_a_notebook_is_told_from_a_terminal(monkeypatch, kernel):
    assert in_notebook()
    terminal = SimpleNamespace(get_ipython=SimpleNamespace)
    monkeypatch.setitem(sys.modules, "IPython", terminal)
    assert not module.in_notebook()
    monkeypatch.delitem(sys.modules, "IPython")
    assert not module.in_notebook()


def test_progress_in_a_notebook_leaves_one_table(kernel, capsys):
    names = ["left", "right"]
    with Progress() as progress:
        progress.plan([stage_entry(name, "waiting", budget=100) for name in names])
        for name in names:
            progress.stage(name, 100)
            progress.tick(name, 50, 0.5, {"return": 1.0})
            progress.done(name, 100, 1.0, {"return": 2.0, "inner.usage": 0.25})
        progress.message("a <message>")
    assert capsys.readouterr().err == ""
    (output,) = kernel.outputs
    words = Well(output["text/html"]).words
    assert [w for w in words if w in ("in all", *names)] == ["in all", *names]
    assert "stage 2 of 2" in words
    assert "done in 0:02" in words
    assert words[-1] == "a <message>"
    line = "left 100% 0.1k/0.1k return 2.0 100 steps/s done in 0:01"
    assert line in output["text/plain"].splitlines()


def test_an_evaluation_in_a_notebook_leaves_nothing_but_its_result(kernel, monkeypatch):
    from skillweave.reporting import progress as timed

    now = iter([0.0, 2.0, 4.0])
    monkeypatch.setattr(timed, "time", SimpleNamespace(monotonic=lambda: next(now)))
    with EpisodeProgress(4) as progress:
        one = np.ones(1, int)
        played = SimpleNamespace(over=one == 1, episode=one, lasted=one)
        progress.watch(played)
        assert "1 of 4 episodes" in kernel.outputs[0]["text/html"]
        progress.watch(played)
    assert kernel.outputs == [{"text/html": "", "text/plain": ""}]
