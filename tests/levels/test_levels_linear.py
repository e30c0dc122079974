"""Which modes stand for the linear structure where hits of different forces disagree, and which poles are none."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from simulate_levels import LINEAR, Case, hits_of

from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.levels import LevelSettings, LevelStudy, study_levels
from ema_pipeline.levels.harmonics import (
    growth,
    may_be_products,
    product_of,
    without,
    without_faint,
    without_products,
)
from ema_pipeline.levels.linear import structure
from ema_pipeline.levels.study import with_circles
from ema_pipeline.modal.circle.settings import CircleSettings
from ema_pipeline.modal.identify import identify
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.modal.types import ModalModel, Mode
from ema_pipeline.run.measured import measured_frfs, measured_modes
from ema_pipeline.run.types import Run

CASE = replace(LINEAR, noise=1e-3)


def studied(case: Case, seed: int) -> tuple[LevelStudy, ModalModel, FrfSet]:
    hits = hits_of(case, np.random.default_rng(seed))
    frfs = estimate_frfs(hits)
    modal = identify(frfs, ModalSettings())
    study = study_levels(
        lambda: hits, frfs, modal, LevelSettings(), FrfSettings(), ModalSettings(), lambda done, text: None
    )
    return study, modal, frfs


@pytest.fixture(scope="module")
def hardening() -> tuple[LevelStudy, ModalModel, FrfSet]:
    return studied(replace(CASE, mode=1, frequency_shift=0.01), 1)


def at(frequency_hz: float, like: Mode) -> Mode:
    pole = 2 * np.pi * frequency_hz * complex(-0.01, 1.0)
    return replace(like, frequency_hz=frequency_hz, damping_ratio=0.01, pole=pole)


def test_a_stiffening_structure_is_that_of_its_softest_hits(
    hardening: tuple[LevelStudy, ModalModel, FrfSet],
) -> None:
    study, modal, _ = hardening
    assert study.linear_level == 0
    own = structure(modal, study)
    assert [m.frequency_hz for m in own.modes] == pytest.approx([80.0, 130.0, 215.0], rel=4e-4)
    # the hardest hits move the mode by more than its half-width: averaged FRFs show it elsewhere
    averaged = min(modal.modes, key=lambda m: abs(m.frequency_hz - 130.5))
    assert abs(averaged.frequency_hz - 130.0) > 0.2
    assert [m.depends for m in study.modes] == [False, True, False]
    assert "softest hits alone (2" in study.summary
    assert study.modes[1].trend == "hardening"
    assert study.modes[1].frequency_hz[2] - study.modes[1].frequency_hz[0] == pytest.approx(1.3, rel=0.15)


@pytest.mark.slow
def test_a_structure_that_rubs_is_that_of_its_hardest_hits() -> None:
    study, _, _ = studied(replace(CASE, mode=1, damping_shift=-0.5), 2)
    assert study.linear_level == 2
    assert "damping falls" in study.modes[1].trend
    assert "hardest hits alone" in study.summary


def test_a_structure_that_rubs_a_little_is_that_of_its_softest_hits() -> None:
    """These show fewest of the poles that friction makes."""
    study, _, _ = studied(replace(CASE, mode=1, damping_shift=-0.07), 2)
    assert "damping falls" in study.modes[1].trend
    assert study.linear_level == 0


def test_a_linear_structure_is_that_of_all_hits() -> None:
    study, modal, frfs = studied(CASE, 3)
    assert study.linear_level is None
    assert structure(modal, study) is modal
    assert "alone" not in study.summary
    assert len(frfs.inputs) == 2


def test_fit_and_comparison_take_the_modes_and_frfs_of_that_level(
    hardening: tuple[LevelStudy, ModalModel, FrfSet],
) -> None:
    study, modal, frfs = hardening
    held: dict[str, Any] = {"modal": modal, "frfs": frfs, "study": with_circles(study, CircleSettings())}

    def held_result(stage: str, configuration: str, name: str, cls: type, left_out: object = None) -> object:
        return held[name]

    store = SimpleNamespace(find=held_result, load=held_result, key=lambda stage, configuration: "")
    run = cast(Run, SimpleNamespace(store=store, info=SimpleNamespace(configurations=("rig",)), memory={}))
    assert measured_modes(run)["rig"].frequency_hz[1] == pytest.approx(130.0, rel=4e-4)
    assert measured_frfs(run)["rig"] is study.levels[0].frfs
    assert held["study"].levels[0].modal.modes[1].circles


def test_poles_at_multiples_of_what_moves_are_no_modes(
    hardening: tuple[LevelStudy, ModalModel, FrfSet],
) -> None:
    study, _, _ = hardening
    hard = study.levels[2].modal
    soft = study.levels[0].modal
    assert hard is not None
    assert soft is not None
    third, other = at(3 * 130.2, hard.modes[2]), at(300.0, hard.modes[2])
    made = replace(hard, modes=(*hard.modes, other, third))
    levels = (*study.levels[:2], replace(study.levels[2], modal=made))
    cleaned, products = without_products(levels, study.modes, soft)
    assert cleaned[2].modal is not None
    assert [m.frequency_hz for m in cleaned[2].modal.modes][-1] == 300.0
    assert len(cleaned[2].modal.modes) == len(hard.modes) + 1
    assert len(products) == 1
    assert products[0].startswith("390.6 Hz (3 × 130")
    assert cleaned[0].modal is soft


def test_poles_that_hardly_move_are_no_modes_where_the_hardest_hits_are_nearest_to_a_linear_structure(
    hardening: tuple[LevelStudy, ModalModel, FrfSet],
) -> None:
    study, _, _ = hardening
    hard = study.levels[2].modal
    assert hard is not None
    assert hard.scaled
    one = hard.modes[2]
    third, faint = (replace(at(hz, one), shape=0.04 * one.shape) for hz in (3 * 130.2, 313.0))
    moving = at(300.0, one)
    made = replace(hard, modes=(*hard.modes, moving, faint, third))
    levels = (*study.levels[:2], replace(study.levels[2], modal=made))
    cleaned, products = without_faint(levels, 2)
    assert cleaned[2].modal is not None
    assert cleaned[2].modal.modes == (*hard.modes, moving)
    assert [cleaned[k].modal for k in (0, 1)] == [levels[k].modal for k in (0, 1)]
    assert products == ("313, 390.6 Hz (hardly moving)",)
    # what the softest hits show as well is a mode, however little it moves
    seen = (replace(levels[0], modal=made), *levels[1:])
    assert without_faint(seen, 2) == (seen, ())
    # shapes of no scale do not tell
    unscaled = (*levels[:2], replace(levels[2], modal=replace(made, scaled=False)))
    assert without_faint(unscaled, 2) == (unscaled, ())


def test_a_pole_that_grows_with_the_force_is_no_mode_though_nothing_else_moves() -> None:
    study, modal, _ = studied(replace(CASE, mode=2, growth=1.0), 4)
    assert study.level_dependent
    assert study.linear_level == 0
    assert [round(m.frequency_hz) for m in structure(modal, study).modes] == [80, 130]
    assert len(study.products) == 1
    assert study.products[0].startswith("215 Hz (grows with the force to the power of ")
    assert not any(m.depends for m in study.modes)  # of the modes that are left
    assert "the FRFs change with it" in study.summary


@pytest.mark.slow
def test_a_pole_that_fades_with_the_force_speaks_for_the_hardest_hits() -> None:
    study, _, _ = studied(replace(CASE, mode=2, growth=-0.5), 4)
    assert study.level_dependent
    assert study.linear_level == 2
    assert "size falls" in study.modes[2].trend
    assert "size in the FRFs falls with force" in study.summary


def test_sizes_that_change_by_some_per_cent_tell_nothing() -> None:
    study, _, _ = studied(replace(CASE, noise=1e-4, mode=2, growth=0.02), 4)
    assert not study.level_dependent
    size = study.modes[2].size
    assert size is not None
    assert size[2] - size[0] == pytest.approx(0.05, abs=0.02)  # seen, but too little to tell of the structure


def test_products_of_two_modes_are_told_by_their_frequencies(
    hardening: tuple[LevelStudy, ModalModel, FrfSet],
) -> None:
    _, modal, _ = hardening
    a, b = at(100.0, modal.modes[0]), at(170.0, modal.modes[0])
    assert product_of(at(800.0, a), [a, b]) == ""
    assert product_of(at(440.1, a), [a, b]) == "100 + 2 × 170 Hz"
    assert product_of(at(200.3, a), [a, b]) == "2 × 100 Hz"
    assert product_of(at(270.2, a), [a, b]) == "100 + 170 Hz"
    assert product_of(at(270.2, a), [a]) == ""
    slow = replace(at(270.2, a), pole=complex(0.2 * a.pole.real, a.pole.imag))
    assert product_of(slow, [a, b]) == ""  # it outlives what would make it
    made, apart = at(510.3, a), at(800.0, a)
    assert list(may_be_products([a, b, made, apart])) == [False, False, True, False]


def test_a_mode_grows_in_proportion_to_the_force_and_a_third_harmonic_with_its_cube(
    hardening: tuple[LevelStudy, ModalModel, FrfSet],
) -> None:
    mode, force = hardening[0].modes[0], np.array([10.0, 30.0, 100.0])

    def sized(size: list[float], std: float) -> float:
        return growth(replace(mode, size=np.array(size), size_std=np.full(3, std)), force)

    assert sized([1.0, 1.0, 1.0], 0.01) == pytest.approx(1.0)
    assert sized([0.01, 0.09, 1.0], 1e-4) == pytest.approx(3.0)
    assert sized([-0.1, 0.1, 1.0], 0.2) == pytest.approx(1.0 + np.log10(1 / 0.4))
    assert sized([np.nan, 0.3, 0.3], 0.01) == pytest.approx(1.0)
    assert np.isnan(sized([np.nan, np.nan, 1.0], 0.01))
    assert np.isnan(growth(replace(mode, size=None), force))


def test_a_model_less_one_mode_keeps_its_chart(hardening: tuple[LevelStudy, ModalModel, FrfSet]) -> None:
    _, modal, _ = hardening
    less = without(modal, {0})
    assert less.modes == modal.modes[1:]
    voted = modal.chart.selected
    assert np.all(less.chart.selected[voted == 0] == -1)
    assert np.all(less.chart.selected[voted == 1] == 0)
    assert np.all(less.chart.selected[voted == -1] == -1)
