"""Figures, HTML report and terminal tables."""

from __future__ import annotations

import io
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import report_example as example
from matplotlib.figure import Figure
from rich.console import Console

from ema_pipeline.check_result import judged
from ema_pipeline.correlate.types import ModeAlone
from ema_pipeline.frf.overview import cmif, representative_frfs
from ema_pipeline.frf.points import POINT
from ema_pipeline.frf.signs import SIGN
from ema_pipeline.modal.circle.compare import average
from ema_pipeline.number_text import format_percent, format_value, signed
from ema_pipeline.report import plots as report_plots
from ema_pipeline.report import style, summary, summary_files, tables, terminal
from ema_pipeline.report.cautions import Weight
from ema_pipeline.report.html import bokeh_script, report_html, write_report
from ema_pipeline.report.name_text import words
from ema_pipeline.report.page_top import page_top
from ema_pipeline.report.plots import figure_specs, write_plots
from ema_pipeline.report.results import ConfigurationResults, RunResults
from ema_pipeline.report.run_screen import RunScreen, next_lines, verdict_line
from ema_pipeline.report.shapes import missing_words, shape_pair
from ema_pipeline.report.summary_files import finite
from ema_pipeline.rigs import drawing_of

UNIT = re.compile(r", (1|%|°|Hz|N/m|σ|\(?[\w²/]|10[⁰¹²³⁴⁵⁶⁷⁸⁹⁻]+|MN/m|kg)")


@pytest.fixture(scope="module")
def run() -> RunResults:
    full = example.planetary_run(lines=1025)
    # few modes keep the suite fast
    return replace(full, configurations=tuple(few_modes(c, 3) for c in full.configurations))


def few_modes(c: ConfigurationResults, count: int) -> ConfigurationResults:
    assert c.modal is not None
    modal = replace(c.modal, modes=c.modal.modes[:count])
    pairing = c.pairing and replace(
        c.pairing, pairs=tuple(p for p in c.pairing.pairs if p.measured < count), mac=c.pairing.mac[:count]
    )
    return replace(c, modal=modal, pairing=pairing)


@pytest.fixture(scope="module")
def figures(run: RunResults) -> dict[str, Figure]:
    return {s.name: s.draw() for s in figure_specs(run)}


@pytest.fixture(scope="module")
def html(run: RunResults) -> str:
    return report_html(run)


# numbers


@pytest.mark.parametrize(
    ("value", "std", "unit", "expected"),
    [
        (9.981e6, 3.06e5, "N/m", "9.98 ± 0.31 MN/m"),
        (9.98e6, 9.96e5, "N/m", "10.0 ± 1.0 MN/m"),
        (1097.0, 0.05, "Hz", "1097.000 ± 0.050 Hz"),
        (4.1e7, 3.0e7, "N/m", "41 ± 30 MN/m"),
        (12345.0, 678.0, "Hz", "12340 ± 680 Hz"),
        (-0.034, 0.0021, "kg", "−34.0 ± 2.1 g"),
        (0.0123, math.nan, "kg", "12.30 g"),
        (0.5, 0.012, "kg", "0.500 ± 0.012 kg"),
        (0.02, 0.2, "kg", "0.02 ± 0.20 kg"),
        (5.0, math.nan, "kg", "5.000 kg"),
        (math.nan, 1.0, "kg", "not determined"),
        (1e6, math.inf, "N/m", "1.000 MN/m"),
        (0.0, 0.012, "1", "0.000 ± 0.012"),
        (-0.001, 0.11, "", "0.00 ± 0.11"),
        (1.0299978, 8.0e-6, "", "1.0299978 ± 0.0000080"),
        (0.9999954, 8.4e-6, "%", "0.9999954 ± 0.0000084 %"),
        (0.02, 3.0e-8, "", "(2.0000000 ± 0.0000030) × 10^-2"),
    ],
)
def test_values_are_rounded_to_two_figures_of_their_uncertainty(
    value: float, std: float, unit: str, expected: str
) -> None:
    assert format_value(value, std, unit) == expected


