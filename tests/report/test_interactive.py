"""What the interactive figures are given: models as sums over poles, FRFs in few bytes, names as text."""

from __future__ import annotations

import base64
import json
import re
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import report_example as example

from ema_pipeline.correlate.types import Unpaired
from ema_pipeline.dof import Dof
from ema_pipeline.mechanics.frf import receptance
from ema_pipeline.mechanics.partial_fractions import partial_fractions
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.modal.types import LeftOut, StabilisationChart
from ema_pipeline.report.figures.frf import frf_overview, frf_sheet
from ema_pipeline.report.figures.modes import stabilisation_chart
from ema_pipeline.report.html import report_html, script_json
from ema_pipeline.report.interactive.data import measured_data, model_data, shown_up_to
from ema_pipeline.report.interactive.packing import DECADES, packed_frfs
from ema_pipeline.report.results import RunResults

HOSTILE = "<script>alert(1)</script>"


@pytest.fixture(scope="module")
def run() -> RunResults:
    return example.planetary_run(lines=513)


def damped(kind: str) -> LinearSystem:
    """Three masses in a row, the first one free to drift where nothing holds it."""
    rng = np.random.default_rng(3)
    k = 1e6 * np.array([[1.0, -1, 0], [-1, 3, -2], [0, -2, 2]])
    zero = np.zeros((3, 3))
    viscous = 20 * np.array([[1.0, -1, 0], [-1, 2, -1], [0, -1, 1]])
    skew = rng.normal(size=(3, 3))
    system = LinearSystem(("a.x", "b.x", "c.x"), np.diag([1.0, 2, 0.5]), k, zero, zero, 0.01)
    return {
        "modal": system,
        "viscous": replace(system, damping=viscous),
        "hysteretic": replace(system, structural=0.03 * k, modal_damping_ratio=0.0),
        "gyroscopic": replace(system, damping=viscous + 30 * (skew - skew.T)),
    }[kind]


@pytest.mark.parametrize("kind", ["modal", "viscous", "hysteretic", "gyroscopic"])
def test_sum_over_poles_is_the_receptance_with_any_damping(kind: str) -> None:
    system, f = damped(kind), np.linspace(2.0, 600.0, 300)
    out, inp = np.eye(3), np.array([[1.0, 0, 0], [0, 1, -1]])
    expected = receptance(system, f, out, inp)
    found = partial_fractions(system, out, inp).receptance(f)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())


def unpacked(text: str, lines: int) -> np.ndarray:
    planes = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8).astype(np.uint32)
    low, high = planes.reshape(2, -1)
    return np.cumsum((low + 256 * high).reshape(-1, lines), axis=1) % 65536


def test_packed_frfs_are_the_measured_ones_to_a_tenth_of_a_per_cent(run: RunResults) -> None:
    frfs = run.configurations[0].frfs
    assert frfs is not None
    packed = packed_frfs(frfs, 1500.0, None)
    lines = packed["lines"]
    size = 10 ** (DECADES[0] + (DECADES[1] - DECADES[0]) * unpacked(packed["magnitude"], lines) / 65534)
    turn = np.exp(1j * (2 * np.pi * unpacked(packed["phase"], lines) / 65535 - np.pi))
    expected = np.stack([frfs.accelerance()[o, i, 1 : lines + 1] for o, i, _ in packed["pairs"]])
    assert np.max(np.abs(size * turn / expected - 1)) < 1e-3
    assert len(packed["pairs"]) == packed["total"] == int((frfs.hits > 0).sum())


@pytest.mark.parametrize(
    ("excitation", "noise", "word"),
    [("", False, "hit"), ("random", False, "block"), ("multisine", True, "period")],
)
def test_what_was_averaged_has_its_name_on_the_page_and_on_paper(
    run: RunResults, excitation: str, noise: bool, word: str
) -> None:
    known = run.configurations[0].frfs
    assert known is not None
    frfs = replace(
        known,
        excitation=excitation,
        hits=np.full_like(known.hits, 3),
        noise_variance=known.variance if noise else None,
    )
    assert packed_frfs(frfs, 1500.0, None)["average"] == word
    sheet = frf_sheet(frfs, None, [(0, 0)])
    assert sheet.axes[0].get_legend().get_texts()[0].get_text() == f"measured, mean of 3 {word}s"


def test_of_more_frfs_than_fit_the_driving_points_are_kept(run: RunResults) -> None:
    frfs = run.configurations[0].frfs
    assert frfs is not None
    packed = packed_frfs(frfs, 1500.0, 4 * int(frfs.frequency_hz.size))
    assert len(packed["pairs"]) < packed["total"]
    kept = {(packed["outputs"][o], packed["inputs"][i]) for o, i, _ in packed["pairs"]}
    driving = {(d.point, d.point) for d in frfs.inputs if d.point in packed["outputs"]}
    assert len(kept & driving) == min(len(driving), len(kept))


