"""Errors of models that run freely through records: known differences, excerpts and lines."""

from __future__ import annotations

import importlib
from dataclasses import replace

import numpy as np
import pytest
from two_bodies import BEGIN, decaying, rig, steady, truth

from ema_pipeline.observations.fitting import Model
from ema_pipeline.observations.record_data import DISCREPANCY
from ema_pipeline.observations.records import RecordObservations

free_run = importlib.import_module("ema_pipeline.observations.free_run")
__all__ = ["rig"]  # a fixture


def test_a_wrong_calibration_is_an_error_of_its_size_in_every_record(rig) -> None:
    held = [
        replace(decaying(-0.5 * BEGIN, 200), name="held", use="held_out"),
        replace(steady((4,)), use="held_out"),
    ]
    observations = RecordObservations(rig, rig.configurations[0], [steady(), decaying(BEGIN)], held)
    problem = observations.problem((), {})
    true = dict(zip(problem.unknowns.names, truth(problem).tolist(), strict=True))
    wrong = true | {"calibration of ab": np.log(1.1), "zero of xa": 3.0}
    found = free_run.free_run(observations, [(Model(), wrong), (Model(), true)])
    named = [(e.record, e.use, e.sensor.point, e.quantity, e.unit) for e in found]
    assert named[:3] == [
        ("steady", "fit", "a.x", "displacement", "m"),
        ("steady", "fit", "b.x", "acceleration", "m/s²"),
        ("decaying", "fit", "a.x", "displacement", "m"),
    ]
    assert [e.use for e in found] == ["fit"] * 4 + ["held_out"] * 4
    assert [e.samples for e in found] == [64, 64, 100, 100, 180, 180, 64, 64]
    zero = 3.0 * DISCREPANCY * observations.rms[0]
    np.testing.assert_allclose(found[0].linear - found[0].measured, zero, rtol=1e-3)
    records = [*(d.record for d in observations.data), *held]
    for k, e in enumerate(found):
        measured = records[k // 2].responses[k % 2][-e.samples :]
        assert e.rmse < 1e-4 * np.std(measured)
        assert e.relative == pytest.approx(e.rmse / np.std(measured))
        if k in (
            1,
            3,
            7,
        ):  # the states of the record held out are searched, and take up some of what is wrong
            assert e.before == pytest.approx(0.1 * np.sqrt(np.mean(measured**2)), rel=1e-3)
        elif k in (0, 2, 6):
            assert e.before == pytest.approx(zero, rel=1e-3)
        else:
            assert 0.02 < e.before / np.std(measured) < 0.15


def test_errors_leave_the_transient_out_and_show_the_largest_response(rig) -> None:
    record = decaying(BEGIN, 120, transient=20)
    one = RecordObservations(rig, rig.configurations[0], [record])
    gap = np.zeros((120, 2))
    gap[:20] = 1e3
    gap[20:] = [2e-5, -3.0]
    found = free_run._errors(one, [record.responses.T + gap, record.responses.T - 0.5 * gap])
    assert [e.before for e in found] == pytest.approx([2e-5, 3.0])
    assert [e.rmse for e in found] == pytest.approx([1e-5, 1.5])
    assert [e.relative for e in found] == pytest.approx(
        [1e-5, 1.5] / np.std(record.responses[:, 20:], axis=1)
    )
    for k, e in enumerate(found):
        assert e.at_s == 20 / 512
        np.testing.assert_array_equal(e.measured, record.responses[k, 20:])
        np.testing.assert_allclose(e.simulated - e.measured, -0.5 * gap[20:, k])
        np.testing.assert_allclose(e.linear - e.measured, gap[20:, k])
        assert len(e.frequency_hz) == len(e.size) == len(e.rest) == len(e.rest_before) == 50
        np.testing.assert_allclose(e.rest_before, 2 * e.rest, rtol=1e-6, atol=1e-12)
    # A mean that is measured is no line, one that is missed is an error
    np.testing.assert_allclose(found[0].rest_before[0], 2e-5, rtol=0.02)


@pytest.mark.parametrize(
    ("peak", "start", "samples", "expected"),
    [
        (5000, None, 9000, (4250, 5750)),
        (200, 100, 9000, (100, 1600)),
        (50, 100, 9000, None),
        (8900, None, 9000, (7500, 9000)),
        (30, 20, 60, (20, 60)),
        (30, None, 60, (0, 60)),
    ],
)
def test_an_excerpt_lies_about_the_largest_response_behind_the_transient(
    peak: int, start: int | None, samples: int, expected: tuple[int, int] | None
) -> None:
    measured = np.zeros(samples)
    measured[peak] = -3.0
    measured[samples // 2 + 7] += 1.0
    found = free_run._excerpt(measured, slice(start, None))
    if expected is None:  # the largest one that counts is the second
        expected = (samples // 2 + 7 - 750, samples // 2 + 7 + 750)
    assert (found.start, found.stop) == expected


def test_lines_of_a_sine_are_its_amplitude_averaged_over_groups() -> None:
    """A Hann window leaves the amplitude at the line of the sine and half of it at both neighbours."""
    count, rate, line, size = 3208, 100.0, 402, 2.0
    sine = size * np.sin(2 * np.pi * line * np.arange(count) / count)
    frequency, lines = free_run._smoothed(np.stack([sine, 2 * sine]), rate)
    width = 4  # 1604 lines in at most about 400 groups
    assert lines.shape == (2, 401)
    expected = np.zeros(401)
    for k in (line - 1, line, line + 1):
        expected[(k - 1) // width] += (size if k == line else size / 2) ** 2 / width
    np.testing.assert_allclose(lines[0], np.sqrt(expected), atol=2e-3)
    np.testing.assert_allclose(lines[1], 2 * lines[0])
    np.testing.assert_allclose(frequency[:2], np.array([2.5, 6.5]) * rate / count)
    assert len(frequency) == 401
