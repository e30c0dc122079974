"""Diagnosis and ladder in the report, on the terminal and in summary.json."""

from __future__ import annotations

import io
import json
import math
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import report_example as example
from matplotlib.figure import Figure
from rich.console import Console

from ema_pipeline.commands.screen import show
from ema_pipeline.diagnose import sentences
from ema_pipeline.diagnose.explained import OutlyingPart
from ema_pipeline.diagnose.sentences import probability_text
from ema_pipeline.diagnose.types import (
    NOTHING,
    UNKNOWN,
    Candidate,
    DetectionLimit,
    Diagnosis,
    EffectSize,
    Ladder,
    LearnedScatter,
    Localisation,
    Rung,
    VerdictWord,
)
from ema_pipeline.fit.types import ErrorSweep
from ema_pipeline.number_text import below
from ema_pipeline.report import diagnosis, diagnosis_tables, page_top, run_screen, summary, tables, terminal
from ema_pipeline.report.figures.diagnosis import ladder_errors, where_it_fails
from ema_pipeline.report.html import bokeh_script, report_html
from ema_pipeline.report.plots import figure_specs
from ema_pipeline.report.results import RunResults
from ema_pipeline.report.run_screen import next_lines
from ema_pipeline.report.summary_files import write_summary

CRACK = "mesh_stiffness_loss@sun-planet1"
OTHER = "planet_bearing_mistune@planet2"
SUPPORT = "flexible_support@ring"


def size(value: float, std: float, unit: str = "1") -> EffectSize:
    return EffectSize(value, std, unit)


def candidate(label: str, probability: float, after: float, held: float, **changes: object) -> Candidate:
    effect, _, at = label.partition("@")
    made = Candidate(
        effect,
        at,
        "one mesh softer than the others",
        probability,
        {"fraction": size(0.34, 0.0102)},
        3.1,
        after,
        3.3,
        held,
        120.0 if after < 2 else 1.5,
        11.0,
        False,
        f"Its signs: mode pairs split. The misfit falls most at 1441.9 Hz for {at}.",
    )
    return replace(made, **changes)  # type: ignore[arg-type]


def rung(effects: tuple[str, ...], error: float, held: float, left: int) -> Rung:
    sizes = {"sun_bearing_stiffness": size(2e6, 1e5, "N/m")} | {
        f"{e}.fraction": size(0.34, 0.0102) for e in effects if not e.startswith("out_of_tolerance")
    }
    return Rung(effects, error, held, 100.0, sizes, 55.0 if effects else 0.0, left)


def found(verdict: VerdictWord) -> Diagnosis:
    claims = verdict == "effect"
    probability = {"effect": 0.97, "ambiguous": 0.5, "unknown_effect": 0.93}.get(verdict, 0.04)
    rungs = [rung((), 3.1, 3.3, 2)]
    if verdict in ("effect", "ambiguous", "unknown_effect"):
        rungs.append(rung((CRACK,), 1.02 if verdict != "unknown_effect" else 2.4, 1.05, 0))
    candidates = (
        candidate(CRACK, probability, rungs[-1].error, 1.05, claimed=claims),
        candidate(OTHER, 0.45 if verdict == "ambiguous" else 0.01, 1.03, 1.06),
        candidate(SUPPORT, 0.005, 3.0, math.nan),
    )
    null = 0.9 if verdict in ("adequate", "not_enough_data") else 1e-7
    shares = {"nothing": null} | {c.label: c.probability for c in candidates}
    shares["spring@sun.x"] = 1 - math.fsum(shares.values())
    return Diagnosis(
        verdict,
        "What was found, in a sentence.",
        null,
        candidates,
        ((CRACK, OTHER),) if verdict == "ambiguous" else (),
        "A known mass of 0.05 kg at planet1 would tell them apart: 4.2 σ." if verdict == "ambiguous" else "",
        (Localisation("planet1.x-sun.x", "stiffness", -3.1e6, 812.0),) if verdict == "unknown_effect" else (),
        shares,
        3.1,
        3.3,
        Ladder(tuple(rungs), 1e-4, 0.03, 0.01, "no further effect is supported by the data"),
        ("with_ring: single hits of carrier.y scatter by 18 %",),
    )


VERDICTS: tuple[VerdictWord, ...] = ("adequate", "effect", "ambiguous", "unknown_effect", "not_enough_data")


@pytest.fixture(scope="module")
def base() -> RunResults:
    return example.planetary_run(lines=257)


@pytest.fixture(scope="module")
def run(base: RunResults) -> RunResults:
    assert base.comparison is not None
    better = replace(base.comparison, modes=tuple(replace(m, frequency_z=0.3) for m in base.comparison.modes))
    return replace(base, diagnosis=found("effect"), comparison_after=better)


def drawn(results: RunResults) -> dict[str, Figure]:
    return {s.name: s.draw() for s in figure_specs(results) if s.section == "diagnosis"}