def test_a_part_is_called_what_it_is_once() -> None:
    assert words("b3 mass (mass)") == "b3 mass"
    assert words("base mass x (mass)") == "base mass x"
    assert words("sun_bearing x (spring)") == "sun bearing x (spring)"


def test_percentages_and_signs_read_as_people_write_them() -> None:
    assert format_percent(0.00981, 0.00042) == "0.981 ± 0.042 %"
    assert signed(-0.001, 1) == "0.0"
    assert signed(2.34) == "+2.3"


# figures


def test_package_never_imports_pyplot() -> None:
    package = Path(report_plots.__file__).parent
    assert not [f for f in package.rglob("*.py") if "import matplotlib.pyplot" in f.read_text()]


def test_every_labelled_axis_states_its_unit(figures: dict[str, Figure]) -> None:
    labels = {
        (name, text)
        for name, figure in figures.items()
        for ax in figure.axes
        for text in (ax.get_xlabel(), ax.get_ylabel())
        if text
    }
    assert len(labels) > 40
    without = {(n, t) for n, t in labels if not UNIT.search(t.replace("\n", " "))}
    assert not without


def test_no_tick_labels_overlap_in_any_figure(figures: dict[str, Figure]) -> None:
    for name, figure in figures.items():
        figure.draw_without_rendering()  # places everything; nobody looks at the pixels
        renderer = figure.canvas.get_renderer()  # type: ignore[attr-defined]
        for ax in figure.axes:
            for axis in (ax.xaxis, ax.yaxis):
                boxes = [
                    t.get_window_extent(renderer)
                    for t in axis.get_ticklabels()
                    if t.get_text() and t.get_visible() and t.get_window_extent(renderer).width > 0
                ]
                if not axis.get_visible() or not ax.axison:
                    continue
                for a, b in pairwise(boxes):
                    clash = a.shrunk(0.9, 0.9).overlaps(b.shrunk(0.9, 0.9))
                    assert not clash or not _inside(figure, a, b), f"{name}: tick labels at {a} and {b}"


def _inside(figure: Figure, *boxes: object) -> bool:
    return all(figure.bbox.overlaps(b) for b in boxes)  # type: ignore[arg-type]


def test_titles_and_axis_labels_stay_inside_the_figure(figures: dict[str, Figure]) -> None:
    for name, figure in figures.items():
        renderer = figure.canvas.get_renderer()  # type: ignore[attr-defined]
        for ax in figure.axes:
            for text in (ax.title, ax.xaxis.label, ax.yaxis.label, *figure.texts):
                if not text.get_text() or (not ax.axison and text is not ax.title):
                    continue
                box = text.get_window_extent(renderer)
                assert box.x0 > -1, f"{name}: '{text.get_text()}' leaves the figure on the left"
                assert box.x1 < figure.bbox.x1 + 1, (
                    f"{name}: '{text.get_text()}' leaves the figure on the right"
                )
                assert box.y0 > -1, f"{name}: '{text.get_text()}' leaves the figure at the bottom"
                assert box.y1 < figure.bbox.y1 + 1, (
                    f"{name}: '{text.get_text()}' leaves the figure at the top"
                )


def test_mode_numbers_above_close_modes_do_not_overlap() -> None:
    figure = style.new_figure(3.0)
    ax = figure.add_axes((0.1, 0.1, 0.8, 0.7))
    ax.set_xlim(0, 1000)
    style.mark_modes(ax, [100, 101, 102, 110, 500, 505, 990])
    figure.canvas.draw()
    renderer = figure.canvas.get_renderer()  # type: ignore[attr-defined]
    boxes = [t.get_window_extent(renderer) for t in ax.texts]
    assert len(boxes) >= 6
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[i + 1 :])


def test_svg_is_the_same_twice_and_holds_no_date(run: RunResults) -> None:
    spec = next(s for s in figure_specs(run) if s.section == "modes")
    first, second = style.svg(spec.draw()), style.svg(spec.draw())
    assert first == second
    assert b"dc:date" not in first


def test_svg_keeps_the_digits_of_numbers_that_people_read(run: RunResults) -> None:
    spec = next(s for s in figure_specs(run) if s.name == "fit_parameters")
    assert "2.198 ± 0.066 MN/m" in style.svg(spec.draw()).decode()


