"""The live page and the report in a real browser, and who is let in."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from bench import ema
from chain_rig import RIG
from live_page import Page, opened

from ema_pipeline.job import adding, change_effects, run_raw
from ema_pipeline.run.opening import existing_run
from ema_pipeline.simulate.campaign import simulate_campaign
from ema_pipeline.store import Store
from ema_pipeline.view.session import Job, Session
from ema_pipeline.view.snapshots import FOLDER, Snapshots

HOSTILE = "<img src=x onerror=document.title=1>"
CULPRIT = "mass@b"


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of three masses in a row, the middle one heavier than its model; the test has a hostile title."""
    folder = tmp_path_factory.mktemp("view")
    raw, rig = folder / "raw", folder / "rig.toml"
    rig.write_text(RIG, encoding="utf-8")
    simulate_campaign(raw, str(rig), effects=["mass@b.x:mass=0.3"], hits=1, duration_s=1.0, seed=5)
    description = next(raw.rglob("test.toml"))
    text = re.sub(
        r"^title = .*$", f"title = '{HOSTILE}'", description.read_text(encoding="utf-8"), flags=re.M
    )
    first = next(p for p in sorted(description.parent.iterdir()) if p.suffix == ".uff")
    first.rename(first.with_name(f"{HOSTILE}.uff"))
    description.write_text(text.replace(f'"{first.name}"', f"'{HOSTILE}.uff'"), encoding="utf-8")
    run_raw(raw, str(rig), folder / "out")
    return folder / "out"


@pytest.fixture
def out(results: Path, tmp_path: Path) -> Path:
    """A copy of the results that a test may change."""
    return Path(shutil.copytree(results, tmp_path / "out"))


@pytest.fixture
def page(out: Path) -> Iterator[Page]:
    """The live page of a copy of the results."""
    served = Page(out)
    yield served
    if served.process.poll() is None:
        assert served.stop() == 0


@pytest.fixture(scope="module")
def still(results: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Page, str]]:
    """A live page, and its cookie, for tests that change nothing on it."""
    served = Page(Path(shutil.copytree(results, tmp_path_factory.mktemp("still") / "out")))
    yield served, served.enter().partition(";")[0]
    assert served.stop() == 0


def with_cookie(browser, still: tuple[Page, str]):
    """A browser that has been let in, and the page as it shows it."""
    served, cookie = still
    name, _, value = cookie.partition("=")
    context = browser.new_context()
    context.add_cookies([{"name": name, "value": value, "url": served.origin, "sameSite": "Strict"}])
    return context, opened(context, served.origin)


# who is let in


def test_token_opens_once_and_the_cookie_is_for_this_page_alone(page: Page) -> None:
    cookie = page.enter()
    assert "httponly" in cookie.lower()
    assert "samesite=strict" in cookie.lower()
    assert page.ask("GET", page.address.removeprefix(page.origin)).status == 403
    answer = page.ask("GET", "/", Cookie=cookie.partition(";")[0])
    assert answer.status == 200
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe-eval" not in policy
    assert "script-src 'self';" in policy


ROUTES = (
    "/",
    "/measured",
    "/model",
    "/events",
    "/commands",
    "/numbers.js",
    "/figures.js",
    "/page.js",
    "/bokeh.js",
    "/live.js",
    "/nowhere",
)


def test_nobody_else_is_let_in(still: tuple[Page, str]) -> None:
    page, cookie = still
    name = cookie.partition("=")[0]
    for path in ROUTES:
        assert page.ask("GET", path).status == 403
        assert page.ask("GET", path, Cookie=f"{name}=guess").status == 403
        for host in ("localhost", f"localhost:{page.port}", "127.0.0.1", f"evil.example:{page.port}"):
            assert page.ask("GET", path, Cookie=cookie, Host=host).status == 403
        assert page.ask("GET", path, Cookie=cookie, Origin="http://evil.example").status == 403
        assert page.ask("GET", path, Cookie=cookie, Sec_Fetch_Site="cross-site").status == 403
    assert page.ask("GET", "/?token=guess").status == 403
    upgrade = page.ask(
        "GET", "/events", Upgrade="websocket", Connection="Upgrade", Origin="http://evil.example"
    )
    assert upgrade.status == 403