def page(results: RunResults) -> str:
    """The report's text without the drawing library."""
    return report_html(results).replace(bokeh_script(), "")


def printed(renderable: object, width: int = 80, encoding: str = "utf-8") -> str:
    file = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    Console(file=file, width=width, no_color=True, highlight=False).print(renderable, crop=False)
    file.flush()
    assert isinstance(file.buffer, io.BytesIO)
    return file.buffer.getvalue().decode(encoding)


def flowing(text: str) -> str:
    return re.sub(r"\s+", " ", text)


# words


@pytest.mark.parametrize(
    ("verdict", "expected"),
    [
        ("adequate", "Nothing is missing as far as these data can tell"),
        ("effect", "Missing: mesh stiffness loss at sun-planet1"),
        ("ambiguous", "Two effects explain the data equally well"),
        ("unknown_effect", "Something is missing that is not in the library"),
        ("not_enough_data", "Not enough data to show what is missing"),
    ],
)
def test_every_verdict_has_its_plain_heading(verdict: VerdictWord, expected: str) -> None:
    assert diagnosis.heading(found(verdict)) == expected


def test_the_heading_of_an_adequate_model_names_the_effects_that_it_has() -> None:
    told = found("adequate")
    with_crack = replace(told, ladder=replace(told.ladder, rungs=(rung((CRACK,), 0.9, 0.9, 0),)))
    expected = "With mesh stiffness loss at sun-planet1 nothing is missing as far as these data can tell"
    assert diagnosis.heading(with_crack) == expected


def test_what_is_missing_may_be_in_the_library_where_the_best_candidate_would_explain_the_data() -> None:
    told = found("unknown_effect")
    near = replace(told, candidates=(replace(told.candidates[0], claimed=False, error_after=1.1),))
    expected = "Something is missing, and no effect is supported enough to be named"
    assert diagnosis.heading(near) == expected
    far = replace(told, candidates=(replace(near.candidates[0], error_after=2.0),))
    assert diagnosis.heading(far) == diagnosis.heading(told) != expected
    nothing_gained = replace(told, candidates=(replace(near.candidates[0], log_evidence=-2.3),))
    assert diagnosis.heading(nothing_gained) == diagnosis.heading(told)
    best = ("mass@m1", "Not claimed: its gain in log evidence, 3.4, is below 3.5.")
    told_of_best = sentences.summary("unknown_effect", [], (2.1, 2.1), 0.0, best, "Parts deviate.")
    assert told_of_best == (
        "The model does not explain the data (error 2.10), and no effect in the library is supported enough to be "
        "claimed. The best candidate is mass at m1. Not claimed: its gain in log evidence, 3.4, is below 3.5. "
        "Parts deviate."
    )
    scatters = sentences.summary("unknown_effect", [], (0.9, 0.9), 0.0, reasons="Damping ratios scatter.")
    assert scatters.startswith(
        "The model does not explain the data (though its error is 0.90), and no effect"
    )
    without = sentences.summary("unknown_effect", [], (2.1, 2.1), 0.0)
    assert (
        without
        == "The model does not explain the data (error 2.10), and no effect in the library corrects this."
    )


def test_what_is_claimed_of_a_model_that_fails_is_in_the_heading() -> None:
    told = found("unknown_effect")
    closest = replace(told, candidates=(replace(told.candidates[0], claimed=True), *told.candidates[1:]))
    assert diagnosis.heading(closest) == (
        "Something is missing that the library does not explain; closest to it: mesh stiffness loss at sun-planet1"
    )
    assert run_screen._diagnosed(closest) == f"{diagnosis.heading(closest)} (error 3.10 → 2.40)."
    assert run_screen._diagnosed(told) == f"{diagnosis.heading(told)} (error 3.10)."


def test_three_that_fit_alike_are_counted_in_the_heading() -> None:
    three = replace(found("ambiguous"), indistinguishable=((CRACK, OTHER, SUPPORT),))
    assert diagnosis.heading(three) == "Three effects explain the data equally well"


