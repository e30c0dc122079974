"""Modes of the model that coincide with a paired one: one measured shape holds of both."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.dof import Dof
from ema_pipeline.inference import Residuals, tails
from ema_pipeline.observations.coinciding import directions, held_in, hidden_partners
from ema_pipeline.observations.mode_data import prepare
from ema_pipeline.observations.mode_rows import Compared, Rows, whitened
from ema_pipeline.observations.modes import ModeObservations
from ema_pipeline.rigs import load_rig
from ema_pipeline.rigs.types import Rig


def solution(hz: list[float], ratio: float = 0.01) -> Any:
    return SimpleNamespace(frequency_hz=np.array(hz), damping_ratio=np.full(len(hz), ratio))


@pytest.mark.parametrize(
    ("hz", "to", "sensors", "found"),
    [
        ([100.0, 100.9, 150.0], [0, 2], [6, 6], [1, -1]),  # within a half-width of 1 Hz
        ([100.0, 101.1, 150.0], [0, 2], [6, 6], [-1, -1]),
        ([100.0, 100.9, 150.0], [0, 1, 2], [6, 6, 6], [-1, -1, -1]),  # it has a partner of its own
        ([100.0, 100.9, 99.5], [0], [6], [2]),  # the nearest
        ([100.0, 100.9, 150.0], [0], [3], [-1]),  # two shapes explain any third one at three sensors
        ([100.0], [], [], []),
    ],
)
def test_a_hidden_partner_lies_within_a_half_width_and_has_no_measured_mode(
    hz: list[float], to: list[int], sensors: list[int], found: list[int]
) -> None:
    got = hidden_partners(solution(hz), np.array(to, int), np.array(sensors, int), np.ones((6, len(hz))))
    assert got.tolist() == found


def test_a_mode_that_hardly_moves_a_sensor_hides_in_no_other() -> None:
    """Such a mode would excuse any wrong shape: a support whose mass moves alone, at the frequency of another mode."""
    read = np.ones((6, 3))
    read[:, 1] = 0.31
    to, sensors = np.array([0]), np.array([6])
    assert hidden_partners(solution([100.0, 99.9, 99.5]), to, sensors, read).tolist() == [2]
    read[:, 1] = 0.32
    assert hidden_partners(solution([100.0, 99.9, 99.5]), to, sensors, read).tolist() == [1]


def test_a_shape_that_two_modes_do_not_explain_is_no_mix_of_them() -> None:
    """An absorber turns a carrier at the frequency where two modes of a support move it along x and y."""
    random = np.random.default_rng(1)
    read = random.standard_normal((6, 3))
    mix, other = read[:, 0] - 2 * read[:, 1], random.standard_normal(6)
    other -= read[:, :2] @ np.linalg.lstsq(read[:, :2], other, rcond=None)[0]
    other *= np.linalg.norm(mix) / np.linalg.norm(other)
    to, partners = np.array([0, 0, 0, 2]), np.array([1, 1, 1, -1])
    shapes = np.stack([mix, mix + 0.9 * other, mix + 1.1 * other, other])
    assert held_in(shapes, read, to, partners).tolist() == [1, 1, -1, -1]
    shapes[0, 3], shapes[2, 1:] = 0, 0  # entries that were not measured say nothing
    assert held_in(shapes, read, to, partners).tolist() == [1, 1, 1, -1]


def test_what_a_hidden_partner_adds_is_across_the_paired_shape_and_of_weighted_length_one() -> None:
    random = np.random.default_rng(0)
    predicted, weight = random.standard_normal((6, 3)), random.uniform(1, 4, (2, 6))
    paired = predicted[:, [0, 2]].T
    ((place, along),) = directions(np.array([1, -1]), predicted, paired, weight)
    assert place == 0
    assert weight[0] @ (along * paired[0]) == pytest.approx(0, abs=1e-12)
    assert weight[0] @ along**2 == pytest.approx(1)
    predicted[:, 1] = -2 * predicted[:, 0]  # the same shape adds nothing
    assert not list(directions(np.array([1, -1]), predicted, paired, weight))


def twin_beam(folder: Path) -> Rig:
    """Three masses in a row that move in x and y nearly alike: every mode has a twin within a tenth of its width."""
    lines = ['name = "twin"', "modal_damping_ratio = 0.01"]
    for d, stiffness in (("x", 1e6), ("y", 1.002e6)):
        for k in (1, 2, 3):
            lines += ["[[masses]]", f'at = "m{k}.{d}"', "value = 1.0", "[[springs]]", f"value = {stiffness}"]
            lines += [f'at = "m1.{d}"' if k == 1 else f'between = ["m{k - 1}.{d}", "m{k}.{d}"]']
    (folder / "rig.toml").write_text("\n".join(lines), encoding="utf-8")
    return load_rig(folder / "rig.toml")


def test_the_one_measured_shape_of_two_modes_may_be_any_mix_of_them(tmp_path: Path) -> None:
    rig = twin_beam(tmp_path)
    (configuration,) = rig.configurations
    dofs = tuple(Dof.parse(f"m{k}.{d}") for k in (1, 2, 3) for d in "xy")
    beam = np.linalg.eigh(np.array([[2.0, -1, 0], [-1, 2, -1], [0, -1, 1]]))
    f = np.sqrt(1e6 * beam.eigenvalues) / (2 * np.pi)
    mixed = np.stack([0.8 * beam.eigenvectors.T, 0.6 * beam.eigenvectors.T], axis=-1).reshape(3, 6)
    measured = MeasuredModes(
        configuration, f, 1e-3 * f, np.full(3, 0.01), np.full(3, 1e-4), mixed.astype(complex),
        np.full((3, 6), 1e-3), dofs, band_hz=(1.0, 500.0),
    )  # fmt: skip
    problem = ModeObservations(rig, [prepare(measured)]).problem((), {})
    scatters = {n: s.default for n, s in problem.observations.scatters.items()}
    found = problem.residuals(problem.start(), scatters)
    assert found.unexplained == 0
    assert found.projected == 6  # a factor and a share of the twin, of three shapes
    assert np.max(found.blocks[0]) < 0.1
    some = ModeObservations(rig, [prepare(replace(measured, band_hz=None))]).problem((), {})
    assert (
        some.residuals(some.start(), scatters).projected == 3
    )  # a list that does not say that there are no others
    assert found.penalty == 0  # the twin is not a mode that should have been seen
    assert some.residuals(some.start(), scatters).penalty == 0
    bent = mixed.copy()
    bent[0, 0] += 1.5  # no mix of the two, but every sensor may show another one
    wrong = replace(measured, shapes=bent.astype(complex))
    left = ModeObservations(rig, [prepare(wrong)]).problem((), {}).residuals(problem.start(), scatters)
    alone = ModeObservations(rig, [prepare(replace(wrong, band_hz=None))]).problem((), {})
    assert 3 < left.blocks[0][0] < 12
    assert alone.residuals(problem.start(), scatters).blocks[0][0] > 300


def test_what_a_hidden_mode_adds_makes_a_difference_count_less_and_is_no_evidence() -> None:
    """A model must not gain by shapes that it need not explain, however small the learned uncertainty of the others."""
    own, none = np.full(4, 0.01), np.zeros((4, 0))
    rows = Rows(
        np.full(4, 0.3),
        own,
        np.ones(4),
        "shape",
        1.0,
        np.zeros(4, int),
        np.arange(4),
        slope=none,
        noise="noise",
    )
    scatters, usual = {"shape": 0.0005, "noise": 0.1}, {"shape": 0.015, "noise": 1.0}

    def seen(one: Rows) -> Residuals:
        return whitened([Compared((one,), np.zeros(1, int), 0.0, 0.0, 0.0, 0, 1)], scatters, usual, 0)

    sharp, blurred = seen(rows), seen(replace(rows, blur=np.full(4, 0.3)))
    usual_squares, none_left = (
        tails.cost(np.full(1, 2.0), np.full(1, 4.0)),
        tails.cost(np.zeros(1), np.full(1, 4.0)),
    )
    assert sharp.log_scale < 0  # two values are spent on the factor and on the hidden mode, two are left
    assert blurred.log_scale == pytest.approx(sharp.log_scale + float((usual_squares - none_left)[0]))
    heated = seen(replace(rows, blur=np.full(4, 0.3), heat=5.0))
    assert heated.log_scale == pytest.approx(sharp.log_scale + 1.0)  # half a square for each
    assert list(blurred.blurred_blocks) == [True]
    assert list(sharp.blurred_blocks) == [False]
    np.testing.assert_allclose(blurred.values, 1.0, rtol=1e-3)
    assert sharp.values[0] > 200
    assert blurred.share["shape"][0] < 1e-4  # what is learned of the scatter comes from the other shapes