def test_nothing_changes_without_the_pages_own_origin_or_by_get(still: tuple[Page, str]) -> None:
    page, cookie = still
    out = page.folder
    before = (out / "ema.h5").stat().st_mtime_ns
    wanted = json.dumps({"verb": "add", "label": CULPRIT})
    kind = "application/json"
    assert page.ask("POST", "/action", wanted, Cookie=cookie, Content_Type=kind).status == 403
    for origin in ("null", "http://evil.example", f"http://localhost:{page.port}", "http://127.0.0.1"):
        assert (
            page.ask("POST", "/action", wanted, Cookie=cookie, Content_Type=kind, Origin=origin).status == 403
        )
    assert page.ask("GET", "/action", Cookie=cookie).status == 405
    own = {"Cookie": cookie, "Origin": page.origin}
    assert page.ask("POST", "/action", wanted, Content_Type="text/plain", **own).status == 409
    for body in ("", "[]", "{}", '{"verb": "run"}', '{"verb": "add", "label": 3}', "x" * 5000):
        assert page.ask("POST", "/action", body, Content_Type=kind, **own).status == 409
    time.sleep(0.5)
    assert (out / "ema.h5").stat().st_mtime_ns == before


def test_undone_state_is_the_file_that_was_there_before(out: Path) -> None:
    before = (out / "ema.h5").read_bytes()
    kept = Snapshots(out)
    kept.take()
    with Store(out).changing() as file:
        file.attrs["x"] = 1
    assert (out / "ema.h5").read_bytes() != before
    kept.restore()
    assert (out / "ema.h5").read_bytes() == before
    assert not len(kept)


# what is said


def test_outcome_of_a_diagnosis_says_which_model_is_in_use_and_what_is_only_proposed(results: Path) -> None:
    told = Session(results)._outcome(Job("diagnose", ""))
    assert re.fullmatch(
        r"In use: the base model, error [\d.]+\. With mass at b, as proposed, it would be [\d.]+ \(held out .*\)\.",
        told,
    )


def test_commands_name_the_effect_files_of_the_page(results: Path) -> None:
    session = Session(results)
    session._effect_files = ("film.py",)
    was = session.results
    session._log(was, replace(was, added=("film@b", CULPRIT)))
    session._log(was, was, Job("diagnose", ""))
    named = "--effect-file film.py"
    assert session.commands == [
        f"ema add {results} film@b {CULPRIT} {named}",
        f"ema diagnose {results} {named}",
    ]


# in a browser


def errors_shown(tab) -> tuple[float, float]:
    """Error before and after, as the first tile has them."""
    tile = tab.locator(".tile").first
    return float(tile.locator(".was").inner_text()), float(tile.locator("strong").inner_text())


def test_click_on_the_effect_and_the_error_falls_in_every_tab(browser, page: Page, out: Path) -> None:
    from playwright.sync_api import expect

    context = browser.new_context()
    tab = opened(context, page.address)
    second = opened(context, page.origin)
    tab.wait_for_selector("[data-figure=frf][data-state=shown]", timeout=30_000)
    tab.locator(f'button.act.add[data-label="{CULPRIT}"]').click()
    expect(tab.locator("#page_top h2")).to_contain_text("In the model: mass at b", timeout=60_000)
    before, after = errors_shown(tab)
    assert before > 5
    assert after < 1.5
    expect(second.locator("#page_top h2")).to_contain_text("In the model: mass at b", timeout=20_000)
    expect(tab.locator("#cancel")).to_be_hidden(timeout=60_000)
    expect(second.locator("#commands")).to_have_text(f"ema add {out} {CULPRIT}")
    assert existing_run(out).info.effects == (CULPRIT,)

    second.locator("#undo").click()
    expect(tab.locator("#page_top h2")).to_contain_text("Missing: mass at b", timeout=20_000)
    assert existing_run(out).info.effects == ()
    expect(tab.locator("#undo")).to_be_disabled()

    tab.locator("#add-form button").click()
    expect(tab.locator("#status")).to_contain_text("Type an effect and its place, e.g. ")
    expect(tab.locator("#add-label")).to_be_focused()

    tab.locator("#add-label").fill("no_such@thing")
    tab.locator("#add-form button").click()
    expect(tab.locator("#status")).to_contain_text("no_such", timeout=20_000)
    assert existing_run(out).info.effects == ()
    assert tab.faults == second.faults == []
    context.close()


