"""Records in windows: what is compared, exact derivatives, and a fit that leads from far off."""

from __future__ import annotations

import numpy as np
import pytest

import ema_pipeline as ema
from ema_pipeline.diagnose.records import in_windows, record_model
from ema_pipeline.effects.library import effect_library
from ema_pipeline.ingest.description import read_description
from ema_pipeline.ingest.driven import load_driven
from ema_pipeline.observations.fitting import QUICK, annealed, wide
from ema_pipeline.observations.records import RecordObservations
from tests.continuous_cases import RIG, write_oscillator

LIBRARY = effect_library()


@pytest.fixture(scope="module")
def windows(tmp_path_factory: pytest.TempPathFactory) -> RecordObservations:
    """An oscillator whose cubic spring carries a good part of the force."""
    folder = tmp_path_factory.mktemp("hardening")
    raw = write_oscillator(folder / "raw", lambda x, v: 1e10 * x**3)
    (folder / "rig.toml").write_text(RIG.replace("1.0 }", "2.0 }").replace("1e4", "5e4"))
    one, two = (r for r in load_driven(read_description(raw)))
    rig = ema.load_rig(folder / "rig.toml")
    return in_windows(RecordObservations(rig, rig.configurations[0], [one], [two]))


def test_windows_lie_in_the_record_and_do_not_overlap(windows: RecordObservations) -> None:
    (data,) = windows.data
    assert np.all(np.diff(data.starts) >= data.samples)
    assert data.starts[0] > 0
    assert data.starts[-1] + data.samples < data.record.n_samples
    np.testing.assert_array_equal(
        data.responses[1, 0], data.record.responses[0, data.starts[1] :][: data.samples]
    )


@pytest.mark.parametrize("label", ["cubic_spring@mass.x", "hysteresis@mass.x"])
def test_derivatives_are_those_of_the_residuals(windows: RecordObservations, label: str) -> None:
    problem = record_model(windows, LIBRARY, [label]).problem(windows)
    x = problem.start() + 0.1 * np.random.default_rng(0).standard_normal(len(problem.unknowns))
    x, scatters = problem.unknowns.clipped(x), wide(windows)
    found = problem.residuals(x, scatters)
    own = [i for i, n in enumerate(problem.unknowns.names) if "sample" in n][:3]
    sizes = [problem.unknowns.index[n] for n in problem.sizes]
    for i in (0, 1, *sizes, *own):
        ends = []
        for h in (-1e-5, 1e-5):
            moved = x.copy()
            moved[i] += h
            ends.append(problem.residuals(moved, scatters, derivatives=False).values)
        slope = (ends[1] - ends[0]) / 2e-5
        np.testing.assert_allclose(
            found.jacobian[:, i], slope, atol=1e-3 * max(float(np.max(np.abs(slope))), 1e-6)
        )


def test_a_fit_leads_from_far_off_to_a_strong_cubic_spring(windows: RecordObservations) -> None:
    model = record_model(windows, LIBRARY, ["cubic_spring@mass.x"])
    problem = model.problem(windows)
    name = "cubic_spring@mass.x.stiffness"
    starts = [problem.start({name: size}) for size in (2e9, 6e9)]
    fit = annealed(windows, model, starts, QUICK)
    assert fit.posterior.error < 1.5
    assert problem.parameter_values(fit.posterior.x)[name] == pytest.approx(1e10, rel=0.05)
