"""Results of the FRF stage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.check_result import CheckResult
from ema_pipeline.dof import Dof
from ema_pipeline.frf.channels import ChannelQuality

ALL_LINES = slice(None)


def unknown(shape: tuple[int, ...]) -> NDArray[np.float64]:
    """NaN of any shape, that takes no memory."""
    return np.broadcast_to(np.nan, shape)


@dataclass(frozen=True)
class FrfSet:
    """Frequency response functions of one configuration.

    Where an output was not measured for an input, the entry is NaN at all lines.

    Attributes
    ----------
    frequency_hz : ndarray, (n_lines,)
        From 0 to the Nyquist frequency, equally spaced.
    frf : complex ndarray, (n_outputs, n_inputs, n_lines)
        Response over force, SI, in the quantity of `quantities`; signs of the DOFs applied, so that
        `outputs` and `inputs` all have sign +1. Line 0 (0 Hz) is finite but carries no information.
    coherence : ndarray, (n_outputs, n_inputs, n_lines)
        NaN where fewer than two hits were averaged: one hit has no coherence.
    variance : ndarray, (n_outputs, n_inputs, n_lines)
        Variance of the complex FRF, E|H - E H|², from the scatter over hits; NaN where fewer than two
        hits were averaged.
    outputs, inputs : tuple of Dof
    quantities : tuple of str
        Per output: ``"acceleration"``, ``"velocity"`` or ``"displacement"``.
    hits : ndarray of int, (n_outputs, n_inputs)
        Number of hits averaged, see `averaged`; 0 where not measured.
    estimator : str
        ``"H1"``, ``"H2"`` or ``"Hv"``.
    record_s : float
        Length of the analysed record, s.
    response_decay_rad_s : float
        Decay rate σ of the exponential windows on force and responses, that of the records and that of the
        settings together; it has been added to the decay of every pole and must be taken off again. 0 without
        such a window.
    delay_s : ndarray, (n_inputs,)
        Mean time of the force peak after the start of the analysed record.
    band_hz : tuple of float
        Band in which the force carried enough energy, (low, high).
    force_calibrated : bool
        False where the force is in volts: the FRF is then unscaled.
    sensor_mass_kg : ndarray, (n_outputs,)
    channels : tuple of ChannelQuality
        What is known of the sensor of each output; empty where nothing is. `frf.channels.channel_uncertainty`
        answers in either case.
    hammer : ChannelQuality or None
        The same of the force channel; of several forces at once the worst.
    excitation : str
        Of a continuous test; empty for a hammer's.
    multiple_coherence : ndarray, (n_outputs, n_lines), or None
        Of several forces at once; `coherence` is then the partial one, each force without what the others explain.
    input_coherence : ndarray, (n_inputs, n_inputs, n_lines), or None
        Ordinary coherence between the forces.
    noise_variance, distortion_variance : ndarray, (n_outputs, n_inputs, n_lines), or None
        Of a multisine: variance of the FRF by noise, from its scatter over periods, and by nonlinear distortion,
        what its scatter over realisations has beyond that (E|H - E H|² of one realisation).
    detected_distortion : ndarray, (n_outputs, 2, n_lines), or None
        Response at lines that carry no force, over the typical force of a line that does, SI: distortion of odd and
        of even order; NaN elsewhere.
    variance_lines : ndarray of int, (n_outputs, n_inputs), or None
        Neighbouring lines over which the noise power of `variance` was averaged; None where each stands for itself.
    rings_on : bool
        True where responses have not decayed at the end of the records.
    verdicts : tuple of CheckResult
        Checks that need several hits or several points: signs of hits, coherence, driving point, reciprocity.
    """

    frequency_hz: NDArray[np.float64]
    frf: NDArray[np.complex128]
    coherence: NDArray[np.float64]
    variance: NDArray[np.float64]
    outputs: tuple[Dof, ...]
    inputs: tuple[Dof, ...]
    quantities: tuple[str, ...]
    hits: NDArray[np.int64]
    estimator: str
    record_s: float
    response_decay_rad_s: float
    delay_s: NDArray[np.float64]
    band_hz: tuple[float, float]
    force_calibrated: bool
    sensor_mass_kg: NDArray[np.float64]
    verdicts: tuple[CheckResult, ...] = ()
    channels: tuple[ChannelQuality, ...] = ()
    hammer: ChannelQuality | None = None
    excitation: str = ""
    multiple_coherence: NDArray[np.float64] | None = None
    input_coherence: NDArray[np.float64] | None = None
    noise_variance: NDArray[np.float64] | None = None
    distortion_variance: NDArray[np.float64] | None = None
    detected_distortion: NDArray[np.float64] | None = None
    variance_lines: NDArray[np.int64] | None = None
    rings_on: bool = False

    @property
    def rest_s(self) -> float:
        """Time from the mean hit to the end of the record, s."""
        return max(self.record_s - float(np.nanmean(self.delay_s)), 0.5 * self.record_s)

    @property
    def averaged(self) -> str:
        """What `hits` counts: hits of a hammer, blocks of a continuous record, or periods of a multisine."""
        if not self.excitation:
            return "hit"
        return "block" if self.noise_variance is None else "period"

    def accelerance(self, lines: slice = ALL_LINES) -> NDArray[np.complex128]:
        """All FRFs as acceleration over force, (m/s²)/N, shape (n_outputs, n_inputs, n_lines)."""
        power = {"acceleration": 0, "velocity": 1, "displacement": 2}
        jw = 2j * np.pi * self.frequency_hz[lines]
        factors = np.stack([jw ** power[q] for q in self.quantities])
        return np.asarray(self.frf[..., lines] * factors[:, None, :])
