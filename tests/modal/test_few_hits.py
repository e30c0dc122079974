"""Points that were struck once, sensors that were moved, and zeros of the force's spectrum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from accepted_hits import accepted
from simulate_modal import TrueSystem, records_of, simulate_hits

from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.ingest.records import HitSamples
from ema_pipeline.modal.data import analysis_band
from ema_pipeline.modal.drift.align import Alignment, align
from ema_pipeline.modal.force_zeros import REASON, without_zeros
from ema_pipeline.modal.hit_to_hit import identify_hits
from ema_pipeline.modal.identify import AT_PEAK, identify
from ema_pipeline.modal.peaks import NO_PEAKS, KnownPeaks
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.modal.types import ModalModel

SYSTEM = TrueSystem(
    np.array([40.0, 47.0, 90.0]),
    np.array([0.01, 0.008, 0.006]),
    np.array([[1.0, 0.7, 0.0, 0.0], [0.0, 0.0, 1.0, 0.6], [0.6, -1.0, 0.5, 0.8]]),
)
"""Its second mode shows where its third point is struck, and the first one does not."""


def hits_of(
    system: TrueSystem, points: list[int], n_hits: int, noise: float = 1e-3, record_s: float = 4.0
) -> list[HitSamples]:
    outputs = list(range(system.shapes.shape[1]))
    made = simulate_hits(
        system,
        outputs,
        points,
        f_max=400,
        record_s=record_s,
        n_hits=n_hits,
        force_noise=noise,
        response_noise=noise,
        rng=np.random.default_rng(3),
    )
    return accepted(records_of(made, outputs, points))


def modes_of(hits: Sequence[HitSamples]) -> ModalModel:
    return identify_hits(lambda: hits, lambda: estimate_frfs(hits), FrfSettings(), ModalSettings()).modal


def alignment_of(hits: Sequence[HitSamples]) -> Alignment:
    frfs = estimate_frfs(hits)
    return align(lambda: hits, frfs, FrfSettings(), analysis_band(frfs, ModalSettings()))


def test_a_point_that_was_hit_once_counts_beside_others_that_were_hit_more() -> None:
    """Its scatter is not known; what only it shows is."""
    hits = [h for h in hits_of(SYSTEM, [0, 2], 4) if h.hit.impact.point == "p0.z" or "_0" in h.hit.file]
    assert sorted(h.hit.impact.point for h in hits) == ["p0.z"] * 4 + ["p2.z"]
    found = modes_of(hits)
    assert [m.frequency_hz for m in found.modes] == pytest.approx(SYSTEM.frequency_hz, rel=1e-4)
    second = found.modes[1]
    assert second.damping_ratio == pytest.approx(0.008, abs=3 * second.damping_std)
    assert second.damping_std < 0.01 * second.damping_ratio


def test_one_hit_on_each_of_two_points() -> None:
    found = modes_of(hits_of(SYSTEM, [0, 2], 1))
    assert [m.frequency_hz for m in found.modes] == pytest.approx(SYSTEM.frequency_hz, rel=1e-3)


def test_sensors_that_are_moved_make_no_peak_seem_to_move() -> None:
    """Each place shows another share of a heavily damped mode in the flank of a peak."""
    system = TrueSystem(
        np.array([60.0, 252.0, 262.0]),
        np.array([0.01, 0.0117, 0.035]),
        np.array([[1.0, 0.7, 0.5, 0.9, 0.6], [1.0, 0.9, -0.8, 0.7, 0.8], [0.6, -1.2, 0.9, 1.4, -0.5]]),
    )
    hits = hits_of(system, [0], 12, noise=1e-4)
    roved = []
    for k, hit in enumerate(hits):
        rows = [0, 1 + k % 4]  # the first sensor stays at the point that is struck
        roved.append(
            replace(
                hit,
                responses=np.asarray(hit.responses)[rows],
                channels=tuple(hit.channels[r] for r in rows),
                before=None,
            )
        )
    alignment = alignment_of(roved)
    assert not alignment.aligned
    assert all(p.own_spread < 5e-6 for p in alignment.peaks)
    for mode, zeta in zip(modes_of(roved).modes, system.damping_ratio, strict=True):
        assert mode.damping_ratio == pytest.approx(zeta, abs=3.5 * mode.damping_std)


@pytest.fixture(scope="module")
def at_zero() -> list[HitSamples]:
    """Hits whose force has a zero at 300 Hz."""
    hits = []
    for hit in hits_of(SYSTEM, [0], 3):
        rate = hit.sample_rate_hz
        spectrum = np.fft.rfft(hit.force)
        f = np.fft.rfftfreq(hit.force.size, 1 / rate)
        low = 0.05 / (1 + (f / 150.0) ** 4)  # a soft tip
        dip = np.minimum(1.0, 0.02 + np.abs(f - 300.0) / 8.0)
        hits.append(replace(hit, force=np.fft.irfft(spectrum * low * dip, hit.force.size)))
    return hits


@pytest.mark.parametrize(
    ("frequency_hz", "relative_std", "flags", "stays"),
    [
        pytest.param(300.5, 0.1, (), False, id="at a zero"),
        pytest.param(300.5, 0.01, (), True, id="known well"),
        pytest.param(300.5, 0.1, (AT_PEAK,), True, id="a plain peak"),
        pytest.param(340.0, 0.1, (), True, id="between zeros"),
    ],
)
def test_a_pole_at_a_zero_of_the_force_is_no_mode_unless_it_is_known_well(
    at_zero: list[HitSamples],
    frequency_hz: float,
    relative_std: float,
    flags: tuple[str, ...],
    stays: bool,
) -> None:
    frfs = estimate_frfs(hits_of(SYSTEM, [0], 3))
    modal = identify(frfs, ModalSettings())
    zeta = 0.01
    pole = 2 * np.pi * frequency_hz * complex(-zeta, 1.0)
    added = replace(
        modal.modes[-1],
        frequency_hz=frequency_hz,
        damping_ratio=zeta,
        damping_std=relative_std * zeta,
        pole=pole,
        flags=flags,
    )
    made = replace(modal, modes=(*modal.modes, added))
    left = without_zeros(made, lambda: at_zero, frfs, NO_PEAKS)
    assert (left.modes == made.modes) is stays
    assert [e.reason for e in left.left_out if e.frequency_hz == frequency_hz] == ([] if stays else [REASON])
    asked = KnownPeaks(np.array([pole]), np.array([5.0]), np.ones((1, 2)))
    assert without_zeros(made, lambda: at_zero, frfs, asked) is made
