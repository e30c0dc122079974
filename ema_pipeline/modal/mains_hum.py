"""Mains hum in the records, which a fit follows with poles that hardly decay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.hit_checks import HUM_HZ
from ema_pipeline.modal.left_out import sentences, taken_out
from ema_pipeline.modal.peaks import KnownPeaks
from ema_pipeline.modal.types import ModalModel, Mode

HARMONICS = 13
"""Multiples of the mains' frequency looked at: those beyond are weak, and soon as dense as what the mains drifts by."""

MAINS_DRIFT = 1e-3
"""Relative: ±0.05 Hz, within which grids are held."""

GOES_ON = 0.3
"""Share of a mode left at the end of the record above which it may be a tone: noise makes tones seem to decay."""

REASON = "it hardly decays within the record and lies at a multiple of the mains' frequency: hum"


def without_hum(modal: ModalModel, frfs: FrfSet, wanted: KnownPeaks) -> ModalModel:
    """The modes without those that are mains hum, which are named among what is left out.

    Parameters
    ----------
    modal : ModalModel
    frfs : FrfSet
    wanted : KnownPeaks
        Modes that the user asked for, which stay.
    """
    rest_s = max(frfs.record_s - float(np.nanmean(frfs.delay_s)), 0.5 * frfs.record_s)
    gone = [
        k
        for k, mode in enumerate(modal.modes)
        if _is_hum(mode, rest_s, frfs.response_decay_rad_s)
        and not np.any(np.abs(wanted.poles.imag - mode.pole.imag) < wanted.reach)
    ]
    if not gone:
        return modal
    fewer = taken_out(modal, gone, "a tone", REASON)
    named = tuple(entry for entry in fewer.left_out if entry.reason == REASON)
    return replace(fewer, notes=(*fewer.notes, *sentences(named)))


def _is_hum(mode: Mode, rest_s: float, window_rad_s: float) -> bool:
    """True for a pole at a multiple of 50 or 60 Hz that hardly decays, as far as no exponential window hides that."""
    if window_rad_s or np.exp(mode.pole.real * rest_s) < GOES_ON:
        return False
    f = mode.frequency_hz
    reach = max(MAINS_DRIFT * f, 0.5 / rest_s)  # half a line: a tone that is cut off is no sharper
    return any(
        1 <= round(f / mains) <= HARMONICS and abs(f - round(f / mains) * mains) < reach for mains in HUM_HZ
    )