def test_what_is_claimed_beside_effects_that_fit_alike_is_told_with_them() -> None:
    one = found("ambiguous")
    sure, *others = one.candidates
    both = replace(
        one,
        candidates=(replace(sure, claimed=True), *others),
        indistinguishable=((OTHER, SUPPORT), (CRACK, "x@y")),
    )
    assert diagnosis.heading(both) == (
        "Missing: mesh stiffness loss at sun-planet1; beside it, two effects explain the data equally well"
    )
    assert [c.label for c in diagnosis.leading(both)] == [CRACK, OTHER, SUPPORT]
    words = [diagnosis.standing(both, c) for c in both.candidates]
    assert words == ["supported", "fits equally well", "fits equally well"]
    with_another = replace(sure, claimed=True, error_after=3.2)  # its fit bends parts for the other one
    assert diagnosis.standing(both, with_another) == "supported, not alone"
    pair = replace(found("effect"), candidates=(with_another, *one.candidates[1:]))
    assert "(probability 50 %, beside the others)" in diagnosis.compact(pair)
    assert diagnosis.next_commands(both, "out") == (
        f"ema add out {CRACK} {OTHER}",
        f"ema add out {CRACK} {SUPPORT}",
    )
    assert diagnosis.next_commands(both, "out", (CRACK,))[0] == f"ema add out {OTHER}"
    told = run_screen._diagnosed(both)
    assert told.startswith(
        "Missing: mesh stiffness loss at sun-planet1, fraction 0.340 ± 0.010. Beside it, two"
    )
    assert told.count("mesh stiffness loss") == 1
    text = sentences.summary(
        "ambiguous", [("a@x", "1 N"), ("b@y", "2 N")], (3.1, 1.0), 0.0, beside=[("c@z", "3 N")]
    )
    assert text == (
        "Missing from the model: c at z, 3 N. Beside it, several effects explain the data equally well: a at x, 1 N; "
        "b at y, 2 N. Adding it and one of them reduces the error from 3.10 to 1.00."
    )


def test_a_parameter_whose_change_is_the_same_is_told_with_what_is_missing() -> None:
    one = found("effect")
    claimed, *others = one.candidates

    def told(*equivalents: str) -> str:
        return run_screen._diagnosed(
            replace(one, candidates=(replace(claimed, equivalents=equivalents), *others))
        )

    plain = told()
    assert plain == told("spring@sun-planet1", "mesh_stiffness_loss@sun-planet1.x")
    assert told("out_of_tolerance@k8") == plain.replace(
        " (probability", ", or parameter k8 out of tolerance (probability"
    )


def test_probability_is_never_rounded_to_certainty_or_to_nothing() -> None:
    words = [probability_text(p) for p in (1.0, 0.99951, 0.9949, 0.97, 0.5, 0.032, 0.0004, 0.0)]
    assert words == [">99.9 %", ">99.9 %", "99.5 %", "97 %", "50 %", "3.2 %", "<0.1 %", "<0.1 %"]
    assert probability_text(0.9951) != "100 %"


def test_commands_add_what_is_claimed_and_leave_out_what_is_in_the_model() -> None:
    assert diagnosis.next_commands(found("effect"), "results/a b") == (
        f"ema add 'results/a b' {CRACK}",
        "ema ladder 'results/a b'",
    )
    assert diagnosis.next_commands(found("effect"), "r", added=(CRACK,)) == ()
    assert diagnosis.next_commands(found("ambiguous"), "r") == (f"ema add r {CRACK}", f"ema add r {OTHER}")
    assert diagnosis.next_commands(found("adequate"), "r") == ()


def test_commands_are_neither_broken_nor_cut_on_a_narrow_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    show(terminal.diagnosis_screen(found("effect"), 20 * "long/"))
    lines = capsys.readouterr().out.splitlines()
    assert f"  ema add {20 * 'long/'} {CRACK}" in lines
    assert sum(len(line) > 80 for line in lines) == 2


def test_every_command_shown_names_the_files_whose_code_it_needs(run: RunResults) -> None:
    files = ("my film.py",)
    named = " --effect-file 'my film.py'"
    mine = replace(run, effect_files=files)
    assert next_lines(mine, "out", "ema") == (f"ema add out {CRACK}{named}",)
    assert next_lines(replace(mine, added=(CRACK,)), "out", "ema") == (f"ema diagnose out{named}",)
    for results in (mine, replace(mine, added=(CRACK,))):
        shown = page_top.page_top(results).commands
        assert shown
        assert all(text.endswith(named) for text in shown)
    screen = printed(terminal.diagnosis_screen(found("effect"), "out", effect_files=files))
    assert f"  ema add out {CRACK}{named}\n  ema ladder out{named}\n" in screen
    unknown = diagnosis.next_commands(found("unknown_effect"), "r", (), files)
    assert unknown == (f"ema compare r{named}", f"ema diagnose r{named} --effect-file my_effect.py")


def test_rung_says_what_it_adds_with_its_size_and_not_the_rigs_parameters() -> None:
    two = Ladder((rung((), 3, 3, 0), rung((CRACK,), 2, 2, 0), rung((CRACK, OTHER), 1, 1, 0)), 0, 0, 0, "")
    rows = diagnosis_tables.ladder_table(two).rows
    assert [r.cells[0] for r in rows] == [
        "base model",
        "+ mesh stiffness loss at sun-planet1",
        "+ planet bearing mistune at planet2",
    ]
    assert [r.cells[1] for r in rows] == ["", "fraction 0.340 ± 0.010", "fraction 0.340 ± 0.010"]


