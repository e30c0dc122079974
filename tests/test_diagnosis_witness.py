"""The second witness: FRFs that were not fitted."""

from __future__ import annotations

import numpy as np
import pytest
from test_diagnose import BODIES, CRACK, FEW, RIG, SETTINGS, measure, true_system

from ema_pipeline.correlate.measured import MeasuredModes, from_frequencies
from ema_pipeline.diagnose import diagnose
from ema_pipeline.diagnose.witness import FrfError, Witness, contradicts, frf_error, frf_lines
from ema_pipeline.dof import Dof
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.mechanics.frf import accelerance
from ema_pipeline.mechanics.modes import normal_modes
from ema_pipeline.mechanics.system import LinearSystem, sensor_rows

LIBRARY = {"mesh_stiffness_loss": FEW["mesh_stiffness_loss"]}
CRACKED = rig_with_effects(RIG, [CRACK])
TRUTH = {"sun_planet_mesh_stiffness": 1e7, f"{CRACK}.fraction": 0.3}
OUTPUTS = tuple(Dof(b, d) for b in BODIES for d in ("x", "y", "u"))
INPUTS = (Dof("sun", "y"), Dof("planet1", "x"))


def frfs(
    noise: float = 0.01, calibrated: bool = True, scale: float = 1.0, system: LinearSystem | None = None
) -> FrfSet:
    """FRFs of the cracked rig with complex noise relative to their modulus."""
    rng = np.random.default_rng(3)
    f = np.arange(0, 2000, 0.25)
    system = system or CRACKED.system("no_ring", TRUTH)
    h = accelerance(system, f, sensor_rows(system, OUTPUTS), sensor_rows(system, INPUTS))
    sigma = noise * np.abs(h)
    h = h + sigma * (rng.normal(size=h.shape) + 1j * rng.normal(size=h.shape)) / np.sqrt(2)
    return FrfSet(
        frequency_hz=f,
        frf=scale * h,
        coherence=np.ones(h.shape),
        variance=(scale * sigma) ** 2,
        outputs=OUTPUTS,
        inputs=INPUTS,
        quantities=("acceleration",) * len(OUTPUTS),
        hits=np.full(h.shape[:2], 3),
        estimator="H1",
        record_s=4.0,
        response_decay_rad_s=0.0,
        delay_s=np.zeros(2),
        band_hz=(5.0, 2000.0),
        force_calibrated=calibrated,
        sensor_mass_kg=np.zeros(len(OUTPUTS)),
    )


def modes() -> dict[str, MeasuredModes]:
    f, _ = normal_modes(CRACKED.system("no_ring", TRUTH))
    return {"no_ring": from_frequencies("no_ring", f[f > 5])}


def test_the_right_model_is_as_near_as_noise_and_calibration_allow_and_the_wrong_one_is_not() -> None:
    lines = frf_lines({"no_ring": frfs()}, modes())
    before = frf_error(RIG, {"sun_planet_mesh_stiffness": 1e7}, lines)
    after = frf_error(CRACKED, TRUTH, lines)
    # 1 % of noise against an allowance of 5 %
    assert after.error < 0.4
    assert before.error > 3
    assert set(after.by_impact) == {"no_ring: sun.y", "no_ring: planet1.x"}
    assert not contradicts(before, after)
    assert contradicts(after, before)


def test_fifteen_per_cent_of_noise_count_as_the_scatter_of_the_hits_says() -> None:
    lines = frf_lines({"no_ring": frfs(0.15)}, modes())
    # the scatter is averaged over the lines, so loud lines count for more and quiet ones for less
    assert frf_error(CRACKED, TRUTH, lines).error == pytest.approx(1.0, abs=0.3)


def test_a_hammer_in_volts_is_compared_up_to_its_factor() -> None:
    in_volts = {"no_ring": frfs(calibrated=False, scale=37.0)}
    assert frf_error(CRACKED, TRUTH, frf_lines(in_volts, modes())).error < 0.4


def test_most_impact_points_must_speak_against_an_effect_before_it_is_contradicted() -> None:
    before = FrfError(1.0, {"a": 1.0, "b": 1.0, "c": 1.0})
    assert not contradicts(before, FrfError(2.0, {"a": 3.3, "b": 0.9, "c": 0.9}))
    assert contradicts(before, FrfError(2.0, {"a": 2.0, "b": 2.1, "c": 0.9}))
    assert not contradicts(before, FrfError(1.03, {"a": 1.03, "b": 1.03, "c": 1.03}))
    assert not contradicts(FrfError(float("nan"), {}), FrfError(float("nan"), {}))


def test_frfs_confirm_a_claim_and_what_they_contradict_is_not_claimed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    effect = {f"{CRACK}.fraction": 0.3}
    system, _ = true_system(effect, {}, np.random.default_rng(1))  # as measure() draws it
    measured, seen = measure(effect, seed=1), {"no_ring": frfs(system=system)}
    mended = diagnose(RIG, measured, SETTINGS, LIBRARY, frfs=seen)
    first = mended.candidates[0]
    assert first.claimed
    assert first.frf_error_after < 0.5 * first.frf_error_before
    assert first.frf_impacts_better == first.frf_impacts == 2
    assert mended.ladder.rungs[1].frf_error == first.frf_error_after
    monkeypatch.setattr(Witness, "rejects", lambda self, base, fitted, explains_modes: True)
    doubted = diagnose(RIG, measured, SETTINGS, LIBRARY, frfs=seen)
    assert not any(c.claimed for c in doubted.candidates)
    assert doubted.verdict != "effect"
    assert doubted.ladder.note.startswith(f"the FRFs contradict {CRACK}")
