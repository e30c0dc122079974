"""What moves with the force of the hits: calibration of the test, and what it finds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from simulate_levels import LINEAR, hits_of

from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.ingest.campaign import read_campaign
from ema_pipeline.ingest.hit_checks import hits_of_test
from ema_pipeline.ingest.hit_settings import HitSettings
from ema_pipeline.ingest.load import load_records
from ema_pipeline.ingest.records import HitSamples, cut_hit
from ema_pipeline.levels import LevelSettings, LevelStudy, single, study_levels
from ema_pipeline.levels.differences import Solved
from ema_pipeline.levels.sentences import flagged
from ema_pipeline.levels.single import single_hits
from ema_pipeline.levels.sizes import plain_damping, relative_sizes, sizes_at_levels
from ema_pipeline.levels.trend import (
    Samples,
    Trend,
    clearest,
    combined,
    holm,
    samples,
    scattered_by_sheet,
    shifts,
    trends,
)
from ema_pipeline.modal.identify import identify
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.modal.types import ModalModel


def studied(hits: list[HitSamples]) -> tuple[LevelStudy, ModalModel]:
    frfs = estimate_frfs(hits)
    modal = identify(frfs, ModalSettings())
    return study_levels(
        lambda: hits, frfs, modal, LevelSettings(), FrfSettings(), ModalSettings(), lambda done, text: None
    ), modal


@pytest.fixture(scope="module")
def moving() -> tuple[LevelStudy, ModalModel]:
    case = replace(
        LINEAR, mode=1, frequency_shift=5e-4
    )  # 0.065 Hz at the hardest hits, a twelfth of the bandwidth
    return studied(hits_of(case, np.random.default_rng(1)))


def test_a_mode_that_moves_is_found_and_no_other_is_blamed(moving: tuple[LevelStudy, ModalModel]) -> None:
    study, _ = moving
    assert study.level_dependent
    assert [m.depends for m in study.modes] == [False, True, False]
    mode = study.modes[1]
    assert mode.trend == "hardening"
    assert mode.frequency_shift_hz is not None
    assert mode.frequency_shift_std_hz is not None
    # the hardest hits scatter about the level's force, and with it the shift
    expected = 130.0 * 5e-4 * (1 - 1 / 81)
    assert mode.frequency_shift_hz[2] == pytest.approx(expected, rel=0.25)
    assert mode.frequency_hz[2] - mode.frequency_hz[0] == pytest.approx(expected, rel=0.25)


@pytest.mark.slow
@pytest.mark.parametrize("processors", [1, 2])
def test_levels_are_the_same_in_one_process_and_in_several(
    moving: tuple[LevelStudy, ModalModel], monkeypatch: pytest.MonkeyPatch, processors: int
) -> None:
    monkeypatch.setattr("ema_pipeline.levels.study.cores", lambda: processors)
    case = replace(LINEAR, mode=1, frequency_shift=5e-4)
    again, _ = studied(hits_of(case, np.random.default_rng(1)))
    for a, b in zip(moving[0].levels, again.levels, strict=True):
        assert a.hits == b.hits
        assert a.modal is not None
        assert b.modal is not None
        assert [m.pole for m in a.modal.modes] == [m.pole for m in b.modal.modes]


@pytest.mark.slow
def test_levels_of_many_frfs_are_identified_one_after_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ema_pipeline.levels.study.cores", lambda: 2)
    monkeypatch.setattr("ema_pipeline.levels.study.MOST_SIDE_BY_SIDE", 0)

    asked: list[int] = []

    def spread(job: Callable[[int], object], items: range, processes: int, least: int) -> Iterator[object]:
        asked.append(processes)
        return map(job, items)

    monkeypatch.setattr("ema_pipeline.levels.study.spread", spread)
    study, _ = studied(hits_of(replace(LINEAR, mode=1, frequency_shift=5e-4), np.random.default_rng(1)))
    assert len(study.levels) == 3
    assert asked == [1]


def test_every_level_keeps_its_own_modal_model(moving: tuple[LevelStudy, ModalModel]) -> None:
    study, _ = moving
    for k, level in enumerate(study.levels):
        assert level.modal is not None
        assert len(level.hits) == 4
        for mode in study.modes:
            assert mode.level_modes is not None
            own = level.modal.modes[mode.level_modes[k]]
            assert own.frequency_hz == mode.frequency_hz[k]


def test_a_mode_that_moves_is_flagged_in_plain_words(moving: tuple[LevelStudy, ModalModel]) -> None:
    study, modal = moving
    flags = [m.flags for m in flagged(modal, study).modes]
    assert any("frequency rises with force" in f and "Hz from" in f for f in flags[1])
    assert not any("with force" in f for k in (0, 2) for f in flags[k])
    assert "not linear" in study.summary


def test_a_linear_structure_is_not_called_level_dependent() -> None:
    study, _ = studied(hits_of(LINEAR, np.random.default_rng(2)))
    assert len(study.levels) == 3
    assert not study.level_dependent
    assert "Nothing moves" in study.summary


def test_poles_of_single_hits_scatter_as_their_standard_deviations_say() -> None:
    # soft hits are long: the zero of their force spectrum lies close above the last mode
    case = replace(LINEAR, frequency_hz=np.array([80.0, 130.0, 620.0]), hits_per_level=4, hand=0.02)
    hits = hits_of(case, np.random.default_rng(5))
    frfs = estimate_frfs(hits)
    found = single_hits(lambda: hits, identify(frfs, ModalSettings()), frfs, FrfSettings())
    true_hz, true_damping = case.frequency_hz, case.damping
    z = (found.frequency_hz - true_hz) / found.frequency_std_hz
    soft = found.force_n < 35
    assert np.isfinite(z[soft]).all()
    assert np.all(np.abs(z[soft].mean(axis=0)) < 3.5 / np.sqrt(soft.sum()) + 0.5)
    assert np.all((z[soft].std(axis=0) > 0.5) & (z[soft].std(axis=0) < 1.7))
    z = (found.damping_ratio - true_damping) / found.damping_std
    assert np.all((z[soft].std(axis=0) > 0.5) & (z[soft].std(axis=0) < 1.7))


def test_a_hit_that_tells_nothing_of_a_mode_moves_it_as_the_mean_of_its_point_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Fits of such hits go astray: motions of metres made every law that depends on the amplitude impossible."""
    hits = hits_of(LINEAR, np.random.default_rng(2))
    modal = identify(frfs := estimate_frfs(hits), ModalSettings())
    true = single_hits(lambda: hits, modal, frfs, FrfSettings()).motion_m
    solved = single.solve

    def astray(*given: Any) -> Solved:
        found = solved(*given)
        participation, std = found.participation.copy(), found.std.copy()
        participation[0], std[0] = 1e10, np.inf
        return replace(found, participation=participation, std=std)

    monkeypatch.setattr(single, "solve", astray)
    found = single_hits(lambda: hits, modal, frfs, FrfSettings())
    first = [int(np.argmax(found.sheet == s)) for s in np.unique(found.sheet)]
    assert not np.any(np.isfinite(found.frequency_std_hz[first]))
    np.testing.assert_allclose(found.motion_m[first], true[first], rtol=0.05)