def test_one_hit_has_no_coherence_and_the_sheet_says_so() -> None:
    beam = example.beam_run(4, "z", 3)
    sheet = next(s for s in figure_specs(beam) if s.name.endswith("frf_1")).draw()
    assert any(t.get_text() == "one hit: no coherence" for ax in sheet.axes for t in ax.texts)


def test_driving_points_come_first_among_the_frfs_shown(run: RunResults) -> None:
    frfs = run.configurations[0].frfs
    assert frfs is not None
    picks = representative_frfs(frfs, 6)
    driving = [frfs.outputs[o].point == frfs.inputs[i].point for o, i in picks]
    assert driving == sorted(driving, reverse=True)
    assert sum(driving) == 4
    assert all(frfs.hits[o, i] > 0 for o, i in picks)


def test_cmif_equals_the_singular_values() -> None:
    rng = np.random.default_rng(0)
    h = rng.normal(size=(3, 5, 4)) + 1j * rng.normal(size=(3, 5, 4))
    expected = np.linalg.svd(h.transpose(2, 0, 1), compute_uv=False).T
    np.testing.assert_allclose(cmif(h, 3), expected, rtol=1e-10)


def test_every_mode_has_a_nyquist_sheet_with_its_circles(figures: dict[str, Figure], run: RunResults) -> None:
    modal = run.configurations[0].modal
    assert modal is not None
    for i, mode in enumerate(modal.modes, start=1):
        sheet = figures[f"no_ring_nyquist_{i:02d}"]
        titles = [ax.get_title() for ax in sheet.axes]
        assert titles == [f"{c.output.point} ← {c.input.point}" for c in mode.circles[:4]]
        fitted = next(line for line in sheet.axes[0].lines if line.get_label() == "fitted circle")
        x, y = np.asarray(fitted.get_xdata()), np.asarray(fitted.get_ydata())
        aspect = mode.circles[0].centre.real / mode.circles[0].radius
        assert (x.max() + x.min()) / (x.max() - x.min()) == pytest.approx(aspect, abs=1e-3)
        assert np.ptp(y) == pytest.approx(np.ptp(x), rel=1e-3)


def test_flat_sweep_is_called_not_identified(figures: dict[str, Figure]) -> None:
    labels = [t.get_text() for ax in figures["error_function"].axes for t in ax.get_legend().get_texts()]
    assert "3 modes: not identified" in labels
    assert "4 modes: minimum at 5.50 MN/m" in labels


