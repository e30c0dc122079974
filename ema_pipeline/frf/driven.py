"""Records of continuous excitation, one or several forces at once, to FRFs with coherence and variance."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft

from ema_pipeline.check_result import CheckResult
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.channels import ChannelQuality, merged
from ema_pipeline.frf.checks import check_frfs
from ema_pipeline.frf.distortion import Distortion, distortion
from ema_pipeline.frf.local import local_spectra, long_enough
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.spectra import Spectra, solved
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.driven import DrivenRecord

AVERAGES = 6
"""Blocks side by side that a record is cut into where no length is set; overlap nearly doubles them."""
_SHORTEST, _LONGEST = 256, 65536
OVERLAP = 0.5
"""Of blocks with a Hann window: two thirds of what more would add are in it already."""
_INDEPENDENT = 1 / (1 + 2 / 36)
"""Independent averages per block at this overlap (Welch 1967, for a Hann window)."""
_NOTHING = 1e-6
"""Share of the largest power of a force below which a line carries none."""
BAND_OVER_RATE = 1 / 2.56
"""Converters' anti-alias filters are flat up to the sample rate over 2.56."""
_DROP = 1e-4
"""Drop of a force's power at which its band ends, where its noise is not known."""
_NOTABLE = 0.5
"""Coherence between forces from which it is worth a word."""


@dataclass(frozen=True)
class Blocks:
    """How records are cut.

    Attributes
    ----------
    samples : int
    step : int
        From one block's start to the next's.
    window : ndarray, (samples,)
    independent : float
        Independent averages per block.
    whole : bool
        True where a block holds a whole period or burst, so that nothing leaks.
    """

    samples: int
    step: int
    window: NDArray[np.float64]
    independent: float
    whole: bool

    @classmethod
    def of(cls, records: Sequence[DrivenRecord], settings: FrfSettings) -> Blocks:
        """Whole periods or bursts without a window; else half-overlapping blocks with a Hann window."""
        lengths = {r.period or r.frame for r in records}
        if len(lengths) == 1 and (length := lengths.pop()):
            return cls(length, length, np.ones(length), 1.0, True)
        length = settings.block_samples or _block_length(records)
        if length > min(r.n_samples for r in records):
            raise EmaError(
                f"blocks of {length} samples do not fit record '{records[0].name}'; "
                "lower --set frf.block_samples"
            )
        window = np.sqrt(2 / 3) * 2 * np.sin(np.pi * np.arange(length) / length) ** 2
        return cls(length, round(length * (1 - OVERLAP)), window, _INDEPENDENT, False)

    def cut(self, record: DrivenRecord) -> Iterator[tuple[NDArray[np.complex128], NDArray[np.complex128]]]:
        """Spectra of the forces and of the responses of every block, (n_channels, n_lines) each."""
        start = 0 if self.whole else record.transient
        for at in range(start, record.n_samples - self.samples + 1, self.step):
            part = slice(at, at + self.samples)
            yield self._lines(record.force[:, part]), self._lines(record.responses[:, part])

    def _lines(self, samples: NDArray[np.float64]) -> NDArray[np.complex128]:
        about = samples if self.whole else samples - np.mean(samples, axis=1, keepdims=True)
        return np.asarray(rfft(about * self.window, axis=1))