def test_size_of_a_parameter_out_of_tolerance_is_found_under_the_parameters_name() -> None:
    label = "out_of_tolerance@sun_bearing_stiffness"
    ladder = Ladder((rung((), 3, 3, 0), rung((label,), 1, 1, 0)), 0, 0, 0, "")
    cells = diagnosis_tables.ladder_table(ladder).rows[1].cells
    assert cells[0] == "+ parameter sun bearing stiffness out of tolerance"
    assert cells[1] == "sun bearing stiffness 2.00 ± 0.10 MN/m"


def test_another_error_of_the_ladder_for_the_fitted_model_is_explained(run: RunResults) -> None:
    assert run.fit is not None
    for error, told in ((3.1, False), (2.0, True)):
        lines = summary.findings(replace(run, fit=replace(run.fit, error=error)))
        mine = [line for line in lines if "state an error of 3.10 for this model" in line]
        assert len(mine) == told
        assert not any("single hits" in line for line in mine)


def test_findings_begin_with_the_diagnosis(run: RunResults) -> None:
    first = summary.findings(run)[0]
    assert first.startswith("Diagnosis: missing: mesh stiffness loss at sun-planet1, fraction 0.340 ± 0.010")
    assert "probability 97 %" in first
    assert "error 3.10 → 1.02" in first
    assert "2 before, 0 after" in first
    good = summary.findings(replace(run, diagnosis=found("adequate")))[0]
    assert "nothing is missing" in good
    assert "probability 90 %" in good


def test_mac_just_under_the_limit_is_not_shown_as_the_limit(base: RunResults) -> None:
    assert [below(v, 0.8) for v in (0.6512, 0.7987, 0.79996)] == ["0.65", "0.799", "0.79996"]
    assert below(0.7999999, 0.8) == "just under 0.8"
    c = base.configurations[0]
    assert c.pairing is not None
    pairs = (replace(c.pairing.pairs[0], mac=0.7984),)
    run = RunResults("x", configurations=(replace(c, pairing=replace(c.pairing, pairs=pairs)),))
    text = " ".join(summary.cautions(run))
    assert "(0.798)" in text
    assert "(0.80)" not in text


def test_flat_error_functions_of_one_stiffness_make_one_caution(base: RunResults) -> None:
    assert base.fit is not None
    x = np.geomspace(1e6, 1e9, 5)

    def flat(modes: int, rise: float) -> ErrorSweep:
        error = np.array([1.0, 1.0, 1.0, 1.0, 1.0 + rise])
        return ErrorSweep("sun_planet_mesh_stiffness", "no_ring", modes, x, error, 1e6, 0.0, False, "flat: …")

    run = replace(base, fit=replace(base.fit, sweeps=(flat(3, 0.05), flat(4, 0.06))))
    told = [c for c in summary.cautions(run) if "ε of" in c]
    assert told == [
        "ε of sun planet mesh stiffness (no_ring) determines nothing with 3 or 4 modes: "
        "it changes by 5.0–6.0 % over the sweep."
    ]


# figures


def test_bars_of_the_candidates_are_their_probabilities_and_add_up_to_one(run: RunResults) -> None:
    ax = drawn(run)["diagnosis_candidates"].axes[0]
    names = [t.get_text().replace("\n", " ") for t in ax.get_yticklabels()]
    widths = [p.get_width() for p in ax.patches]  # type: ignore[attr-defined]
    assert names[0] == "mesh stiffness loss at sun-planet1"
    assert names[-1] == "nothing missing at all"
    assert widths[:3] == [0.97, 0.01, 0.005]
    assert sum(widths) == pytest.approx(1.0)
    assert next(t.get_text() for t in ax.texts) == "97 % ◆"
    assert not any("◆" in t.get_text() for t in ax.texts[1:])


def test_ladder_figure_shows_both_errors_with_differing_marks(run: RunResults) -> None:
    ax = drawn(run)["diagnosis_ladder"].axes[0]
    lines = {str(line.get_label()): line for line in ax.lines}
    np.testing.assert_allclose(lines["data fitted"].get_ydata(), [3.1, 1.02])
    np.testing.assert_allclose(lines["data held out"].get_ydata(), [3.3, 1.05])
    np.testing.assert_allclose(lines["about 1: explained"].get_ydata(), 1.0)
    assert lines["data fitted"].get_marker() != lines["data held out"].get_marker()
    assert lines["data fitted"].get_linestyle() != lines["data held out"].get_linestyle()
    assert ax.get_yscale() == "log"
    ticks = [t.get_text().replace("\n", " ") for t in ax.get_xticklabels()]
    assert ticks == ["base model 2 modes unexplained", "+ mesh stiffness loss at sun-planet1"]


def test_ladder_of_the_user_is_shown_before_that_of_the_diagnosis(run: RunResults) -> None:
    mine = Ladder((rung((), 9.0, 9.5, 0), rung((SUPPORT,), 8.0, 8.5, 0)), 1e-4, 0.03, 0.01, "")
    own = replace(run, ladder=mine)
    assert own.shown_ladder is mine
    ax = drawn(own)["diagnosis_ladder"].axes[0]
    assert "+ flexible support" in ax.get_xticklabels()[1].get_text().replace("\n", " ")
    assert "with the effects that were added" in page(own)