@pytest.mark.slow
def test_refit_that_is_cancelled_leaves_the_folder_as_it_was(browser, page: Page, out: Path) -> None:
    from playwright.sync_api import expect

    before = (out / "ema.h5").read_bytes()
    context = browser.new_context()
    tab = opened(context, page.address)
    tab.locator(f'button.act.add[data-label="{CULPRIT}"]').click()
    tab.locator("#cancel").click(timeout=20_000)
    expect(tab.locator("#status")).to_contain_text("Cancelled", timeout=20_000)
    assert (out / "ema.h5").read_bytes() == before
    expect(tab.locator("#page_top h2")).to_contain_text("Missing: mass at b")
    tab.locator(f'button.act.add[data-label="{CULPRIT}"]').click()  # a new worker does it
    expect(tab.locator("#page_top h2")).to_contain_text("In the model", timeout=60_000)
    context.close()


@pytest.mark.slow
def test_mode_is_excluded_and_one_included_and_the_commands_repeat_it(
    browser, page: Page, out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from playwright.sync_api import expect

    original = Path(shutil.copytree(out, out.with_name("original")))
    context = browser.new_context()
    tab = opened(context, page.address)
    assert tab.locator("button.pick").count() == 3
    tab.locator("button[data-verb=exclude_mode]").nth(2).click()
    expect(tab.locator("#moved")).to_contain_text("Modes 3 → 2", timeout=60_000)
    expect(tab.locator("#moved")).to_contain_text("gone")
    expect(tab.locator("button.pick")).to_have_count(2, timeout=20_000)
    expect(tab.locator("#page_top h2")).to_contain_text("Other hits or modes than in the diagnosis")
    expect(tab.locator("#status")).to_contain_text("Modes 3 → 2", timeout=60_000)
    chosen = existing_run(out).info.choices
    assert len(chosen.excluded_modes) == 1

    tab.locator("#include-hertz").fill("not a number")
    tab.locator("#include-form button").click()
    expect(tab.locator("#status")).to_contain_text("name it by its frequency", timeout=20_000)
    assert existing_run(out).info.choices == chosen

    commands = tab.locator("#commands").text_content()
    for line in commands.replace(str(out), str(original)).splitlines():
        code, _, err = ema(capsys, *shlex.split(line)[1:])
        assert code == 0, err
    assert existing_run(original).info.choices == chosen

    tab.locator("#undo").click()
    expect(tab.locator("button.pick")).to_have_count(3, timeout=20_000)
    expect(tab.locator("#commands")).to_contain_text(f"ema include {out} --mode default:", timeout=20_000)
    assert not existing_run(out).info.choices
    expect(tab.locator("[data-figure=stab]")).to_be_attached()
    assert tab.faults == []
    context.close()


def test_a_pole_of_the_chart_that_is_clicked_is_the_one_to_include(browser, still: tuple[Page, str]) -> None:
    context, tab = with_cookie(browser, still)
    tab.locator("[data-figure=stab]").scroll_into_view_if_needed()
    tab.wait_for_selector("[data-figure=stab][data-state=shown] canvas", state="attached", timeout=20_000)
    tab.evaluate(
        """() => {
          const chart = Bokeh.documents.find(d => d.get_model_by_name("stab.loose"));
          const source = chart.get_model_by_name("stab.loose");
          source.data = { f: [123.456], order: [9], damping: [1.0] };
          source.selected.indices = [0];
          const voted = chart.get_model_by_name("stab.voted");
          voted.selected.indices = [voted.data.f.length - 1];
        }"""
    )
    assert tab.locator("#include-hertz").input_value() == "123.456"
    assert "mode 1" not in tab.locator("#mode-title").inner_text()
    assert tab.faults == []
    context.close()


def test_a_figure_that_is_drawn_moves_nothing_below_it(browser, still: tuple[Page, str]) -> None:
    context, tab = with_cookie(browser, still)
    places = tab.locator("[data-figure]")
    heights = "all => all.map(e => [e.dataset.figure, e.getBoundingClientRect().height])"
    before = places.evaluate_all(heights)
    shown = [k for k in range(places.count()) if places.nth(k).is_visible()]
    for k in shown:
        places.nth(k).scroll_into_view_if_needed()
        places.nth(k).locator("canvas").first.wait_for(state="attached", timeout=20_000)
    assert len(shown) >= 6
    assert places.evaluate_all(heights) == before
    assert tab.faults == []
    context.close()


def test_a_click_that_the_server_does_not_answer_is_told(browser, still: tuple[Page, str]) -> None:
    context, tab = with_cookie(browser, still)
    tab.route("**/action", lambda route: route.abort())
    tab.locator("button[data-verb=exclude_mode]").first.click()
    tab.locator("#status", has_text="did not take that").wait_for(timeout=20_000)
    assert tab.faults == []
    context.close()


def test_ctrl_c_is_the_end_of_a_page_and_no_interruption(page: Page) -> None:
    assert page.stop() == 0
    assert page.process.stderr is not None
    assert page.process.stderr.read() == "ema: stopped; all changes are kept\n"


def begin_refit(page: Page, out: Path) -> None:
    """Add an effect, and return once the fit with it is under way."""
    own = {
        "Cookie": page.enter().partition(";")[0],
        "Origin": page.origin,
        "Content_Type": "application/json",
    }
    assert page.ask("POST", "/action", json.dumps({"verb": "add", "label": CULPRIT}), **own).status == 202
    deadline = time.monotonic() + 30
    while not existing_run(out).info.effects and time.monotonic() < deadline:
        time.sleep(0.02)


def test_server_stopped_amid_a_refit_leaves_the_folder_as_it_was(page: Page, out: Path) -> None:
    before = (out / "ema.h5").read_bytes()
    begin_refit(page, out)
    assert page.stop() == 0
    assert page.process.stderr is not None
    said = page.process.stderr.read()
    assert said.startswith("ema: interrupted; go on with: ")
    assert said.rstrip().endswith(f"view {out}")
    assert (out / "ema.h5").read_bytes() == before
    assert not list(out.glob(f"{FOLDER}*"))


def test_server_that_is_killed_leaves_whole_results_and_nothing_behind(page: Page, out: Path) -> None:
    begin_refit(page, out)
    page.process.kill()
    page.process.wait()
    time.sleep(0.5)
    with Store(out).lock():  # the worker is gone, and its half of a change is taken back
        assert existing_run(out).info.effects == ()
    assert change_effects(out, adding([CULPRIT])).info.effects == (CULPRIT,)
    Snapshots(out)
    assert not list(out.glob(f"{FOLDER}*"))


def test_hostile_names_are_text_on_the_live_page(browser, still: tuple[Page, str]) -> None:
    context, tab = with_cookie(browser, still)
    assert tab.locator("h1").inner_text() == HOSTILE
    assert tab.title().startswith(HOSTILE)
    assert tab.locator("img").count() == 0
    assert HOSTILE in tab.locator("#provenance").inner_html().replace("&lt;", "<").replace("&gt;", ">")
    context.close()


def test_report_opens_from_disk_without_network_and_shows_its_figures(browser, results: Path) -> None:
    context = browser.new_context(offline=True)
    asked: list[str] = []
    context.on("request", lambda request: asked.append(request.url))
    tab = opened(context, (results / "report.html").as_uri())
    for figure in ("frf", "moved", "errors", "ladder", "nyquist", "stab", "shape", "mac"):
        place = tab.locator(f"[data-figure={figure}]")
        place.scroll_into_view_if_needed()
        tab.wait_for_selector(
            f"[data-figure={figure}][data-state=shown] canvas", state="attached", timeout=20_000
        )
    tab.locator("button.pick").nth(1).click()
    assert "mode 2" in tab.locator("#mode-title").inner_text()
    assert tab.faults == []
    assert len([url for url in asked if not url.startswith(("data:", "blob:"))]) == 1
    assert tab.title().startswith(HOSTILE)
    assert (results / "report.html").stat().st_size < 6e6
    context.close()