def test_sizes_of_single_hits_scatter_as_their_standard_deviations_say() -> None:
    case = replace(LINEAR, frequency_hz=np.array([80.0, 130.0, 620.0]), hits_per_level=4, hand=0.02)
    hits = hits_of(case, np.random.default_rng(5))
    frfs = estimate_frfs(hits)
    found = single_hits(lambda: hits, identify(frfs, ModalSettings()), frfs, FrfSettings())
    values, std, mean = relative_sizes(found)
    values = values.real
    assert mean.max(axis=0) == pytest.approx(np.ones(3))
    z = (values - mean) / std
    for soft in (found.force_n < 35, found.force_n > 100):
        assert np.isfinite(z[soft]).all()
        assert np.all((z[soft].std(axis=0) > 0.5) & (z[soft].std(axis=0) < 1.7))
    # alike at every level, within what is known of them
    level = np.digitize(found.force_n, [35, 100])
    for r in range(3):
        size, size_std = sizes_at_levels(values[:, r], std[:, r], mean[:, r], level, 0.0)
        assert np.all(np.abs(size - 1) < 4 * size_std)
        assert np.all(size_std < 0.02)


def test_displacement_after_a_hit_is_that_of_the_impulse() -> None:
    hits = hits_of(replace(LINEAR, noise=1e-4), np.random.default_rng(6))
    frfs = estimate_frfs(hits)
    found = single_hits(lambda: hits, identify(frfs, ModalSettings()), frfs, FrfSettings())
    hardest = int(np.argmax(found.force_n))
    force = hits[hardest].force
    for r, hz in enumerate(LINEAR.frequency_hz):
        omega = 2 * np.pi * hz
        impulse = abs(np.sum(force * np.exp(-1j * omega * np.arange(force.size) / 2048.0))) / 2048.0
        point = int(hits[hardest].hit.impact.body.removeprefix("p"))
        shape = LINEAR.shapes[r]
        expected = abs(shape[point]) * np.abs(shape).max() * impulse / omega
        assert found.amplitude_m[hardest, r] == pytest.approx(expected, rel=0.03)