def test_plots_of_an_earlier_run_are_removed_but_nothing_else(tmp_path: Path) -> None:
    beam = example.beam_run(4, "z", 2)
    (full,) = beam.configurations
    modes_only = replace(full, frfs=None)  # sheets of FRFs take longest to draw
    seen: list[tuple[int, int, str]] = []
    drawn = replace(beam, configurations=(modes_only,))
    written = write_plots(drawn, tmp_path, lambda *a: seen.append(a))
    assert len(seen) == len(written) == seen[-1][1]
    assert (tmp_path / "default_nyquist_02.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "default_nyquist_02.svg").is_file()
    (tmp_path / "mine.png").write_bytes(b"x")
    write_plots(replace(beam, configurations=(few_modes(modes_only, 1),)), tmp_path)
    assert not list(tmp_path.glob("default_nyquist_02.*"))
    assert (tmp_path / "default_nyquist_01.png").exists()
    assert (tmp_path / "mine.png").exists()


# planetary drawing


def test_drawing_knows_a_planetary_gear_and_nothing_else() -> None:
    drawing = drawing_of(["sun.x", "carrier.x", "ring.x", "planet3.zeta"], complete=False)
    assert drawing is not None
    assert [b.name for b in drawing.bodies] == ["carrier", "ring", "sun", "planet1", "planet2", "planet3"]
    assert drawing_of(["point01.z", "sun.x"], complete=False) is None


@pytest.mark.parametrize("planets", [2, 3, 4, 5, 7, 9])
def test_drawn_planets_touch_neither_each_other_nor_leave_the_ring(planets: int) -> None:
    drawing = drawing_of(
        [f"planet{n}.x" for n in range(1, planets + 1)] + ["sun.x", "carrier.x", "ring.x"], complete=True
    )
    assert drawing is not None
    bodies = {b.name: b for b in drawing.bodies}
    a, b = bodies["planet1"], bodies["planet2"]
    assert math.hypot(a.x - b.x, a.y - b.y) > 2 * a.radius
    assert math.hypot(a.x, a.y) == pytest.approx(1 + a.radius)
    assert bodies["ring"].radius == pytest.approx(1 + 2 * a.radius)


def test_zeta_of_the_second_of_four_planets_is_y() -> None:
    drawing = drawing_of([f"planet{n}.x" for n in range(1, 5)] + ["sun.x", "carrier.x"], complete=True)
    assert drawing is not None
    moved = drawing.motions(
        {"planet2.zeta": 1.0, "planet2.eta": 0.0, "planet1.zeta": 0.0, "planet1.eta": 2.0}
    )
    assert moved["planet2"].x == pytest.approx(0, abs=1e-12)
    assert moved["planet2"].y == pytest.approx(1)
    assert (moved["planet1"].x, moved["planet1"].y) == pytest.approx((0, 2))
    assert moved["planet2"].missing == ("u",)
    assert "x, y, u of carrier" in missing_words(moved)


def test_model_shape_beside_a_measured_one_has_its_sign_and_scale(run: RunResults) -> None:
    for c in run.configurations:
        assert c.pairing is not None
        for p in c.pairing.pairs:
            pair = shape_pair(c, p.measured)
            assert pair.model is not None
            known = [n for n, v in pair.measured.items() if np.isfinite(v)]
            a = np.array([pair.measured[n].real for n in known])
            b = np.array([pair.model[n].real for n in known])
            assert a @ b / (b @ b) == pytest.approx(1.0, abs=0.02)
            assert np.max(np.abs(a)) == pytest.approx(1.0, abs=0.01)


# HTML


class Links(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.ids: list[str] = []
        self.images_without_words = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for key, value in attrs:
            if key in ("src", "href", "xlink:href", "srcset", "data", "action"):
                self.links.append(value or "")
            if key == "id":
                self.ids.append(value or "")
        if tag == "img" and not dict(attrs).get("alt"):
            self.images_without_words += 1


def test_report_needs_no_network(html: str) -> None:
    found = Links()
    found.feed(html)
    assert found.links
    assert not [link for link in found.links if not link.startswith("#")]
    assert "default-src 'none'" in html
    assert not re.search(r"@import|url\(|fetch\(|XMLHttpRequest", html.replace(bokeh_script(), ""))


def test_links_inside_the_report_lead_somewhere(html: str) -> None:
    found = Links()
    found.feed(html)
    assert len(found.ids) == len(set(found.ids))
    assert {link[1:] for link in found.links if link.startswith("#")} <= set(found.ids)
    assert found.images_without_words == 0


def test_report_lists_all_modes_parameters_and_rejected_hits(html: str, run: RunResults) -> None:
    assert run.fit is not None
    for c in run.configurations:
        assert c.modal is not None
        for mode in c.modal.modes:
            assert format_value(mode.frequency_hz, mode.frequency_std_hz) in html
    for p in run.fit.parameters.values():
        assert format_value(p.value, p.std, p.unit) in html
    assert "second impact of 12 % after 8.1 ms" in html
    assert "no model mode within 20 % has MAC above 0.5" in html


def test_report_says_first_what_was_found_and_what_is_not_identified(html: str) -> None:
    start = html[html.index('id="summary"') : html.index('id="frf"')]
    assert "9.98 ± 0.31 MN/m" in start
    assert "identified by the data" in start
    assert "Do not quote it as a result" in start


def test_text_from_the_data_is_escaped(html: str) -> None:
    assert "campaign &lt;a &amp; b&gt;" in html
    assert "<a & b>" not in html


def test_every_paired_mode_moves_beside_its_model(html: str, run: RunResults) -> None:
    drawings = re.findall(r'aria-label="(Measured|Model) shape', html)
    pairs = sum(len(c.pairing.pairs) for c in run.configurations if c.pairing)
    assert drawings.count("Measured") == sum(len(c.modal.modes) for c in run.configurations if c.modal)
    assert drawings.count("Model") == pairs
    motion = re.findall(r'data-motion="([^"]*)"', html)[0]
    assert motion.count("[") == 1 + 6  # carrier, sun and four planets


@pytest.mark.parametrize(
    "results",
    [
        RunResults("Nothing yet"),
        RunResults("Hits only", configurations=(ConfigurationResults("a"),)),
        RunResults(
            "FRFs only",
            "planetary",
            (replace(example.configuration("a", False, lines=257), modal=None, pairing=None, system=None),),
        ),
        example.beam_run(3, "xz", 2),
    ],
    ids=lambda r: r.title,
)
def test_report_is_whole_where_stages_are_missing(results: RunResults, tmp_path: Path) -> None:
    path = tmp_path / "sub" / "report.html"
    write_report(results, path)
    text = path.read_text(encoding="utf-8")
    assert text.rstrip().endswith("</html>")
    sections = re.findall(r'<section id="(\w+)"', text)
    assert sections[0] == "summary"
    assert ("modes" in sections) == any(c.modal is not None for c in results.configurations)
    assert ("frf" in sections) == any(c.frfs is not None for c in results.configurations)
    assert "fit" not in sections


def test_mode_without_shape_circles_or_uncertainty_is_shown_all_the_same() -> None:
    c = few_modes(example.configuration("a", False, lines=257), 2)
    assert c.modal is not None
    blind = replace(
        c.modal.modes[0],
        circles=(),
        frequency_std_hz=math.nan,
        damping_std=math.nan,
        shape=np.full(len(c.modal.dofs), np.nan + 0j),
        shape_std=np.full(len(c.modal.dofs), np.nan),
    )
    run = RunResults("x", "planetary", (replace(c, modal=replace(c.modal, modes=(blind, c.modal.modes[1]))),))
    assert "Mode 1:" in report_html(run)


# words and terminal


def test_summary_speaks_of_agreement_only_where_the_error_is_about_one(run: RunResults) -> None:
    assert run.comparison is not None
    assert "more than the measurement's uncertainty explains" in " ".join(summary.findings(run))
    good = replace(run, comparison=replace(run.comparison, error=1.04))
    assert "to within their uncertainty" in " ".join(summary.findings(good))
    failing: Any = SimpleNamespace(
        verdict="unknown_effect", candidates=(), ladder=SimpleNamespace(rungs=()), error_limit=1.3
    )
    told = " ".join(summary.findings(replace(good, diagnosis=failing, diagnosed_on=good.added)))
    assert "to within their uncertainty" not in told
    assert "the diagnosis above says why the model fails all the same" in told


def test_misfit_is_the_first_caution_even_where_values_are_identified(run: RunResults) -> None:
    assert run.fit is not None
    assert "does not explain" not in " ".join(summary.cautions(run))
    poor = replace(run, fit=replace(run.fit, error=55.6))
    assert summary.cautions(poor)[0].startswith("The model does not explain the data (error 55.6)")


def test_a_model_that_the_diagnosis_finds_adequate_is_not_said_to_fail(run: RunResults) -> None:
    """Beside hundreds of data of single hits the modes alone may lie further off."""
    assert run.fit is not None
    poor = replace(run, fit=replace(run.fit, error=55.6))

    def told(verdict: str, error: float = 1.71) -> str:
        found: Any = SimpleNamespace(verdict=verdict, error=error, error_limit=1.3)
        return " ".join(summary.cautions(replace(poor, diagnosis=found)))

    assert "does not explain" not in told("adequate")
    assert "does not explain the data (error 1.71)" in told("unknown_effect")
    assert "does not explain the data (error 55.6)" in told("effect", 0.95)  # no error that explains them


@pytest.mark.parametrize(("left", "ringing", "told"), [(0.07, 3, True), (0.07, 2, False), (0.02, 4, False)])
def test_hits_that_still_ring_at_the_end_of_their_records_are_told(
    run: RunResults, left: float, ringing: int, told: bool
) -> None:
    """Damping of what is cut off is known less well."""
    c = run.configurations[0]
    verdicts = [
        judged("response decay", left if k < ringing else 0.0, 0.01, False, "", "warn", "ch4 still at 7 %")
        for k in range(4)
    ]
    hits = tuple(replace(c.hits[0], verdicts=(v,)) for v in verdicts)
    cautions = summary.cautions(replace(run, configurations=(replace(c, hits=hits),)))
    assert any(f"{ringing} of 4 hits still ring" in text for text in cautions) is told


def test_hits_of_opposite_sign_which_make_modes_vanish_are_the_first_caution(run: RunResults) -> None:
    c = run.configurations[0]
    assert c.frfs is not None
    told = "hits of a.x over b.x have opposite signs (2.csv#1 and 1.csv#1)"
    found = judged(SIGN, -1.0, -0.7, False, "", "warn", told, channel="a.x over b.x")
    odd = replace(c, frfs=replace(c.frfs, verdicts=(*c.frfs.verdicts, found)))
    assert summary.cautions(replace(run, configurations=(odd, *run.configurations[1:])))[0].endswith(
        f"{told}."
    )


def test_a_hit_of_another_point_heads_the_page_and_the_screen_and_comes_before_any_command(
    run: RunResults,
) -> None:
    c = run.configurations[0]
    assert c.frfs is not None
    told = "1.csv#1 is listed under a.x, but like the hits on b.x: correct 'impact' in test.toml, or leave it out"
    found = judged(POINT, 0.1, 0.5, False, "", "warn", told, channel="a.x")
    odd = replace(c, frfs=replace(c.frfs, verdicts=(*c.frfs.verdicts, found)))
    results = replace(run, configurations=(odd, *run.configurations[1:]), sensitivities=())
    top = page_top(results)
    assert top.doubt == "A hit is suspected: what follows is valid only if it is right."
    assert top.suspected[0].endswith(f"{told}.")
    assert not top.commands
    assert summary.findings(results)[0].startswith("A hit is suspected")
    assert verdict_line(results).startswith("A hit is suspected, see below. If it is right: ")
    assert next_lines(results, "OUT", "ema")[0].startswith("correct test.toml, then ema run ")
    assert not page_top(replace(run, sensitivities=())).doubt


def test_a_driving_point_that_is_none_is_told_on_the_screen(run: RunResults) -> None:
    """All hits of a point may be listed under another one, which no other hit contradicts."""
    c = run.configurations[0]
    assert c.frfs is not None
    told = "driving point m3.x: resonances differ in sign; hammer and sensor are not at one point"
    for check, shown in (("driving point", True), ("coherence", False)):
        found = judged(check, 0.4, 0.2, False, "", "warn", told, channel="m3.x over m3.x")
        odd = replace(c, frfs=replace(c.frfs, verdicts=(*c.frfs.verdicts, found)))
        cautions = summary.cautions(replace(run, configurations=(odd,)), Weight.SCALE)
        assert any(told in text for text in cautions) is shown


def test_files_of_results_that_are_gone_are_told() -> None:
    """Copied without its folder `stages`, a run has no FRFs, and its report no figures of them."""
    gone = RunResults("x", folder="results/x", missing_files=("stages/frf.a.1.h5", "stages/modal.a.2.h5"))
    (told,) = summary.cautions(gone)
    assert told.startswith("stages/frf.a.1.h5 and 1 more are not in the folder")
    assert "copy folder results/x as a whole, or make it anew with ema run" in told


def test_cautions_of_one_kind_are_counted_rather_than_all_written_out(run: RunResults) -> None:
    c = run.configurations[0]
    assert c.modal is not None
    many = tuple(f"{n}.5 Hz of {b}.x has no mode" for n, b in enumerate("abcdefgh"))
    noted = replace(
        c, frfs=None, hits=(), pairing=None, modal=replace(c.modal, notes=(*many, "another matter"))
    )
    lines = summary.cautions(RunResults("x", configurations=(noted,)))
    assert lines[-3] == "0.5 Hz of a.x has no mode."
    assert lines[-2].endswith("(6 more of this kind.)")
    assert lines[-1] == "another matter."


def _printed(renderable: object, width: int, encoding: str = "utf-8") -> str:
    file = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    Console(file=file, width=width, no_color=True, force_terminal=False).print(renderable)
    file.flush()
    assert isinstance(file.buffer, io.BytesIO)
    return file.buffer.getvalue().decode(encoding)


@pytest.mark.parametrize("width", [40, 28])
def test_no_number_is_broken_on_a_narrow_terminal(run: RunResults, width: int) -> None:
    assert run.configurations[0].modal is not None
    modes = run.configurations[0].modal.modes
    told = _printed(terminal.modes_table(run.configurations[0].modal), width)
    for mode in modes:
        assert format_value(mode.frequency_hz, mode.frequency_std_hz) in told
    assert max(map(len, told.splitlines())) <= width
    assert "column" in told  # some stand below the others


def test_a_single_column_is_shown_however_narrow_the_terminal_is() -> None:
    one = tables.Table(("record",), (tables.Row(("sun_x_150N_1.uff",)),), frozenset())
    assert "sun_x_150N" in "".join(_printed(terminal.text_table(one, "Records"), 12).split())


def test_comparison_says_that_its_error_is_that_of_the_fit(run: RunResults) -> None:
    assert run.comparison is not None
    told = " ".join(_printed(terminal.comparison_tables(run.comparison), 80).split())
    assert "Root mean square: the error of the fit" in told
    assert "in the ladder parts deviate no further than similar ones scatter" in told


def test_comparison_names_modes_that_the_model_does_not_have(run: RunResults) -> None:
    assert run.comparison is not None
    alone = (ModeAlone("no_ring", 0, 26.357, 21.33, 0.998), ModeAlone("no_ring", 4, 107.98, np.nan, np.nan))
    with_alone = replace(run, comparison=replace(run.comparison, alone=alone))
    assert with_alone.comparison is not None
    told = " ".join(_printed(terminal.comparison_tables(with_alone.comparison), 80).split())
    assert "! no_ring: mode 1, 26.357 Hz, is none of the model's: that of its shape is at 21.330 Hz" in told
    assert "(+23.6 %, MAC 1.00)" in told
    assert "! no_ring: mode 5, 107.98 Hz, is none of the model's " in told
    assert "none of the model's" not in _printed(terminal.comparison_tables(run.comparison), 80)
    first, second = finite(summary_files.summary(with_alone))["comparison"]["alone"]
    assert (first["mode"], first["frequency_hz"], first["model_frequency_hz"]) == (1, 26.357, 21.33)
    assert first["frequency_difference_percent"] == pytest.approx(23.57, abs=0.01)
    assert second == {
        "configuration": "no_ring", "mode": 5, "frequency_hz": 107.98, "model_frequency_hz": None,
        "frequency_difference_percent": None, "mac": None,
    }  # fmt: skip
    caption = "Measured modes that the fitted model does not have"
    page = report_html(with_alone)
    assert re.search(r"26\.357</td><td[^>]*>21\.330</td><td[^>]*>\+23\.6</td>", page[page.index(caption) :])
    assert caption not in report_html(run)


def test_fit_and_comparison_say_what_epsilon_is(run: RunResults) -> None:
    assert run.fit is not None
    assert run.comparison is not None
    for table in (terminal.fit_table(run.fit, run.provisional), terminal.comparison_tables(run.comparison)):
        told = " ".join(_printed(table, 80).split())
        assert told.count("ε: the error function of the source papers, the sum over the paired modes") == 1


def test_epsilon_of_the_curves_is_not_taken_for_that_of_the_fit(run: RunResults) -> None:
    """Curves: the lowest modes and the nearest frequencies; the fitted model: all pairs."""
    assert run.fit is not None
    text = " ".join(report_html(run).split())
    assert "over the lowest modes, each with the nearest model frequency, against one stiffness" in text
    assert f"over the paired modes of all configurations, ε = {run.fit.frequency_error:.3g}." in text


def _tables(run: RunResults) -> list[object]:
    c = run.configurations[0]
    assert c.modal is not None
    assert run.comparison is not None
    assert run.fit is not None
    return [
        RunScreen(run, "out"),
        terminal.fit_table(run.fit, run.provisional),
        terminal.modes_table(c.modal),
        terminal.hits_table(c.hits),
        terminal.verdict_table(c.hits),
        terminal.comparison_tables(run.comparison),
    ]


@pytest.mark.parametrize("width", [80, 100])
def test_terminal_tables_fit_the_width_and_keep_numbers_whole(run: RunResults, width: int) -> None:
    for table in _tables(run):
        text = _printed(table, width)
        assert "\x1b" not in text
        assert max(len(line) for line in text.splitlines()) <= width
    for table in _tables(run)[1:]:
        assert not re.search(r"\d…|±\s*$", _printed(table, width), flags=re.MULTILINE)
    c = run.configurations[0]
    assert c.modal is not None
    text = _printed(terminal.modes_table(c.modal), width)
    assert all(format_value(m.frequency_hz, m.frequency_std_hz) in text for m in c.modal.modes)


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_comparison_of_two_configurations_is_whole_on_80_columns(run: RunResults, encoding: str) -> None:
    compared = run.comparison
    assert compared is not None
    text = _printed(terminal.comparison_tables(compared), 80, encoding)
    assert max(len(line) for line in text.splitlines()) <= 80
    assert "no_ring: per mode" in text
    assert "with_ring: per mode" in text
    heads = [
        line for line in text.splitlines() if {"damping", "MAC", "shape"} <= set(re.split(r"[ |]+", line))
    ]
    assert len(heads) == 2
    for m in compared.modes:
        value = format_value(m.measured_frequency_hz, m.frequency_std_hz)
        assert value.replace("±", "±" if encoding == "utf-8" else "+/-") in text


def test_names_of_fitted_parameters_are_broken_between_words_only(run: RunResults) -> None:
    assert run.fit is not None
    (first, *_) = run.fit.parameters.values()
    effect = replace(first, name="mesh_stiffness_loss@sun-planet1.fraction")
    fit = replace(run.fit, parameters={**run.fit.parameters, effect.name: effect})
    for width in (80, 70):
        words = _printed(terminal.fit_table(fit, run.provisional), width).split()
        assert {"stiffness", "loss", "sun-planet1,", "fraction"} <= set(words)


@pytest.mark.parametrize("width", [80, 45, 32])
def test_a_table_gives_way_where_it_has_blanks_and_loses_nothing(width: int) -> None:
    rows = (tables.Row(("one long remark that wraps", "12.345 ± 0.067", "frequency, shape"), False),)
    source = tables.Table(("what is said", "value in A, Hz", "changed"), rows, frozenset({1}))
    text = _printed(terminal.text_table(source, ""), width)
    assert max(len(line) for line in text.splitlines()) <= width
    assert {"remark", "12.345", "0.067", "frequency,", "shape"} <= set(text.split())
    assert ("12.345 ± 0.067" in text) == (width >= 45)


def test_terminal_tables_print_where_only_ascii_is_known(run: RunResults) -> None:
    text = "".join(_printed(t, 80, "ascii") for t in _tables(run))
    assert "9.98 +/- 0.31 MN/m" in text
    assert "NOT identified" in text


def test_brackets_in_file_names_are_printed_as_they_are(run: RunResults) -> None:
    hit = replace(next(h for h in run.configurations[0].hits if not h.accepted), file="[red]a[/x].uff")
    assert "[red]a[/x].uff" in _printed(terminal.hits_table((hit,), "[bold]t"), 100)


def test_the_column_of_the_circles_holds_what_the_remark_on_them_compares_with(run: RunResults) -> None:
    modal = next(c.modal for c in run.configurations if c.modal is not None)
    mode = next(m for m in modal.modes if len(m.circles) > 2)
    shifted = replace(mode.circles[0], natural_frequency_hz=1.2 * mode.circles[0].natural_frequency_hz)
    mode = replace(mode, circles=(shifted, *mode.circles[1:]))
    table = tables.modes_table(replace(modal, modes=(mode,)))
    told = float(table.rows[0].cells[table.head.index("circle: f, Hz")].partition(" ")[0])
    assert told == pytest.approx(average(mode.circles).frequency_hz, rel=1e-4)
    assert told != pytest.approx(shifted.natural_frequency_hz, rel=1e-2)
