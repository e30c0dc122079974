"""Identified modes as a rig: its matrices against sums over modes written down by hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.types import NO_SYNTHESIS, ModalModel, Mode, StabilisationChart
from ema_pipeline.observations.modal_rig import rig_of_modes, why_no_rig

DOFS = tuple(Dof.parse(d) for d in ("a.x", "b.x", "c.x"))
NO_CHART = StabilisationChart(*(np.zeros(0) for _ in range(4)), np.zeros(0, np.int64))  # type: ignore[arg-type]


def mode(frequency_hz: float, ratio: float, shape: list[complex]) -> Mode:
    omega = 2 * np.pi * frequency_hz
    pole = omega * (-ratio + 1j * np.sqrt(1 - ratio**2))
    return Mode(frequency_hz, 0.0, ratio, 0.0, pole, np.array(shape), np.zeros(3), 1.0, "plscf")


def modal_model(*modes: Mode, scaled: bool = True) -> ModalModel:
    return ModalModel(
        DOFS, modes, (1.0, 100.0), scaled, "" if scaled else "no driving point", DOFS[:1], np.zeros(0),
        NO_SYNTHESIS, (), (), NO_CHART,
    )  # fmt: skip


def frfs(
    frequency_hz: NDArray[np.float64],
    frf: NDArray[np.complex128],
    quantities: tuple[str, ...],
    inputs: tuple[Dof, ...],
    band_hz: tuple[float, float],
) -> FrfSet:
    some = np.zeros(frf.shape)
    return FrfSet(
        frequency_hz, frf, some, some, DOFS, inputs, quantities, np.ones(frf.shape[:2], np.int64), "H1", 1.0, 0.0,
        np.zeros(len(inputs)), band_hz, True, np.zeros(3),
    )  # fmt: skip


NO_FRFS = frfs(np.zeros(1), np.zeros((3, 1, 1), complex), ("acceleration",) * 3, DOFS[:1], (0.0, 1.0))


def test_masses_springs_and_dampers_are_those_of_the_poles_and_sensors_see_the_shapes() -> None:
    shapes = [[0.5, -0.2, complex(np.nan)], [0.1, 0.4, 0.3]]
    turned = [
        shapes[0],
        [np.exp(0.6j) * v for v in shapes[1]],
    ]  # a phase that all of a shape has is none of the structure
    modal = modal_model(mode(10.0, 0.02, turned[0]), mode(25.0, 0.05, turned[1]))
    system = rig_of_modes(modal, NO_FRFS, "test", 5).system("test")
    omega = 2 * np.pi * np.array([10.0, 25.0])
    np.testing.assert_allclose(system.mass, np.eye(2))
    np.testing.assert_allclose(system.stiffness, np.diag(omega**2))
    np.testing.assert_allclose(system.damping, np.diag(2 * np.array([0.02, 0.05]) * omega))
    assert list(system.sensors) == ["a.x", "b.x", "c.x"]
    seen = np.array(list(system.sensors.values())).T
    for row, shape in zip(seen, np.nan_to_num(shapes).real, strict=True):  # a shape has no sign
        np.testing.assert_allclose(row * np.sign(row @ shape), shape, atol=1e-12)


def test_the_modes_that_move_most_are_kept_in_order_of_frequency() -> None:
    """By the height of their peak, φ²/σ."""
    high = mode(40.0, 0.0005, [0.2, 0.0, 0.0])
    small = mode(30.0, 0.0005, [0.1, 0.1, 0.1])  # of less damping than the low one, and no higher
    damped = mode(20.0, 0.2, [0.4, 0.0, 0.0])
    low = mode(10.0, 0.02, [0.0, -0.5, complex(np.nan)])
    rig = rig_of_modes(modal_model(low, damped, small, high), NO_FRFS, "test", 2)
    stiffness = np.diag(rig.system("test").stiffness)
    np.testing.assert_allclose(np.sqrt(stiffness) / (2 * np.pi), [10.0, 40.0])


def test_modes_that_would_be_missed_are_told_before_records_are_simulated_without_them() -> None:
    """One below a tenth of the highest peak is none of these."""
    high, low = mode(40.0, 0.0005, [0.2, 0.0, 0.0]), mode(10.0, 0.02, [0.0, -0.5, 0.1])
    little, less = (mode(20.0, 0.02, [size, 0.0, 0.0]) for size in (0.29, 0.28))  # 0.21 and 0.196, of 2.0
    assert why_no_rig(modal_model(low, less, high), NO_FRFS, 2) == ""
    assert why_no_rig(modal_model(low, little, high), NO_FRFS, 3) == ""
    assert "3 modes take part" in why_no_rig(modal_model(low, little, high), NO_FRFS, 2)
    assert "no driving point" in why_no_rig(modal_model(low, scaled=False), NO_FRFS, 2)


def test_where_no_mode_was_identified_the_largest_peak_of_the_driving_point_stands_for_one() -> None:
    """Driving point and others respond at the peak as the FRFs say, whatever is outside their band."""
    frequency = np.arange(0.0, 64.0)
    omega = 2 * np.pi * frequency
    shape, peak_hz = np.array([0.2, 0.5, -0.3]), 20.0
    with np.errstate(divide="ignore", invalid="ignore"):
        h = (
            shape[:, None]
            * 0.5
            / ((2 * np.pi * peak_hz) ** 2 - omega**2 + 2j * 0.05 * omega * 2 * np.pi * peak_hz)
        )
    h[:, 60] *= 1e6
    h[2, 30] = 1e3  # what other points do does not count
    one = frfs(frequency, h[:, None], ("displacement",) * 3, (DOFS[1],), (5.0, 50.0))
    system = rig_of_modes(modal_model(), one, "test", 5).system("test")
    omega_peak = 2 * np.pi * peak_hz
    assert system.stiffness == pytest.approx(omega_peak**2)
    ratio = float(system.damping[0, 0]) / (2 * omega_peak)
    assert ratio == pytest.approx(0.03)
    seen = np.concatenate(list(system.sensors.values()))
    np.testing.assert_allclose(seen / seen[1], shape / shape[1])
    accelerance = omega_peak**2 * abs(h[1, 20])
    assert seen[1] ** 2 / (2 * ratio) == pytest.approx(accelerance)


def test_a_band_without_lines_takes_the_nearest_one_and_never_nought() -> None:
    frequency = np.arange(0.0, 64.0)
    h = np.ones((3, 1, 64), complex)
    for band, line in (((0.0, 0.0), 1.0), ((30.2, 30.3), 31.0)):
        one = frfs(frequency, h, ("acceleration",) * 3, (DOFS[0],), band)
        (stiffness,) = rig_of_modes(modal_model(), one, "test", 5).system("test").stiffness[0]
        assert np.sqrt(stiffness) / (2 * np.pi) == pytest.approx(line)


def test_without_a_driving_point_masses_are_unknown() -> None:
    with pytest.raises(EmaError, match="no driving point"):
        rig_of_modes(modal_model(mode(10.0, 0.02, [1.0, 0.5, 0.2]), scaled=False), NO_FRFS, "test", 5)
    elsewhere = frfs(
        np.arange(4.0), np.ones((3, 1, 4), complex), ("velocity",) * 3, (Dof.parse("d.x"),), (1.0, 3.0)
    )
    with pytest.raises(EmaError, match="no mode was identified"):
        rig_of_modes(modal_model(), elsewhere, "test", 5)