def _block_length(records: Sequence[DrivenRecord]) -> int:
    total = sum(r.n_samples - r.transient for r in records)
    shortest = min(r.n_samples - r.transient for r in records)
    power = 2 ** int(np.log2(max(total // AVERAGES, _SHORTEST)))
    while power > shortest:
        power //= 2
    return int(np.clip(power, 64, _LONGEST))


def estimate_driven_frfs(records: Sequence[DrivenRecord], settings: FrfSettings | None = None) -> FrfSet:
    """Estimate FRFs, coherence and variance from records of continuous excitation.

    With sums over blocks, H1 = Gyf·Gff⁻¹, the least-squares answer to noise on the responses alone; Hv is the answer to
    noise on forces and responses alike, by total least squares of scaled spectra [1]_; H2 = H1 over the coherence, for
    one force. Periods and bursts are taken whole. Other records of one force are cut into blocks with a Hann window,
    half of each overlapping; those of several forces are summed over neighbouring lines, see `frf.local`.

    The variance of H1 is that of least squares, S·(ΣFFᴴ)⁻¹ with S the residual power over n - n_inputs averages. The
    partial coherence of a response and a force is what is left of it once all other forces are taken out of both.

    Parameters
    ----------
    records : sequence of DrivenRecord
        Of one configuration; those that are held out are not used.
    settings : FrfSettings, optional

    Returns
    -------
    FrfSet

    Raises
    ------
    EmaError
        Where forces are one and the same signal, or too few averages tell them apart, and for H2 of several forces.

    References
    ----------
    .. [1] J. S. Bendat, A. G. Piersol, Random Data, 4th ed. (2010), sections 7.3 and 9.3; R. Pintelon, J. Schoukens,
       System Identification: A Frequency Domain Approach, 2nd ed. (2012), section 2.
    """
    settings = settings or FrfSettings()
    kept = _alike([r for r in records if not r.held_out] or list(records))
    first = kept[0]
    n_in, n_out = len(first.forces), len(first.channels)
    total, frequency, blocks = _summed(kept, settings)
    apart = distortion(kept, blocks.samples) if blocks.whole and n_in == 1 and first.period else None
    excited = total.excited(_NOTHING) if apart is None else apart.excited
    band = _band(total.force_power if apart is None else apart.excited[None], frequency, first.sample_rate_hz)
    inside = _inside(frequency, band)
    averages = total.count * blocks.independent
    coherence = total.input_coherence()
    _check_inputs(first, total, averages, excited & inside, blocks, settings)
    found = solved(total, averages, excited, settings.estimator)
    hits = np.full((n_out, n_in), max(int(averages), 1), dtype=np.int64)
    hammer: ChannelQuality | None = None
    for f in first.forces:
        hammer = merged(hammer, ChannelQuality(f.name, f.calibration_std, f.transverse))
    frfs = FrfSet(
        frequency_hz=frequency,
        frf=_bridged(found.frf, excited),
        coherence=_bridged(found.coherence, excited),
        variance=_bridged(found.variance if apart is None else _wider(found.variance, apart), excited),
        outputs=tuple(replace(c.dof, sign=1) for c in first.channels),
        inputs=tuple(replace(f.dof, sign=1) for f in first.forces),
        quantities=tuple(c.quantity for c in first.channels),
        hits=hits,
        estimator=settings.estimator,
        record_s=float(blocks.samples / first.sample_rate_hz),
        response_decay_rad_s=0.0,
        delay_s=np.zeros(n_in),
        band_hz=band,
        force_calibrated=all(f.calibrated for f in first.forces),
        sensor_mass_kg=np.array([c.sensor_mass_kg for c in first.channels]),
        channels=tuple(ChannelQuality(c.name, c.calibration_std, c.transverse) for c in first.channels),
        hammer=hammer,
        excitation=first.excitation or "continuous",
        multiple_coherence=_bridged(found.multiple[:, None], excited)[:, 0] if n_in > 1 else None,
        input_coherence=coherence if n_in > 1 else None,
        noise_variance=None if apart is None else apart.noise,
        distortion_variance=None if apart is None else apart.distortion,
        detected_distortion=None if apart is None else apart.detected,
    )
    verdicts = (*check_frfs(frfs, settings), *_notable(first, coherence, excited & inside, settings))
    return replace(frfs, verdicts=verdicts)


def _summed(
    records: Sequence[DrivenRecord], settings: FrfSettings
) -> tuple[Spectra, NDArray[np.float64], Blocks]:
    """Sums over periods, bursts or blocks; of several random forces over neighbouring lines of whole records."""
    first = records[0]
    n_in, count = len(first.forces), first.n_samples - first.transient
    random = not first.period and not first.frame
    if n_in > 1 and random and settings.block_samples is None and long_enough(records, _SHORTEST // 2):
        total, frequency = local_spectra(records)
        return total, frequency, Blocks(count, count, np.ones(count), 1.0, False)
    blocks = Blocks.of(records, settings)
    frequency = np.asarray(np.fft.rfftfreq(blocks.samples, 1 / first.sample_rate_hz), dtype=np.float64)
    total = Spectra.none(n_in, len(first.channels), len(frequency))
    for record in records:
        for force, response in blocks.cut(record):
            total.add(force, response)
    return total, frequency, blocks


def _bridged(values: NDArray[Any], excited: NDArray[np.bool_]) -> NDArray[Any]:
    """Values at lines that a multisine leaves without force, on straight lines between those that have some."""
    lines, on = np.arange(values.shape[-1]), np.flatnonzero(excited)
    found = values.copy()
    if len(on) < 2:
        return found
    inside = lines[(lines > on[0]) & (lines < on[-1]) & ~excited]
    for o, i in np.ndindex(values.shape[:-1]):
        found[o, i, inside] = np.interp(inside, on, values[o, i, on])
    return found


def _wider(variance: NDArray[np.float64], apart: Distortion) -> NDArray[np.float64]:
    """Variance by noise over periods, and by distortion where realisations show it."""
    return np.asarray(np.where(np.isfinite(apart.total), apart.total, variance))


def _alike(records: list[DrivenRecord]) -> list[DrivenRecord]:
    """Records that can be averaged: of the length of period that most samples have, with the same channels."""
    first = records[0]
    weight: Counter[tuple[int, int]] = Counter()
    for r in records:
        weight[r.period, r.frame] += r.n_samples
    chosen = weight.most_common(1)[0][0]
    kept = [r for r in records if (r.period, r.frame) == chosen]
    for r in kept:
        if [c.dof for c in r.channels] != [c.dof for c in kept[0].channels]:
            raise EmaError(
                f"record '{r.name}': its sensors sit elsewhere than those of '{first.name}'; "
                "put it into a test of its own"
            )
    return kept


def _inside(frequency: NDArray[np.float64], band: tuple[float, float]) -> NDArray[np.bool_]:
    return np.asarray((frequency >= band[0]) & (frequency <= band[1]))


def _band(powers: NDArray[Any], frequency: NDArray[np.float64], rate: float) -> tuple[float, float]:
    """Band in which all forces carry power: from the first line to the last within `_DROP` of the largest."""
    low, high = float(frequency[1]), rate * BAND_OVER_RATE
    for power in powers:
        strong = np.flatnonzero(power[1:] >= _DROP * np.max(power[1:])) + 1
        low, high = max(low, float(frequency[strong[0]])), min(high, float(frequency[strong[-1]]))
    return low, max(high, low + float(frequency[1]))


def _check_inputs(
    first: DrivenRecord,
    total: Spectra,
    averages: float,
    lines: NDArray[np.bool_],
    blocks: Blocks,
    settings: FrfSettings,
) -> None:
    """Refuse forces that the records do not tell apart."""
    n_in = len(first.forces)
    if n_in == 1:
        return
    names = [f.name for f in first.forces]
    if settings.estimator == "H2":
        raise EmaError("H2 is not defined for several forces at once; take --set frf.estimator=H1 or Hv")
    if averages < n_in + 1:
        piece = "period" if blocks.whole else "block"
        what = f"1 {piece} does" if total.count == 1 else f"{total.count} {piece}s do"
        raise EmaError(
            f"{what} not tell {n_in} forces apart ({', '.join(names)}); record at least "
            f"{n_in + 1} {piece}s with other forces each"
        )
    if not lines.any():
        raise EmaError(
            f"the forces {', '.join(names)} share no line at which all of them act; correct the excitation"
        )
    pairs = total.input_coherence()
    for a in range(n_in):
        for b in range(a):
            shared = float(np.median(pairs[a, b, lines]))
            if shared >= settings.input_coherence:
                both = f"forces '{names[b]}' and '{names[a]}'"
                if first.period:
                    raise EmaError(
                        f"{both} repeat together: their coherence over all periods is {shared:.4f} (median over the "
                        "band), so that no estimate tells what each of them does; record at least "
                        f"{n_in} realisations with other phases, or drive one after the other"
                    )
                raise EmaError(
                    f"{both} are the same signal: their coherence is {shared:.4f} (median over the band), so that "
                    "their effects cannot be separated; drive them from independent sources, or one after the other"
                )
    for a, explained in enumerate(total.explained_by_others()):
        shared = float(np.median(explained[lines]))
        if shared >= settings.input_coherence:
            raise EmaError(
                f"force '{names[a]}' is a sum of the others: they explain {shared:.4f} of it (median over the band); "
                "drive them from independent sources, or with more realisations"
            )


def _notable(
    first: DrivenRecord, coherence: NDArray[np.float64], lines: NDArray[np.bool_], settings: FrfSettings
) -> list[CheckResult]:
    """Pairs of forces that are correlated, though not so much that they cannot be told apart."""
    found = []
    for a in range(len(first.forces)):
        for b in range(a):
            shared = float(np.median(coherence[a, b, lines]))
            if shared > _NOTABLE:
                names = f"{first.forces[b].name} and {first.forces[a].name}"
                found.append(
                    CheckResult(
                        check="inputs",
                        value=shared,
                        limit=_NOTABLE,
                        unit="1",
                        passes=False,
                        clause="Bendat and Piersol (2010), section 7.3",
                        consequence="warn",
                        channel=names,
                        message=f"forces {names} are correlated: coherence {shared:.2f}; their FRFs are uncertain",
                    )
                )
    return found
