"""Derivatives of what is marched under forces, beside differences of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from continuous_cases import write_oscillator

import ema_pipeline as ema
from ema_pipeline.diagnose.records import record_model
from ema_pipeline.effects.library import effect_library
from ema_pipeline.ingest.description import read_description
from ema_pipeline.ingest.driven import load_driven
from ema_pipeline.observations.records import RecordObservations

LIBRARY = effect_library()
CHAIN = """
masses = [{ at = "mass.x", value = 2.0 }, { at = "b.x", value = 1.0 }, { at = "c.x", value = 3.0 }]
springs = [
  { at = "mass.x", value = 5e4 },
  { between = ["mass.x", "b.x"], value = 8e4 },
  { between = ["b.x", "c.x"], value = 4e4 },
]
"""
DAMPERS = 'dampers = [{ at = "mass.x", value = 20.0 }, { between = ["b.x", "c.x"], value = 5.0 }]\n'
ONE = """
masses = [{ at = "mass.x", value = 2.0 }]
springs = [{ at = "mass.x", value = 5e4 }]
"""
FREE = CHAIN.replace('  { at = "mass.x", value = 5e4 },\n', "")


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_oscillator(tmp_path_factory.mktemp("test") / "raw", lambda x, v: 0.0)


@pytest.mark.parametrize("rig", [CHAIN, CHAIN + DAMPERS, ONE, FREE], ids=["ratios", "dampers", "one", "free"])
@pytest.mark.parametrize(
    "effects", [[], ["cubic_spring@mass.x", "hysteresis@mass.x", "mass@mass.x", "spring@mass.x"]]
)
def test_derivatives_of_the_system_are_those_of_differences(
    raw: Path, tmp_path: Path, rig: str, effects: list[str]
) -> None:
    (tmp_path / "rig.toml").write_text(rig)
    known = ema.load_rig(tmp_path / "rig.toml")
    records = list(load_driven(read_description(raw)))
    observations = RecordObservations(known, known.configurations[0], [records[0]], [records[1]])
    model = record_model(observations, LIBRARY, effects).problem(observations).model  # type: ignore[attr-defined]
    random = np.random.default_rng(3)
    x = model.unknowns.clipped(model.start() + 0.2 * random.standard_normal(len(model.unknowns)))
    here = model.driven(x)
    found = model.slopes(x, here, 0)
    for i in range(model.marched):
        ends, h = [], 1e-5
        for step in (-h, h):
            moved = x.copy()
            moved[i] += step
            ends.append(model.driven(moved))
        for mine, low, high in zip(found.arrays, ends[0].varied, ends[1].varied, strict=False):
            slope = (high - low) / (2 * h)
            size = max(float(np.max(np.abs(low))), 1e-9) if low.size else 1.0
            np.testing.assert_allclose(
                mine[..., i], slope, atol=2e-6 * size, rtol=1e-4, err_msg=model.unknowns.names[i]
            )
