"""Mains hum taken off the hits: modes are as well known as without it, and nothing else is taken off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from accepted_hits import accepted
from simulate_modal import Hits, TrueSystem, records_of, simulate_hits

from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.records import HitSamples
from ema_pipeline.lazy_samples import CutSamples
from ema_pipeline.modal.hit_to_hit import identify_hits
from ema_pipeline.modal.hum_removal import Hum, hum_of
from ema_pipeline.modal.identify import identify
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.modal.types import ModalModel

SYSTEM = TrueSystem(np.array([51.1, 82.0, 171.0]), np.array([0.01, 0.006, 0.005]), np.ones((3, 2)))


def hits_of(
    share: float, system: TrueSystem = SYSTEM, record_s: float = 4.0, n_hits: int = 6, pretrigger: int = 20
) -> list[HitSamples]:
    """Hits on one point with hum and two of its harmonics, `share` of the largest response, in both responses.

    The mains' frequency differs from hit to hit and wanders within each, and the harmonics' phases with it.
    """
    rng = np.random.default_rng(7)
    made = simulate_hits(
        system, [0, 1], [0], f_max=400, record_s=record_s, n_hits=n_hits, rng=rng,
        force_noise=1e-4, response_noise=1e-4, pretrigger=pretrigger,
    )  # fmt: skip
    time = np.arange(made.force.shape[-1]) / made.sample_rate_hz
    responses = made.responses.copy()
    for hit in range(n_hits):
        hz = 50 * (1 + 2e-4 * rng.standard_normal()) + 1e-3 * (time - time.mean())
        phase = rng.uniform(0, 2 * np.pi) + 2 * np.pi * np.cumsum(hz) / made.sample_rate_hz
        hum = np.cos(phase) + 0.4 * np.cos(2 * phase + 1) + 0.5 * np.cos(3 * phase + 2)
        for output, size in ((0, 1.0), (1, -0.6)):
            responses[0, hit, output] += share * np.max(np.abs(made.responses)) * size * hum
    rest = made.sample_rate_hz, made.pretrigger, made.force_noise, made.response_noise
    return accepted(records_of(Hits(made.force, responses, *rest), [0, 1], [0]))


def modes_of(hits: Sequence[HitSamples]) -> ModalModel:
    return identify_hits(lambda: hits, lambda: estimate_frfs(hits), FrfSettings(), ModalSettings()).modal


def hum_in(hits: Sequence[HitSamples]) -> tuple[Hum | None, FrfSet]:
    frfs = estimate_frfs(hits)
    return hum_of(identify(frfs, ModalSettings()), lambda: hits, frfs), frfs


@pytest.mark.parametrize(("share", "most"), [(0.003, 3), (0.03, 30)])
def test_modes_beside_hum_are_known_nearly_as_well_as_without(share: float, most: float) -> None:
    """As well as hum that wanders allows."""
    hits = hits_of(share)
    beside, without = modes_of(hits), modes_of(hits_of(0.0))
    assert any("hum at 50, 100, 150 Hz was taken off" in note for note in beside.notes)
    assert not any("hum" in note for note in without.notes)
    left = identify(estimate_frfs(hits), ModalSettings())
    assert len(beside.modes) == len(without.modes) == len(SYSTEM.frequency_hz)
    for mode, clean, true, zeta in zip(
        beside.modes, without.modes, SYSTEM.frequency_hz, SYSTEM.damping_ratio, strict=True
    ):
        assert abs(mode.frequency_hz - true) < 3 * mode.frequency_std_hz
        assert abs(mode.damping_ratio - zeta) < 3 * mode.damping_std
        untreated = min(left.modes, key=lambda m, true=true: abs(m.frequency_hz - true))
        assert mode.damping_std < 0.2 * untreated.damping_std
        assert mode.damping_std < most * clean.damping_std


def test_what_is_taken_off_is_the_hum_and_nothing_else() -> None:
    hits, clean = hits_of(0.01), hits_of(0.0)
    hum, _ = hum_in(hits)
    assert hum is not None
    for less, struck, true in zip(hum.taken_off(lambda: hits)(), hits, clean, strict=True):
        before, after = (np.asarray(h.responses) - np.asarray(true.responses) for h in (struck, less))
        assert np.std(after) < 0.05 * np.std(before)
        assert np.array_equal(less.responses[1, 100:200], np.asarray(less.responses)[1, 100:200])


@pytest.mark.parametrize("frequency_hz", [50.01, 100.03, 150.0])
def test_modes_at_multiples_of_the_mains_are_no_hum(frequency_hz: float) -> None:
    system = TrueSystem(np.array([frequency_hz, 213.0]), np.array([0.001, 0.005]), np.ones((2, 2)))
    hits = hits_of(0.0, system, record_s=0.8)
    found, frfs = hum_in(hits)
    assert found is None
    modal = identify(frfs, ModalSettings())
    # nor what is left of one where a pole is off, as it is in hits that differ
    off = replace(modal, modes=tuple(replace(m, pole=m.pole * (1 + 1e-4j)) for m in modal.modes))
    assert hum_of(off, lambda: hits, frfs) is None


def test_a_mode_on_the_hum_stays_what_it_is() -> None:
    system = TrueSystem(np.array([50.02, 213.0]), np.array([0.004, 0.005]), np.ones((2, 2)))
    modal = modes_of(hits_of(0.01, system))
    assert any("hum" in note for note in modal.notes)
    mode = modal.modes[0]
    assert mode.frequency_hz == pytest.approx(50.02, abs=3 * mode.frequency_std_hz)
    assert mode.damping_ratio == pytest.approx(0.004, abs=3 * mode.damping_std)
    assert mode.damping_std < 0.05 * mode.damping_ratio


def test_hits_that_share_no_channel_show_hum_together() -> None:
    """A roving sensor: every hit shows one channel."""
    roved = [
        replace(h, responses=np.asarray(h.responses)[[k % 2]], channels=(h.channels[k % 2],), before=None)
        for k, h in enumerate(hits_of(0.01))
    ]
    hum, frfs = hum_in(roved)
    assert hum is not None
    assert hum.hz == (50.0, 100.0, 150.0)
    assert len(frfs.outputs) == 2
    assert all(np.asarray(h.responses).shape[0] == 1 for h in hum.taken_off(lambda: roved)())


def test_what_begins_with_the_blow_is_no_hum() -> None:
    """Whatever its phase, as what is left of close modes that the fit does not quite meet."""
    begun = []
    for h, clean in zip(hits_of(0.01, pretrigger=200), hits_of(0.0, pretrigger=200), strict=True):
        responses, start = np.array(h.responses), h.hit.peak - h.hit.start - 10
        responses[:, :start] = np.asarray(clean.responses)[:, :start]
        begun.append(replace(h, responses=responses))
    assert hum_in(begun)[0] is None


def test_hum_is_told_by_what_the_record_holds_before_hits_that_are_cut_at_the_blow() -> None:
    cut = []
    for h in hits_of(0.01, pretrigger=200):
        start = h.hit.peak - h.hit.start - 10
        before = CutSamples(np.asarray(h.responses), [0, 1], 0, start)
        less = replace(h, force=h.force[start:], responses=np.asarray(h.responses)[:, start:])
        cut.append(replace(less, hit=replace(h.hit, start=h.hit.start + start), before=before))
    hum, _ = hum_in(cut)
    assert hum is not None
    assert hum.hz == (50.0, 100.0, 150.0)
    assert hum_in([replace(h, before=None) for h in cut])[0] is None


def test_few_hits_do_not_tell_hum_from_what_is_left_of_modes() -> None:
    assert hum_in(hits_of(0.01, n_hits=3))[0] is None


def test_hum_among_many_modes_is_left_where_it_is() -> None:
    """They leave too few lines to tell a tone from them."""
    hz = 50 + 0.7 * np.arange(-4.0, 5.0)
    system = TrueSystem(hz, np.full(9, 0.003), np.random.default_rng(1).normal(size=(9, 2)))
    hum, _ = hum_in(hits_of(0.01, system))
    assert hum is None or 50.0 not in hum.hz