def test_every_model_has_its_frfs_differences_and_name(run: RunResults) -> None:
    assert run.comparison is not None
    systems = {c.name: c.system for c in run.configurations}
    both = replace(
        run,
        added=("spring@sun",),
        comparison_base=run.comparison,
        configurations=tuple(replace(c, base_system=systems[c.name]) for c in run.configurations),
    )
    model = model_data(both)
    assert model["models"] == ["base model", "with spring at sun"]
    assert len(model["errors"]["models"]) == 2
    assert all(len(per) == 2 for per in model["frfs"].values())
    name, c = run.configurations[0].name, run.configurations[0]
    assert c.frfs is not None
    assert len(model["frfs"][name][0]["own"]["outputs"]) == len(c.frfs.outputs)


def test_pole_is_marked_at_the_same_place_however_few_lines_there_are(run: RunResults) -> None:
    c = run.configurations[0]
    assert c.modal is not None
    thin = [
        replace(
            m,
            circles=tuple(
                replace(x, frequency_hz=x.frequency_hz[::4], points=x.points[::4]) for x in m.circles
            ),
        )
        for m in c.modal.modes
    ]
    sparse = replace(run, configurations=(replace(c, modal=replace(c.modal, modes=tuple(thin))),))
    marks = [
        [x["mark"] for m in measured_data(r)["configurations"][0]["modes"] for x in m["circles"]]
        for r in (run, sparse)
    ]
    assert None not in marks[0]
    assert marks[0] == marks[1]


def few_modes(run: RunResults, below_hz: float) -> RunResults:
    """The first configuration with its modes below a frequency only, and with no pole but theirs."""
    c = run.configurations[0]
    assert c.modal is not None
    low = tuple(m for m in c.modal.modes if m.frequency_hz < below_hz)
    chart = c.modal.chart
    mine = (chart.selected >= 0) & (chart.selected < len(low))
    chart = StabilisationChart(
        chart.order[mine],
        chart.frequency_hz[mine],
        chart.damping_ratio[mine],
        chart.stable[mine],
        chart.selected[mine],
    )
    modal = replace(c.modal, modes=low, left_out=(), chart=chart)
    return RunResults("few modes", configurations=(replace(c, modal=modal, pairing=None),))


def test_figures_over_frequency_end_soon_after_the_modes_and_what_looks_like_one(run: RunResults) -> None:
    low = few_modes(run, 200.0)
    (c,) = low.configurations
    assert c.modal is not None
    highest = c.modal.modes[-1].frequency_hz
    assert c.modal.band_hz[1] > 4 * highest
    (found,) = measured_data(low)["configurations"]
    assert found["shown_to"] == pytest.approx(2 * highest)
    assert (
        found["frfs"]["start"] + found["frfs"]["step"] * found["frfs"]["lines"] > 4 * highest
    )  # all is kept
    for figure in (stabilisation_chart(c.modal, c.frfs), frf_overview(c.frfs, c.modal)):
        assert figure.axes[0].get_xlim()[1] == pytest.approx(2 * highest, rel=0.01)
    peak = LeftOut(1.5 * highest, 0.01, "peak", "doubtful")
    seen = replace(c, modal=replace(c.modal, left_out=(peak,)))
    (found,) = measured_data(replace(low, configurations=(seen,)))["configurations"]
    assert found["shown_to"] == pytest.approx(3 * highest)
    assert measured_data(run)["configurations"][0]["shown_to"] == shown_up_to(run.configurations[0])


def test_axis_begins_with_the_modes_and_the_legend_has_what_the_chart_has(
    browser, run: RunResults, tmp_path: Path
) -> None:
    low = few_modes(run, 200.0)
    low = replace(low, configurations=(replace(low.configurations[0], system=None),))
    page = tmp_path / "report.html"
    page.write_text(report_html(low), encoding="utf-8")
    tab = browser.new_page()
    tab.goto(page.as_uri())
    for figure in ("frf", "stab"):
        shown = tab.locator(f".bk[data-figure={figure}]")
        shown.scroll_into_view_if_needed()
        tab.wait_for_selector(f"[data-figure={figure}][data-state=shown]", timeout=30_000)
    find = "Bokeh.documents.find(d => d.get_model_by_name('{0}'))"
    axis = f"{find.format('frf.x')}.get_model_by_name('frf.x')"
    highest = low.configurations[0].modal.modes[-1].frequency_hz  # type: ignore[union-attr]
    assert tab.evaluate(f"{axis}.end") == pytest.approx(2 * highest, rel=1e-3)
    tab.evaluate(f"{axis}.end = 1e4; {axis}.reset()")
    assert tab.evaluate(f"{axis}.end") == pytest.approx(2 * highest, rel=1e-3)
    assert "measured up to" in tab.locator("#frf-note").inner_text()
    entries = (
        "Array.from({}._all_models.values()).filter(m => m.type === 'LegendItem' && m.visible)"
        ".map(m => m.label.value)"
    )
    of_chart, of_frf = (entries.format(find.format(axis)) for axis in ("stab.x", "frf.x"))
    assert set(tab.evaluate(of_chart)) == {"mode indicator (log)", "stands for a mode"}
    assert set(tab.evaluate(of_frf)) == {"measured ± 2σ", "measured"}  # there is no model without a rig
    assert tab.evaluate("[-1, 0, 12].map(EmaNumbers.power)") == ["10⁻¹ ", "", "10¹² "]
    tab.close()