@pytest.mark.slow
def test_the_trend_test_keeps_its_false_alarm_rate_with_few_hits_and_an_unsteady_hand() -> None:
    rng = np.random.default_rng(7)
    for points, levels, hits, jitter in ((1, 3, 2, 0.0), (3, 3, 2, 1.0), (2, 2, 2, 0.0)):
        sheet = np.repeat(np.arange(points), levels * hits)
        level = np.tile(np.repeat(np.arange(levels), hits), points)
        wrong = 0
        for _ in range(60):
            modes = []
            force = 30 * 3.0**level * np.exp(0.12 * rng.normal(size=len(level)))
            for _ in range(4):
                std = 30 / force
                # points differ from each other by much more than hits do
                values = 50 * rng.normal(size=points)[sheet] + std * rng.normal(size=len(std))
                values += jitter * rng.normal(size=len(std))
                modes.append(samples(values, std, sheet, level, force, np.ones(len(std))))
            p = holm(np.array([t.p for t in trends(modes)]))
            wrong += bool(np.nanmin(p) < 0.05)
        assert wrong <= 9  # 3 expected at most; 10 by chance once in 700


@pytest.mark.slow
def test_a_sheet_that_scatters_by_itself_shows_no_trend() -> None:
    """A mode that oblique hits alone excite at one point: 1.5 of scatter there, hardly any elsewhere."""
    rng = np.random.default_rng(17)
    sheet, level = np.repeat(np.arange(5), 6), np.tile(np.repeat(np.arange(3), 2), 5)
    wrong = {True: 0, False: 0}
    for _ in range(60):
        force = 30 * 3.0**level * np.exp(0.12 * rng.normal(size=30))
        std = 1.0 / force
        scatter = np.where(sheet == 2, 1.5, 0.01)
        modes = [
            samples(scatter * rng.normal(size=30), std, sheet, level, force, np.ones(30)) for _ in range(4)
        ]
        for by_sheet in wrong:
            given = [scattered_by_sheet(s) for s in modes] if by_sheet else modes
            wrong[by_sheet] += bool(min(t.p for t in trends(given)) < 1e-3)
    assert wrong[True] <= 2
    assert wrong[False] >= 5


def test_sizes_that_grow_with_the_force_stay_clear_by_sheets() -> None:
    rng = np.random.default_rng(18)
    sheet, level = np.repeat([0, 1, 2], 6), np.tile(np.repeat([0, 1, 2], 2), 3)
    force = 30 * 3.0**level * np.exp(0.1 * rng.normal(size=18))
    std = np.full(18, 0.1)
    values = np.array([1.0, 0.5, 0.2])[sheet] * (force / 270) + std * rng.normal(size=18)
    given = samples(values, std, sheet, level, force, np.ones(18))
    (found,) = trends([scattered_by_sheet(given)])
    assert found.p < 1e-4


def test_the_trend_test_finds_what_moves_and_tells_how_far() -> None:
    rng = np.random.default_rng(8)
    sheet, level = np.repeat([0, 1], 6), np.tile(np.repeat([0, 1, 2], 2), 2)
    force = 30 * 3.0**level * np.exp(0.1 * rng.normal(size=12))
    std = np.full(12, 0.1)
    values = np.array([5.0, -40.0])[sheet] + 1.0 * (force / 270) ** 2 + std * rng.normal(size=12)
    given = samples(values, std, sheet, level, force, np.ones(12))
    (found,) = trends([given])
    assert found.p < 1e-3
    assert found.slope > 0
    shift, shift_std = shifts(values, std, sheet, level, found)
    assert abs(shift[2] - 1.0) < 4 * shift_std[2] + 0.15  # the hand's scatter moves the force itself


def test_damping_that_hardly_changes_is_no_trend_however_clear_it_is() -> None:
    """As of 1.222 and 1.225 % under two hammers: their pulses differ, and not the structure."""
    log_force = np.log([30.0, 60.0, 300.0])
    clear = Trend(1e-6, 1.1 * 0.0001 / np.log(10), 0.0)
    assert plain_damping(clear, 0.01, log_force) is clear
    slight = Trend(1e-6, -0.9 * 0.0001 / np.log(10), 0.0)
    assert plain_damping(slight, 0.01, log_force).p == 0.5
    assert np.isnan(plain_damping(Trend(np.nan, np.nan, 0.0), 0.01, log_force).p)