def test_modes_without_partner_stand_out_where_the_model_fails(run: RunResults) -> None:
    figure = drawn(run)["diagnosis_where"]
    ax = figure.axes[0]
    hatches = [p.get_hatch() for p in ax.patches]
    lone = sum(len(c.pairing.unpaired_measured) for c in run.configurations if c.pairing)
    assert lone == 2
    assert hatches.count("xxxx") == lone
    assert run.comparison is not None
    assert len(ax.get_xticklabels()) == len(run.comparison.modes) + lone
    after = [line for line in ax.lines if line.get_marker() == "D" and len(np.asarray(line.get_xdata()))]
    assert len(after) == len(run.comparison.modes)


def test_worst_body_has_the_largest_and_darkest_mark_on_the_gear(run: RunResults) -> None:
    gear = drawn(run)["diagnosis_where"].axes[1]
    texts = [t.get_text() for t in gear.texts]
    discs = [line for line in gear.lines if line.get_markersize() > 5]
    worst = max(discs, key=lambda line: line.get_markersize())
    assert texts[discs.index(worst)] == "6.1"  # planet2, see the example
    assert len({line.get_markerfacecolor() for line in discs}) > 1


@pytest.mark.parametrize("rungs", [1, 2, 4, 7])
def test_labels_of_many_rungs_do_not_overlap(rungs: int) -> None:
    effects = (CRACK, OTHER, SUPPORT, "shaft_coupling@carrier-sun", "sensor_mass@all", "local_damper@planet2")
    ladder = Ladder(tuple(rung(effects[:k], 9.0 / (k + 1), 8.0, 7 - k) for k in range(rungs)), 0, 0, 0, "")
    figure = ladder_errors(ladder)
    figure.canvas.draw()
    renderer = figure.canvas.get_renderer()  # type: ignore[attr-defined]
    ax = figure.axes[0]
    boxes = [t.get_window_extent(renderer) for t in ax.get_xticklabels()]
    legend = figure.legends[0].get_window_extent(renderer)
    assert not any(a.overlaps(b) for a, b in pairwise(boxes))
    assert not any(legend.overlaps(b) for b in boxes)


def test_figure_says_so_where_no_mode_differs(base: RunResults) -> None:
    assert base.comparison is not None
    still = [replace(m, frequency_z=0.1, damping_z=math.nan, shape_z=0.2) for m in base.comparison.modes]
    ax = where_it_fails(replace(base.comparison, modes=tuple(still)), [None], {}).axes[0]
    assert "all differences are under 0.5σ" in [t.get_text() for t in ax.texts]


@pytest.mark.parametrize("verdict", VERDICTS)
def test_nothing_in_the_diagnosis_figures_leaves_them(base: RunResults, verdict: VerdictWord) -> None:
    for name, figure in drawn(replace(base, diagnosis=found(verdict))).items():
        figure.canvas.draw()
        renderer = figure.canvas.get_renderer()  # type: ignore[attr-defined]
        for ax in figure.axes:
            texts = [*ax.texts, ax.title, ax.xaxis.label, ax.yaxis.label]
            texts += [t for t in (*ax.get_xticklabels(), *ax.get_yticklabels()) if ax.axison]
            for text in texts:
                if not text.get_text() or (not ax.axison and text in (ax.xaxis.label, ax.yaxis.label)):
                    continue
                box = text.get_window_extent(renderer)
                inside = (
                    box.x0 > -1
                    and box.y0 > -1
                    and box.x1 < figure.bbox.x1 + 1
                    and box.y1 < figure.bbox.y1 + 1
                )
                assert inside, f"{name}: '{text.get_text()}'"


# report


def test_report_begins_with_the_verdict_its_numbers_and_the_command(run: RunResults) -> None:
    html = page(replace(run, folder="results/a b"))
    assert re.findall(r'<section id="(\w+)"', html)[:3] == ["summary", "frf", "model"]
    band = html[html.index('<section id="summary"') : html.index('<section id="frf"')]
    assert "<h2>Missing: mesh stiffness loss at sun-planet1</h2>" in band
    assert "Its signs: mode pairs split. The misfit falls most at 1441.9 Hz for sun-planet1." in band
    assert re.findall(r'class="was">([^<]*)<.*?<strong>([^<]*)<', band)[:2] == [
        ("3.10", "1.02"),
        ("3.30", "1.05"),
    ]
    assert "ema add &#39;results/a b&#39; mesh_stiffness_loss@sun-planet1" in band
    assert "scatter by 18 %" in band
    assert band.count('class="named"') == 2  # the sun and planet 1 are marked