def test_a_page_that_is_printed_has_figures_that_were_never_in_view_and_a_narrow_one_legends_that_fit(
    browser, run: RunResults, tmp_path: Path
) -> None:
    page = tmp_path / "report.html"
    page.write_text(report_html(run), encoding="utf-8")
    tab = browser.new_page(viewport={"width": 1200, "height": 700})
    tab.goto(page.as_uri())
    for figure in ("frf", "stab", "errors"):
        tab.wait_for_selector(f"[data-figure={figure}][data-state=shown]", timeout=30_000, state="attached")
    of_legend = (
        "Array.from(Bokeh.documents.find(d => d.get_model_by_name('frf.x'))._all_models.values())"
        ".find(m => m.type === 'Legend').orientation"
    )
    assert tab.evaluate(of_legend) == "horizontal"
    tab.set_viewport_size({"width": 400, "height": 700})
    for _ in range(100):  # the page forbids the evaluation that Playwright's own waiting needs
        if tab.evaluate(of_legend) == "vertical":
            break
        tab.wait_for_timeout(100)
    assert tab.evaluate(of_legend) == "vertical"
    tab.close()


def test_a_mode_without_a_partner_in_one_model_of_two_stands_once_in_the_figure_of_errors(
    browser, run: RunResults, tmp_path: Path
) -> None:
    c = run.configurations[0]
    assert c.pairing is not None
    assert c.modal is not None
    compared = {m.measured for m in run.comparison.modes if m.configuration == c.name}  # type: ignore[union-attr]
    index = min(compared)
    lone = (
        *c.pairing.unpaired_measured,
        Unpaired(index, c.modal.modes[index].frequency_hz, "shape unlike any"),
    )
    one = replace(c, pairing=replace(c.pairing, unpaired_measured=lone))
    page = tmp_path / "report.html"
    page.write_text(
        report_html(replace(run, configurations=(one, *run.configurations[1:]))), encoding="utf-8"
    )
    tab = browser.new_page()
    errors: list[str] = []
    tab.on("pageerror", lambda error: errors.append(str(error)))
    tab.on("console", lambda told: errors.append(told.text) if told.type == "error" else None)
    tab.goto(page.as_uri())
    tab.locator(".bk[data-figure=errors]").scroll_into_view_if_needed()
    tab.wait_for_selector("[data-figure=errors][data-state=shown]", timeout=30_000)
    shown = "Bokeh.documents.find(d => d.get_model_by_name('errors.x')).get_model_by_name('errors.x').factors"
    factors = [tuple(f) for f in tab.evaluate(shown)]
    tab.close()
    assert not errors
    assert len(factors) == len(set(factors))
    assert (c.name, f"{index + 1}: {c.modal.modes[index].frequency_hz:.5g} Hz") in factors


def test_names_from_files_are_text_in_page_and_data(run: RunResults) -> None:
    c = run.configurations[0]
    assert c.frfs is not None
    named = replace(c, name=HOSTILE, hits=tuple(replace(h, file=HOSTILE) for h in c.hits))
    html = report_html(replace(run, title=HOSTILE, configurations=(named,)))
    assert HOSTILE not in html
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in html
    data = re.search(r'id="ema-data">(.*?)</script>', html, flags=re.DOTALL)
    assert data is not None
    assert "<" not in data[1]
    assert json.loads(data[1])["measured"]["configurations"][0]["name"] == HOSTILE


def test_data_are_json_whatever_is_missing(run: RunResults) -> None:
    assert script_json({"a": float("nan"), "b": "</script>"}) == '{"a":null,"b":"\\u003c/script\\u003e"}'
    for results in (RunResults("empty"), replace(run, comparison=None, fit=None)):
        for found in (measured_data(results), model_data(results)):
            json.loads(script_json(found))
    c = run.configurations[0]
    assert c.frfs is not None
    unknown = replace(c.frfs, outputs=(Dof("moon", "x"), *c.frfs.outputs[1:]))
    model = model_data(replace(run, configurations=(replace(c, frfs=unknown),)))
    assert model["frfs"][c.name][0]["own"]["outputs"][0] is None