def test_one_hit_at_each_of_two_forces_cannot_tell_a_trend_from_scatter() -> None:
    given = samples(
        np.array([1.0, 2.0]), np.array([0.01, 0.01]), np.zeros(2, int), np.arange(2), np.array([30.0, 100.0]),
        np.ones(2),
    )  # fmt: skip
    (found,) = trends([given])
    assert np.isnan(found.p)


def test_modes_that_agree_on_the_scatter_lend_each_other_degrees_of_freedom() -> None:
    rng = np.random.default_rng(11)
    level = np.repeat([0, 1], 2)
    force = 30 * 3.0**level * np.exp(0.1 * rng.normal(size=4))
    std = np.full(4, 0.1)

    def hits(moved: float) -> Samples:
        values = moved * (force / 90) ** 2 + std * rng.normal(size=4)
        return samples(values, std, np.zeros(4, int), level, force, np.ones(4))

    moves, still = hits(0.8), [hits(0.0) for _ in range(7)]
    alone = trends([moves])[0].p
    together = trends([moves, *still])[0].p
    assert together < 0.01
    assert together < 0.3 * alone


def test_hits_of_one_level_that_differ_in_force_are_no_scatter() -> None:
    rng = np.random.default_rng(12)
    level = np.repeat([0, 1, 2], 2)
    force = np.array([27.0, 33.0, 90.0, 108.0, 270.0, 330.0])
    std = np.full(6, 0.01)
    values = (force / 330) ** 2 + std * rng.normal(size=6)  # hits of the last level differ by 30 sigma
    (found,) = trends([samples(values, std, np.zeros(6, int), level, force, np.ones(6))])
    assert found.p < 1e-3


def test_the_cauchy_combination_is_that_of_its_definition() -> None:
    p = np.array([0.02, 0.3, np.nan, 0.7])
    mean = np.mean([np.tan((0.5 - q) * np.pi) for q in (0.02, 0.3, 0.7)])
    assert combined(p) == pytest.approx(0.5 - np.arctan(mean) / np.pi)
    assert combined(np.array([1e-20, 0.5, 0.5, 0.5])) == pytest.approx(4e-20, rel=1e-3)
    assert np.isnan(combined(np.array([np.nan])))


def test_where_all_tests_together_are_clear_the_clearest_mode_is_named() -> None:
    p_values = np.array([0.004, 0.004, 0.004, np.nan])
    assert np.nanmin(holm(p_values)) > 0.01
    assert combined(p_values) < 0.01
    assert clearest(p_values, 0.01).tolist() == [True, False, False, False]


def test_holm_adjusts_as_in_the_textbook() -> None:
    adjusted = holm(np.array([0.01, np.nan, 0.04, 0.03, 0.005]))
    assert adjusted == pytest.approx([0.03, np.nan, 0.06, 0.06, 0.02], nan_ok=True)


@pytest.mark.slow
def test_the_carriers_cubic_spring_shows_at_the_carriers_mode_most_clearly(test_data: Path) -> None:
    test = read_campaign(test_data / "blind" / "p6-three-levels").tests[0]
    records = [r for r in load_records(test) if str(r.impact) in ("carrier.x", "planet1.x")]
    found = hits_of_test(records, HitSettings())
    hits = [cut_hit(r, h) for r in records for h in found if h.file == r.file and h.accepted]
    frfs = estimate_frfs(hits)
    settings = ModalSettings(high_hz=220)
    modal = identify(frfs, settings)
    study = study_levels(
        lambda: hits, frfs, modal, LevelSettings(), FrfSettings(), settings, lambda done, text: None
    )
    assert [round(level.force_n, -1) for level in study.levels] == [30, 100, 270]
    assert study.level_dependent
    moved = min((m for m in study.modes if m.depends), key=lambda m: m.frequency_p)
    assert 158 < moved.frequency_hz[0] < 163
    assert "hardening" in moved.trend


def test_a_roving_hammer_without_a_driving_point_can_be_studied_too() -> None:
    hits = hits_of(replace(LINEAR, n_points=3), np.random.default_rng(9))
    # one sensor away from the points that are struck: shapes are known at the points only
    roving = [replace(h, responses=h.responses[3:], channels=h.channels[3:]) for h in hits]
    frfs = estimate_frfs(roving)
    modal = identify(frfs, ModalSettings())
    assert frfs.outputs[0] not in modal.dofs
    found = single_hits(lambda: roving, modal, frfs, FrfSettings())
    z = (found.frequency_hz - np.array([m.frequency_hz for m in modal.modes])) / found.frequency_std_hz
    assert np.isfinite(z).any()
    assert np.abs(z[np.isfinite(z)]).max() < 6