def test_report_lists_the_candidates_with_size_probability_and_drop(run: RunResults) -> None:
    html = page(run)
    text = html[html.index('<section id="model"') : html.index('<section id="modes"')]
    for needed in ("fraction 0.340 ± 0.010", "97 %", "3.10 → 1.02", "3.30 → 1.05", "not enough evidence"):
        assert needed in text
    assert "no further effect is supported by the data" in text
    assert "Where the misfit sits" not in text


def test_errors_without_an_effect_that_differ_by_row_are_explained(run: RunResults) -> None:
    assert run.diagnosis is not None
    told = "σ includes the scatter of parts and sensors that is learned with each effect"
    first, *others = run.diagnosis.candidates
    one = replace(run.diagnosis, candidates=(first, *(replace(c, error_before=2.18) for c in others)))
    assert told in flowing(printed(terminal.diagnosis_screen(one)))
    assert told in page(replace(run, diagnosis=one))
    assert told not in flowing(printed(terminal.diagnosis_screen(run.diagnosis)))
    assert told not in page(run)


def test_scatter_of_the_other_parts_is_not_taken_for_the_learned_one() -> None:
    said = sentences.standing_out([OutlyingPart("sun_planet_mesh_stiffness[1]", 0.23, 0.014)])
    assert said.startswith(
        "To follow the data the model must let parts deviate further than similar ones do: sun"
    )
    assert "+23 %. The others alone scatter by 1.4 % (1 σ); the learned scatter includes these parts." in said


def test_an_adequate_model_with_a_likely_candidate_says_which_and_why_it_is_not_claimed() -> None:
    best = ("spring@m2.x", "Not claimed: its size is within 2 standard deviations of zero.")
    doubtful = sentences.summary("adequate", [], (1.2, 1.2), 0.04, best)
    assert doubtful == (
        "The model explains the data: error 1.20. Probability that nothing is missing that these data would show: "
        "4.0 %. The best candidate is spring at m2.x. Not claimed: its size is within 2 standard deviations of zero."
    )
    assert "candidate" not in sentences.summary("adequate", [], (1.2, 1.2), 0.04)


def test_an_adequate_verdict_has_the_probability_that_nothing_is_missing_that_would_show() -> None:
    one = replace(found("adequate"), nothing_visible=0.985)
    assert "(probability 98 %, error 3.10)." in run_screen._diagnosed(one)
    assert "Perhaps" not in run_screen._diagnosed(one)
    assert diagnosis.compact(one).startswith(
        "Diagnosis: nothing is missing as far as these data can tell (probability 98 %)"
    )
    doubtful = replace(one, null_probability=0.3)
    assert run_screen._diagnosed(doubtful).endswith(
        "Perhaps mesh stiffness loss at sun-planet1 (4.0 %, sizes that would not show included), not supported enough "
        "to be claimed."
    )
    assert replace(one, nothing_visible=math.nan).adequate_probability == one.null_probability == 0.9


def test_the_probability_of_what_the_library_lacks_is_told_where_it_is_worth_a_word() -> None:
    one = found("unknown_effect")
    assert any(
        line.startswith("Nothing missing at all has probability <0.1 %; less")
        for line in page_top._against(one)
    )
    lacking = replace(one, null_probability=0.0, probabilities={NOTHING: 0.0, UNKNOWN: 0.5})
    assert any(
        line.startswith(
            "Nothing missing at all has probability <0.1 %, an effect that is not in the library 50 %; "
        )
        for line in page_top._against(lacking)
    )


def test_the_sentence_on_what_is_missing_names_one_effect_or_several() -> None:
    crack, mass = (CRACK, "fraction 0.34 ± 0.01"), ("mass@sun", "mass 0.1 ± 0.01 kg")
    one, two = (sentences.summary("effect", named, (3.1, 1.02), 0.0) for named in ([crack], [crack, mass]))
    named = "Missing from the model: mesh stiffness loss at sun-planet1, fraction 0.34 ± 0.01"
    assert one == f"{named}. Adding this reduces the error from 3.10 to 1.02."
    assert (
        two == f"{named}; mass at sun, mass 0.1 ± 0.01 kg. Adding these reduces the error from 3.10 to 1.02."
    )


def test_report_without_diagnosis_marks_no_place(base: RunResults) -> None:
    html = page(base)
    assert 'class="candidates"' not in html
    assert 'class="named"' not in html


def test_report_names_what_cannot_be_told_apart_and_what_to_measure(base: RunResults) -> None:
    html = page(replace(base, diagnosis=found("ambiguous")))
    assert "Two effects explain the data equally well" in html
    assert (
        "These data cannot tell apart: mesh stiffness loss at sun-planet1; planet bearing mistune at planet2."
        in html
    )
    assert "A known mass of 0.05 kg at planet1" in html


def test_report_says_where_an_unknown_effect_sits(base: RunResults) -> None:
    html = page(replace(base, diagnosis=found("unknown_effect")))
    row = html[html.index("planet1.x-sun.x") :][:200]
    assert "stiffness" in row
    assert "−3.100 MN/m" in row


# terminal


