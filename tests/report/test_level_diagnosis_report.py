"""How simulated hits are shown: words, figures and the summary."""

from __future__ import annotations

import numpy as np
import pytest

from ema_pipeline.diagnose.sentences import size_text
from ema_pipeline.diagnose.types import EffectSize, Ladder, Rung, TimeTrace
from ema_pipeline.dof import Dof
from ema_pipeline.report.diagnosis import hits_words, noise_words, size_words
from ema_pipeline.report.figures import traces
from ema_pipeline.report.plots import figure_specs
from ema_pipeline.report.results import RunResults
from ema_pipeline.report.summary_files import _ladder

NAN = float("nan")


def rung(effects: tuple[str, ...], misfit: tuple[float, ...], held: tuple[float, ...]) -> Rung:
    sizes = {f"{e}.stiffness": EffectSize(8e11, 5e10, "N/m³") for e in effects}
    return Rung(effects, 1.3, 1.5, 100.0, 100.0, sizes, 0.0, 0, misfit=misfit, heldout_misfit=held)


def trace(force_n: float) -> TimeTrace:
    t = np.arange(400) / 2048
    signal = force_n * np.exp(-20 * t) * np.sin(400 * t)
    return TimeTrace(
        "no_ring", f"a_{force_n:g}.uff#0", force_n, Dof("carrier", "x"), Dof("carrier", "x"), "acceleration",
        2048.0, signal, 0.8 * signal, 0.99 * signal,
    )  # fmt: skip


@pytest.fixture
def ladder() -> Ladder:
    return Ladder(
        rungs=(
            rung((), (0.06, 0.10), (0.07, 0.13)),
            rung(("bearing_cubic@carrier",), (0.05, 0.03), (0.05, NAN)),
        ),
        frequency_noise=NAN, damping_noise=NAN, shape_noise=NAN, note="", force_n=(30.0, 300.0), hit_noise=0.003,
        traces=(trace(300.0), trace(30.0)),
    )  # fmt: skip


def test_words_tell_what_each_level_misses_and_leave_out_what_was_not_predicted(ladder: Ladder) -> None:
    text = hits_words(ladder)
    assert "7.0 → 5.0 % at 30 N" in text
    assert "300 N" not in text
    assert "0.3" in noise_words(ladder)
    assert "nan" not in noise_words(ladder)


def test_summary_holds_the_misfit_of_every_level(ladder: Ladder) -> None:
    first, last = _ladder(ladder)
    assert first["force_n"] == [30.0, 300.0]
    assert last["misfit"] == [0.05, 0.03]
    plain = Ladder((rung((), (), ()),), 1e-3, 1e-3, 1e-2, "")
    assert "misfit" not in _ladder(plain)[0]


def test_figures_of_hits_are_drawn_where_hits_were_simulated(ladder: Ladder) -> None:
    names = {s.name for s in figure_specs(RunResults("t", ladder=ladder))}
    assert {"diagnosis_misfit", "diagnosis_hits_no_ring"} <= names


def test_traces_stand_from_soft_to_hard_with_the_share_that_is_missed(ladder: Ladder) -> None:
    (group,) = traces.trace_groups(ladder.traces)
    assert [t.force_n for t in group] == [30.0, 300.0]
    figure = traces.hit_traces(group, ("bearing_cubic@carrier",))
    texts = [t.get_text() for ax in figure.axes for t in ax.texts]
    assert texts == ["30 N: misses 20 %", "30 N: misses 1.0 %", "300 N: misses 20 %", "300 N: misses 1.0 %"]


def test_bars_say_fitted_and_held_out_by_hatching_and_number(ladder: Ladder) -> None:
    figure = traces.level_misfits(ladder)
    (ax,) = figure.axes
    numbers = [t.get_text() for t in ax.texts]
    assert "13" in numbers
    assert "–" in numbers
    assert {p.get_hatch() or "" for p in ax.patches} == {"", "////"}


def test_sentences_and_tables_write_a_size_alike() -> None:
    sizes = {
        "spring@m1.stiffness": EffectSize(-1.543e4, 1.3e3, "N/m"),
        "out_of_tolerance@k.relative_change": EffectSize(0.02145, 0.0018, "1"),
    }
    assert size_text(sizes) == "stiffness −15.4 ± 1.3 kN/m, relative change 0.0215 ± 0.0018"
    own = {name.rpartition(".")[2]: size for name, size in sizes.items()}
    assert size_words(own, ", ") == size_text(sizes)


def test_a_size_that_the_data_do_not_determine_is_not_given() -> None:
    sizes = {
        "mesh_backlash@m.preload": EffectSize(2.7e-7, 6e-9, "m"),
        "mesh_backlash@m.gap": EffectSize(1e-4, 3.2, "m"),
    }
    assert size_text(sizes) == "preload 270.0 ± 6.0 nm, gap not determined by these data"
    assert "gap not determined by these data" in size_words(sizes)
    assert "force 0.0 ± 1.4 N" in size_words({"dry_friction@m.force": EffectSize(0.0, 1.4, "N")})
