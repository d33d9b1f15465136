"""A sweep on Ray: nodes that do not fit are told, and so is what became of a run."""

import json
import platform
from importlib import metadata

import pytest
from sweep_recipes import DYING_RECIPE, RECIPE

from skillweave.cli import main, sweep

ray = pytest.importorskip("ray")

from skillweave.workers import actor_host  # noqa: E402

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::FutureWarning"),
]
SKILLWEAVE, PYTHON = metadata.version("skillweave"), platform.python_version()


@pytest.fixture(scope="module", autouse=True)
def cluster():
    how = {"include_dashboard": False, "logging_level": "ERROR", "log_to_driver": False}
    ray.init("local", num_cpus=1, **how)
    yield
    ray.shutdown()


@pytest.fixture
def words(tmp_path):
    (tmp_path / "still.py").write_text(RECIPE)
    start = ["sweep", str(tmp_path / "still.py"), "--out", str(tmp_path / "runs"), "--ray"]
    return [*start, "--seeds", "0:1", "--jobs", "1", "--evaluate", "3", "--json", "--quiet"]


def answer(capsys, words):
    code = main(words)
    # Where other tests have imported Ray already, it writes of lost processes before the answer.
    return code, json.loads(capsys.readouterr().out.splitlines()[-1])


def let_nodes_have(monkeypatch, skillweave, python):
    """Let nodes tell of these versions."""

    def actor_class():
        class Other:
            def versions(self):
                return {"node": "10.0.0.7", "Skillweave": skillweave, "Python": python}

        return Other

    monkeypatch.setattr(actor_host, "actor_class", actor_class)


@pytest.mark.parametrize(
    ("skillweave", "python", "says"),
    [
        ("0.0.1", PYTHON, f"has Skillweave 0.0.1, but here is {SKILLWEAVE}"),
        (None, PYTHON, "has no Skillweave: install the same version"),
        (SKILLWEAVE, "3.2.1", f"has Python 3.2.1, but here is {PYTHON}"),
    ],
)
def test_a_node_of_another_version_ends_a_sweep_before_anything_is_trained(
    monkeypatch, capsys, words, tmp_path, skillweave, python, says
):
    let_nodes_have(monkeypatch, skillweave, python)
    assert main(words) == 1
    assert f"node 10.0.0.7 of the Ray cluster {says}" in capsys.readouterr().err
    assert not (tmp_path / "runs/s0").exists()


def test_a_python_that_differs_in_its_last_digit_will_do(monkeypatch, capsys, words):
    let_nodes_have(monkeypatch, SKILLWEAVE, PYTHON.rpartition(".")[0] + ".99")
    code, found = answer(capsys, words)
    assert (code, [run["seed"] for run in found["runs"]]) == (0, [0]), found["failed"]


def test_a_run_whose_process_is_lost_is_named_and_the_others_are_trained(
    monkeypatch, capsys, words, tmp_path
):
    (tmp_path / "still.py").write_text(DYING_RECIPE)
    monkeypatch.setattr(sweep, "RETRIES", 0)
    code, found = answer(capsys, [w.replace("0:1", "0:2") for w in words])
    assert (code, [run["seed"] for run in found["runs"]]) == (1, [1]), found["failed"]
    assert found["failed"][0]["run"].endswith("s0")
    assert "lost repeatedly: WorkerCrashedError" in found["failed"][0]["error"]


def test_other_errors_of_ray_are_told_as_they_are(monkeypatch, capsys, words):
    def full(ref):
        raise ray.exceptions.OutOfDiskError("no room for a result")

    monkeypatch.setattr(ray, "get", full)
    code, found = answer(capsys, words)
    assert code == 1
    error = found["failed"][0]["error"]
    assert "no room for a result" in error
    assert "lost" not in error
