"""Reports in a real browser: no errors, no network, the film follows clicks and keys, axe."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from goals.worlds import Drawn, declared
from reporting.cart import RECIPE
from reporting.walkway import CALLS, declare

from skillweave.cli import main
from skillweave.html_report.compare import write_comparison
from skillweave.html_report.film import HOLD
from skillweave.html_report.single import write_report
from skillweave.runs.directory import RunDirectory

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason="no browser here: apt-get install chromium"),
]
pytest.importorskip("vl_convert")
pytest.importorskip("imageio_ffmpeg")
playwright = pytest.importorskip("playwright.sync_api")
axe = pytest.importorskip("axe_playwright_python.sync_playwright")

EVOLVE = ("left.population=2", "left.generations=2", "left.episodes=1")


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """A report by hand, one of a run with a population, one unfinished, and a comparison."""
    folder = tmp_path_factory.mktemp("pages")
    run = declare().train(folder / "walk", quiet=True)
    names = ("walk", "evolved", "goals", "unfinished", "comparison")
    found = {k: folder / f"{k}.html" for k in names}
    run.log_calls(200, num_envs=2)
    how: dict[str, Any] = {"episodes": 5, "filmed": 2}
    opened = RunDirectory.open(folder / "walk")
    write_report(opened, found["walk"], run.policy, run.declaration.spec, **how)
    aims = declared(env=Drawn).train(folder / "goals", quiet=True)
    aims.log_calls(200, num_envs=2)
    write_report(
        RunDirectory.open(aims.path), found["goals"], aims.policy, aims.declaration.spec, episodes=2
    )
    recipe = folder / "cart.py"
    recipe.write_text(RECIPE)
    train = ["train", str(recipe), "--quiet", "--evaluate", "3", "-o"]
    evolve = [word for setting in EVOLVE for word in ("--evolve", setting)]
    assert main([*train, str(folder / "evolved"), *evolve]) == 0
    for name, words in (("a", ()), ("b", ("--seed", "1")), ("c", ("--set", "call_steps=3"))):
        assert main([*train, str(folder / name), *words]) == 0
    words = [folder / "evolved", "-o", found["evolved"], "--recipe", recipe, "--episodes", 4]
    assert main(["report", *map(str, words)]) == 0
    write_comparison([RunDirectory.open(folder / n) for n in "abc"], found["comparison"])
    stopped = RunDirectory.open(folder / "c")
    stopped.stage("selector").status = "training"
    stopped.save()
    write_report(stopped, found["unfinished"])
    return found


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as started:
        chromium = started.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        yield chromium
        chromium.close()


class Opened:
    """A page with all that its console said and all that it asked for."""

    def __init__(self, browser: Any, path: Path, width: int = 1000, scheme: str = "light") -> None:
        size = {"width": width, "height": 800}
        self.page = browser.new_page(viewport=size, color_scheme=scheme)
        self.said: list[str] = []
        self.asked: list[str] = []
        self.page.on("console", lambda message: self.said.append(message.text))
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(path.as_uri())
        # All charts that are to be seen are drawn.
        charts = "[...document.querySelectorAll('.chart:not([hidden])')]"
        self.page.wait_for_function(f"{charts}.every(chart => chart.querySelector('svg'))")
        self.own = path.as_uri()

    def foreign(self) -> list[str]:
        """What was asked of anyone but the file itself."""
        return [url for url in self.asked if url != self.own and not url.startswith("blob:")]


@pytest.fixture
def film(browser, pages):
    """The page made by hand, its film ready."""
    opened = Opened(browser, pages["walk"])
    opened.page.wait_for_function("document.getElementById('video').readyState >= 2")
    yield opened.page
    assert (opened.said, opened.foreign()) == ([], [])
    opened.page.close()


def shown_frame(page: Any) -> float:
    page.wait_for_function("!document.getElementById('video').seeking")
    at: float = page.evaluate("document.getElementById('video').currentTime")
    return at * 10 - 0.5  # ten frames a second; the middle of one


def selected(page: Any) -> list[str]:
    found: list[str] = page.eval_on_selector_all(
        "[aria-selected=true]", "all => all.map(e => e.id)"
    )
    return found


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", ["walk", "evolved", "goals", "unfinished", "comparison"])
def test_it_opens_without_errors_and_network_at_any_width(browser, pages, name, scheme):
    opened = Opened(browser, pages[name], 1000, scheme)
    for width in (400, 700, 1000, 2000):
        opened.page.set_viewport_size({"width": width, "height": 800})
        opened.page.wait_for_timeout(100)  # charts follow their frames
        assert opened.page.evaluate("document.documentElement.scrollWidth") <= width
        for summary in opened.page.query_selector_all(
            "details:not([open]):not([hidden]) > summary"
        ):
            summary.click()
        assert opened.page.evaluate("document.documentElement.scrollWidth") <= width
        if width == (400 if scheme == "light" else 1000):
            found = axe.Axe().run(opened.page).response["violations"]
            serious = [(v["id"], [n["html"][:80] for n in v["nodes"]]) for v in found]
            assert serious == []
    assert (opened.said, opened.foreign()) == ([], [])
    opened.page.close()


def test_a_cell_of_the_matrix_shows_its_calls(film):
    film.wait_for_function("document.getElementById('pair-video').readyState >= 2")
    cells = json.loads(film.locator("#data").text_content())["handover"]
    buttons = film.locator("#pairs button")
    assert buttons.count() == len(cells["cells"])
    for i in range(buttons.count()):
        button = buttons.nth(i)
        button.click()
        cell = cells["cells"][button.get_attribute("data-cell")]
        assert button.get_attribute("aria-pressed") == "true"
        title = f"{cell['skill']} after {cell['before']}" if cell["before"] else cell["skill"]
        assert title in film.locator("#pair-title").text_content()
        assert cell["done"] in film.locator("#pair").text_content()
        assert film.locator("#pair-clips button").count() == len(cell["clips"])
        for k, clip in enumerate(cell["clips"]):
            film.locator("#pair-clips button").nth(k).click()
            film.evaluate("document.getElementById('pair-video').pause()")
            at = film.evaluate("document.getElementById('pair-video').currentTime")
            assert clip["from"] <= at * cells["film"]["fps"] <= clip["to"] + 1


def test_a_film_that_is_paused_before_it_plays_says_nothing(film):
    film.locator("#pairs button").first.click()
    film.evaluate(
        """() => {
            const video = document.getElementById("pair-video");
            video.load();
            document.querySelector("#pair-clips button").click();
            video.pause();
        }"""
    )
    film.wait_for_timeout(200)


def test_the_film_jumps_to_the_call_that_is_clicked(film):
    for place, first in ((0, 0), (1, 5 + HOLD)):
        for i, (skill, start, steps, *_) in enumerate(CALLS):
            film.click(f"#call-{place}-{i}")
            assert selected(film) == [f"call-{place}-{i}"]
            # A frame stands for two steps; that of the first step of the call, or the one after.
            assert shown_frame(film) == pytest.approx(first + -(-start // 2))
            told = film.inner_text("#call-title"), film.inner_text("#call")
            assert told[0] == f"Call {i + 1} of 4: {('go', 'stay')[skill]}"
            assert f"{start} to {start + steps} ({steps})" in told[1]
    film.wait_for_function("document.getElementById('now').textContent.includes('return so far +')")
    # The last call of the second episode begins at step 7, which no frame shows; 8 is in one.
    assert "step 8 of 9 · go · return so far +21" in film.inner_text("#now")


def test_the_picture_is_that_of_the_step(film):
    red = """() => {
        const video = document.getElementById('video'), canvas = document.createElement('canvas');
        canvas.width = video.videoWidth; canvas.height = video.videoHeight;
        const context = canvas.getContext('2d'); context.drawImage(video, 0, 0);
        const row = context.getImageData(0, canvas.height / 2, canvas.width, 1).data;
        let count = 0;
        for (let i = 0; i < row.length; i += 4) count += row[i] > 120 && row[i + 1] < 100;
        return count / canvas.width;
    }"""
    # At steps 0, 2, 6 (a frame for two steps) and 8 the walker stands at metre 0, 2, 3 and 5.
    for i, metres in enumerate((0, 2, 3, 5)):
        film.click(f"#call-0-{i}")
        shown_frame(film)
        film.wait_for_timeout(100)
        assert film.evaluate(red) == pytest.approx(metres / 6, abs=0.03)


def test_keys_go_from_call_to_call_and_play(film):
    film.focus("#timelines .track")
    for key, call in (
        ("Home", 0),
        ("ArrowRight", 1),
        ("End", 3),
        ("ArrowRight", 3),
        ("ArrowLeft", 2),
    ):
        film.keyboard.press(key)
        assert selected(film) == [f"call-0-{call}"]
    assert shown_frame(film) == pytest.approx(3)
    film.keyboard.press("Space")
    film.wait_for_function("!document.getElementById('video').paused")
    # It plays on into the next call, and the timeline follows.
    film.wait_for_function("document.querySelector('[aria-selected=true]').id === 'call-0-3'")
    film.keyboard.press("Space")
    film.wait_for_function("document.getElementById('video').paused")


def test_an_episode_without_film_is_told_and_the_film_stays(film):
    film.click("#more summary")
    film.click("#call-0-1")
    before = shown_frame(film)
    film.click("#call-3-2")
    assert shown_frame(film) == before
    assert "this episode is not in it" in film.inner_text("#call")
    film.click("#table summary")
    film.click("#calls button[aria-label='Show call 4']")
    assert selected(film) == ["call-3-3"]
    cells = film.eval_on_selector_all(
        "#calls tbody tr:nth-child(4) td", "all => all.map(e => e.innerText)"
    )
    assert cells == ["4", "go", "7", "2", "by itself", "+11", "+4", "yes"]


def test_a_call_is_shown_with_its_goal(browser, pages):
    opened = Opened(browser, pages["goals"])
    call = opened.page.locator("#timelines .call").first
    call.click()
    episode = json.loads(opened.page.locator("#data").text_content())["episodes"][0]
    goal = episode["calls"]["goal"][0]
    assert goal.startswith("(")
    pairs = opened.page.locator("#call div").all_text_contents()
    assert f"Goal{goal}" in pairs
    assert call.get_attribute("title").startswith(f"call 1: go_to {goal}, from step 0")
    opened.page.locator("#table summary").click()
    assert opened.page.locator("#calls tbody tr").first.locator("td").nth(1).text_content() == (
        f"go_to {goal}"
    )
    assert (opened.said, opened.foreign()) == ([], [])
    opened.page.close()


def test_films_of_handovers_and_choices_name_goals(browser, pages):
    opened = Opened(browser, pages["goals"])
    page, goal = opened.page, "(0.9, 0.9)"
    page.wait_for_function("document.getElementById('pair-video').readyState >= 2")
    assert re.match(r"go_to \(\S+, \S+\)( ends|: )", page.inner_text("#pair-now"))
    cues = """() => {
        const track = document.querySelector("#pair-video track").track;
        track.mode = "showing";
        return [...(track.cues ?? [])].map(cue => cue.text);
    }"""
    page.evaluate(cues)
    page.wait_for_function(f"({cues})().length > 0")
    words = page.evaluate(cues)
    assert all(re.fullmatch(r"go_to \(\S+, \S+\)( ends)?", text) for text in words)
    points = page.locator("#choices .mark-symbol path")
    points.first.scroll_into_view_if_needed()
    points.first.hover(force=True)
    page.wait_for_selector("#vg-tooltip-element.visible")
    assert goal in page.inner_text("#vg-tooltip-element")
    assert (opened.said, opened.foreign()) == ([], [])
    page.close()


def test_charts_follow_what_is_chosen(browser, pages):
    page = Opened(browser, pages["evolved"]).page
    page.select_option("#up", label="pole angle")
    page.wait_for_function("document.getElementById('choices').textContent.includes('pole angle')")
    page.select_option("#hue", "success")
    page.wait_for_function("document.getElementById('choices').textContent.includes('no success')")
    page.locator("#curve-2 svg").scroll_into_view_if_needed()
    page.hover("#curve-2 svg", position={"x": 150, "y": 60})
    page.wait_for_selector("#vg-tooltip-element.visible")
    assert "environment steps" in page.inner_text("#vg-tooltip-element")
    page.select_option("#metric", "entropy")
    page.wait_for_function("document.getElementById('curve-0').textContent.includes('entropy')")
    ink = "getComputedStyle(document.querySelector('#choices .role-axis-label text')).fill"
    light = page.evaluate(ink)
    page.emulate_media(color_scheme="dark")
    page.wait_for_function(f"{ink} !== {json.dumps(light)}")
    page.close()