@pytest.mark.parametrize("verdict", VERDICTS)
@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_screens_fit_80_columns_without_colour(verdict: VerdictWord, encoding: str) -> None:
    told = found(verdict)
    for screen in (terminal.diagnosis_screen(told, "results/a"), terminal.ladder_screen(told.ladder)):
        text = printed(screen, 80, encoding)
        assert "\x1b" not in text
        assert "?" not in text
        assert max(len(line) for line in text.splitlines()) <= 80


def test_diagnosis_screen_tells_all_that_matters() -> None:
    text = printed(terminal.diagnosis_screen(found("ambiguous"), "results/a"))
    plain = flowing(text)
    assert plain.startswith("Two effects explain the data equally well What was found, in a sentence.")
    assert "fraction 0.340 ± 0.010" in text  # never broken
    assert "The misfit falls most at 1441.9 Hz for sun-planet1." in plain
    assert "The misfit falls most at 1441.9 Hz for planet2." in plain
    assert "Measure next: A known mass of 0.05 kg" in plain
    assert f"  ema add results/a {CRACK}\n  ema add results/a {OTHER}" in text
    marked = [line for line in text.splitlines() if line.startswith("!")]
    assert len(marked) == 4  # both of the group, the group in words, the note of the screening


def test_ladder_screen_shows_the_error_falling() -> None:
    text = printed(terminal.ladder_screen(found("effect").ladder))
    rows = [line for line in text.splitlines() if re.search(r"\d\.\d\d +\d\.\d\d +\d", line)]
    assert re.findall(r"(\d\.\d\d) +(\d\.\d\d) +(\d)", rows[0]) == [("3.10", "3.30", "2")]
    assert re.findall(r"(\d\.\d\d) +(\d\.\d\d) +(\d)", rows[1]) == [("1.02", "1.05", "0")]
    assert "0.010 % of frequency" in flowing(text)


def test_next_command_of_the_page_is_what_is_left_to_do(run: RunResults) -> None:
    """After a change the diagnosis again; not once it has been repeated."""

    def commands(verdict: VerdictWord, **changes: object) -> tuple[str, ...]:
        results = replace(run, diagnosis=found(verdict), folder="out", **changes)  # type: ignore[arg-type]
        return page_top.page_top(results).commands

    again = ("ema diagnose out", f"ema remove out {CRACK}")
    assert commands("effect", added=(CRACK,)) == again
    assert commands("ambiguous", added=(CRACK,)) == again  # and not its equivalent on top of it
    assert commands("adequate", added=(CRACK,), diagnosed_on=(CRACK,)) == ()
    assert commands("effect", added=(OTHER,), diagnosed_on=(OTHER,))[0] == f"ema add out {CRACK}"


def test_next_command_can_be_pasted_and_is_not_told_twice(run: RunResults) -> None:
    assert next_lines(run, "out", ".venv/bin/ema") == (f".venv/bin/ema add out {CRACK}",)
    taken = replace(run, added=(CRACK,))
    assert next_lines(taken, "out", "ema") == ("ema diagnose out",)


# summary.json


def test_summary_json_holds_diagnosis_and_ladder_as_agreed(run: RunResults, tmp_path: Path) -> None:
    write_summary(run, tmp_path / "summary.json")
    text = (tmp_path / "summary.json").read_text(encoding="utf-8")
    content = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    told = content["diagnosis"]
    assert told["verdict"] == "effect"
    first, _, third = told["candidates"]
    assert (first["effect"], first["at"], first["probability"]) == (
        "mesh_stiffness_loss",
        "sun-planet1",
        0.97,
    )
    assert first["parameters"] == {"fraction": {"value": 0.34, "std": 0.0102, "unit": "1"}}
    assert (first["error_before"], first["error_after"], first["heldout_error_after"]) == (3.1, 1.02, 1.05)
    assert third["heldout_error_after"] is None
    assert math.fsum(told["probabilities"].values()) == pytest.approx(1.0)
    assert told["probabilities"]["nothing"] == told["nothing_missing_probability"]
    assert (told["indistinguishable"], told["next_measurement"]) == ([], "")
    assert [(r["effects"], r["error"], r["heldout_error"]) for r in content["ladder"]] == [
        ([], 3.1, 3.3),
        ([CRACK], 1.02, 1.05),
    ]
    assert content["ladder"][1]["parameters"][f"{CRACK}.fraction"]["value"] == 0.34


def test_summary_json_before_a_diagnosis_has_neither(base: RunResults, tmp_path: Path) -> None:
    write_summary(base, tmp_path / "summary.json")
    content = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert not {"diagnosis", "ladder"} & set(content)


# detection limits, scatter, other names


def test_other_names_of_the_same_change_are_told() -> None:
    named = replace(candidate(CRACK, 0.97, 1.02, 1.05), claimed=True, equivalents=("spring@sun.u",))
    told = replace(found("effect"), candidates=(named,))
    assert "Also called: spring at sun.u." in diagnosis.reasons(told)[0]


