"""One record of a test in progress: its hits, and how they agree with those before."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.frf.channel_faults import EXCHANGED
from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.points import POINT
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.description import RecordDescription, TestDescription
from ema_pipeline.ingest.hit_checks import hits_of_test
from ema_pipeline.ingest.load import load_record
from ema_pipeline.ingest.records import Hit, HitSamples, Record, cut_hit

LEAST_COHERENCE = 0.8
"""Median coherence of a channel over the band, below which the hits on a point do not agree."""
_REVERSED = -0.5
"""Correlation of a channel's FRF with that of earlier hits below which its sign is another one."""


@dataclass(frozen=True)
class JudgedRecord:
    """What is known of one record.

    Attributes
    ----------
    file : str
    impact : Dof
    hits : tuple of Hit
    good : int
        Hits that serve.
    faults : tuple of str
        Why a hit or a channel does not serve, one phrase each.
    remarks : tuple of str
        What else to look at.
    coherence : dict of str to float
        Median over the band of every channel, of all good hits on the point so far; empty for fewer than two.
    """

    file: str
    impact: Dof
    hits: tuple[Hit, ...]
    good: int
    faults: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    coherence: Mapping[str, float] = field(default_factory=dict)


def judge_record(
    test: TestDescription,
    entry: RecordDescription,
    before: Sequence[HitSamples],
    elsewhere: Sequence[HitSamples] = (),
) -> tuple[JudgedRecord, list[HitSamples]]:
    """Judge one record.

    Parameters
    ----------
    test : TestDescription
    entry : RecordDescription
    before : sequence of HitSamples
        Good hits of other records on the same point.
    elsewhere : sequence of HitSamples
        Good hits on other points.

    Returns
    -------
    judged : JudgedRecord
    samples : list of HitSamples
        Of its good hits, in memory.

    Raises
    ------
    EmaError
        If the record cannot be read, or contradicts the description.
    """
    record = load_record(test, entry)
    hits = hits_of_test([record])
    accepted = [_in_memory(record, h) for h in hits if h.accepted]
    copied = [_copied(h, [*before, *elsewhere]) for h in accepted]
    good = [h for h, file in zip(accepted, copied, strict=True) if not file]
    faults = [
        v.message for h in hits for v in h.verdicts if not v.passes and v.consequence != "warn" and v.message
    ]
    faults += [f"holds the same force as {file}, bit for bit: a copy, and no blow" for file in copied if file]
    remarks = [
        v.message for h in hits for v in h.verdicts if not v.passes and v.consequence == "warn" and v.message
    ]
    coherence: dict[str, float] = {}
    if good:
        faults += _reversed_channels(good, before)
        remarks += _driving_point(good)
        coherence = _coherence([*before, *good])
        low = [f"{name} {value:.2f}" for name, value in coherence.items() if value < LEAST_COHERENCE]
        if low:
            remarks = _of_another_point([*before, *good], elsewhere) + remarks
            remarks.append(f"low coherence so far: {', '.join(low)}")
    once = tuple(dict.fromkeys(faults)), tuple(dict.fromkeys(remarks))
    judged = JudgedRecord(entry.file, record.impact, hits, len(good), *once, coherence)
    return judged, good


def _copied(hit: HitSamples, known: Sequence[HitSamples]) -> str:
    """File of the earlier hit that this one is a copy of; empty for none."""
    return next((b.hit.file for b in known if np.array_equal(b.force, hit.force)), "")


def _in_memory(record: Record, hit: Hit) -> HitSamples:
    """The samples of a hit, which may stay longer than its file."""
    cut = cut_hit(record, hit)
    return dataclasses.replace(
        cut, force=np.array(cut.force), responses=np.asarray(cut.responses[:]), before=None
    )


def _frfs(hits: Sequence[HitSamples]) -> FrfSet:
    """FRFs of hits on one point, all cut to the length of the shortest."""
    length = min(h.force.size for h in hits)
    return estimate_frfs([_cut(h, length) for h in hits], FrfSettings())


def _band(frfs: FrfSet) -> slice:
    low, high = np.searchsorted(frfs.frequency_hz, frfs.band_hz)
    return slice(max(int(low), 1), max(int(high), int(low) + 2))


def _coherence(hits: Sequence[HitSamples]) -> dict[str, float]:
    """Median coherence over the band by DOF; empty for one hit."""
    if len(hits) < 2:
        return {}
    frfs = _frfs(hits)
    values = frfs.coherence[:, 0, _band(frfs)]
    return {
        d.point: float(np.median(v))
        for d, v in zip(frfs.outputs, values, strict=True)
        if np.all(np.isfinite(v))
    }


def _of_another_point(hits: Sequence[HitSamples], elsewhere: Sequence[HitSamples]) -> list[str]:
    """Which hits on a point are like those on another one, see `check_points`."""
    if not elsewhere:
        return []
    point = str(hits[0].hit.impact.point)
    verdicts = _frfs([*hits, *elsewhere]).verdicts
    return [v.message for v in verdicts if v.check == POINT and v.channel == point and not v.passes]


def _reversed_channels(now: Sequence[HitSamples], before: Sequence[HitSamples]) -> list[str]:
    """Channels whose FRF has changed its sign since the hits before."""
    if not before:
        return []
    length = min(h.force.size for h in (*now, *before))
    new, old = (_frfs([_cut(h, length) for h in hits]) for hits in (now, before))
    band = _band(new)
    at = {d.point: i for i, d in enumerate(old.outputs)}
    found = []
    for i, d in enumerate(new.outputs):
        if d.point in at and _correlation(new.frf[i, 0, band], old.frf[at[d.point], 0, band]) < _REVERSED:
            found.append(
                f"{d.point} is reversed against earlier hits on this point; look at its sensor and cable"
            )
    return found


def _cut(hit: HitSamples, length: int) -> HitSamples:
    return dataclasses.replace(hit, force=hit.force[:length], responses=hit.responses[:, :length])


def _correlation(a: NDArray[np.complex128], b: NDArray[np.complex128]) -> float:
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(np.vdot(a, b).real / size) if size > 0 else 0.0


def _driving_point(hits: Sequence[HitSamples]) -> list[str]:
    """What the checks of the driving points' signs say."""
    of_signs = ("driving point", EXCHANGED)
    return [v.message for v in _frfs(hits).verdicts if v.check in of_signs and not v.passes and v.message]