def test_scatter_stands_as_stated_and_as_learned() -> None:
    scatter = (LearnedScatter("part_scatter", "stiffness of parts", 0.02, 0.0314),)
    ladder = replace(found("adequate").ladder, scatters=scatter)
    (row,) = diagnosis_tables.scatter_table(ladder).rows
    assert row.cells == ("stiffness of parts", "2.0 %", "3.1 %")
    shown = flowing(printed(terminal.diagnosis_screen(replace(found("adequate"), ladder=ladder))))
    assert "stiffness of parts" in shown


LIMITS = (
    DetectionLimit("mesh_stiffness_loss@sun-planet1", "fraction", 0.021, "1"),
    DetectionLimit("mesh_stiffness_loss@ring-planet1", "fraction", math.inf, "1"),
    DetectionLimit("shaft_torsion@sun", "stiffness", 8210.0, "N/m"),
    DetectionLimit("out_of_tolerance@sun_mass", "sun_mass", 0.07, "1"),
)


def test_detection_limits_are_told_by_effect_with_best_and_worst_place() -> None:
    d = replace(found("adequate"), detection_limits=LIMITS)
    assert diagnosis.detection_words(d) == (
        "These data would show, nine times in ten and at the best place: mesh stiffness loss ≥ 2.1 %, "
        "shaft torsion ≥ 8.2 kN/m."
    )
    rows = [r.cells for r in diagnosis_tables.detection_table(d).rows]
    assert rows[0] == ("mesh stiffness loss", "fraction", "2.1 % (sun-planet1)", "no size (ring-planet1)")
    assert rows[2] == ("out of tolerance", "deviation", "7.0 % (sun mass)", "")
    teeth = (
        DetectionLimit("mesh_backlash@ring-planet1", "preload", 0.0, "m", largest=True),
        DetectionLimit("mesh_backlash@sun-planet1", "preload", 4.8e-6, "m", largest=True),
    )
    of_teeth = replace(found("adequate"), detection_limits=teeth)
    assert diagnosis.detection_words(of_teeth).endswith("at the best place: mesh backlash ≤ 4.8 µm.")
    (row,) = diagnosis_tables.detection_table(of_teeth).rows
    assert row.cells == ("mesh backlash", "preload", "up to 4.8 µm (sun-planet1)", "no size (ring-planet1)")
    assert diagnosis.detection_words(replace(of_teeth, detection_limits=teeth[:1])) == ""
    assert "mesh stiffness loss ≥ 2.1 %" in flowing(printed(terminal.diagnosis_screen(d)))
    assert diagnosis.detection_words(found("adequate")) == ""


def test_summary_holds_what_the_data_would_show(run: RunResults, tmp_path: Path) -> None:
    assert run.diagnosis is not None
    d = replace(run.diagnosis, detection_limits=LIMITS)
    write_summary(replace(run, diagnosis=d), tmp_path / "summary.json")
    content = json.loads((tmp_path / "summary.json").read_text())["diagnosis"]
    assert content["detection_limits"][0] == {
        "effect": "mesh_stiffness_loss@sun-planet1", "parameter": "fraction", "size": 0.021, "unit": "1",
        "largest": False,
    }  # fmt: skip
    assert content["detection_limits"][1]["size"] is None  # JSON has no infinity


def test_values_of_a_model_that_fails_are_not_called_identified(run: RunResults) -> None:
    assert run.fit is not None
    (first, *_) = (p for p in run.fit.parameters.values() if p.identified)
    alone = replace(run, diagnosis=None)
    good, failing = (replace(alone, fit=replace(run.fit, error=error)) for error in (1.1, 6.3))
    assert summary.identified_words(first, good.provisional) == "identified by the data"
    assert "identified" not in summary.identified_words(first, failing.provisional)
    states = {r.cells[5] for r in tables.parameters_table(run.fit, failing.provisional).rows}
    assert "identified" not in states
    assert "provisional" in states


@pytest.mark.parametrize(
    ("verdict", "old", "error", "provisional"),
    [
        ("effect", False, 1.1, True),  # parts were bent to the data
        ("unknown_effect", False, 1.1, True),
        ("adequate", False, 1.4, False),
        ("not_enough_data", False, 1.1, False),
        ("effect", True, 1.1, False),  # of another model
        ("adequate", True, 1.4, True),
    ],
)
def test_values_are_provisional_where_the_diagnosis_of_this_model_finds_that_it_lacks_something(
    run: RunResults, verdict: VerdictWord, old: bool, error: float, provisional: bool
) -> None:
    assert run.fit is not None
    assert run.diagnosis is not None
    told = replace(
        run, fit=replace(run.fit, error=error), diagnosis=replace(run.diagnosis, verdict=verdict),
        diagnosed_on=("mass@sun",) if old else run.added,
    )  # fmt: skip
    assert told.provisional is provisional
