"""Independent simulator of hammer tests for the tests and studies of modal identification.

It shares no code with the package but the types: a system is a list of modes; hits are computed as time
records (half-sine blow, anti-alias filter, noise on every channel), and turned into H1 estimates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.records import Record, ResponseChannel

QUANTITIES = "acceleration", "velocity", "displacement"
"""What sensors may measure: each is the one before it integrated."""


@dataclass(frozen=True)
class TrueSystem:
    """Modes with mass-normalised real shapes at the measured DOFs, shape (n_modes, n_dofs)."""

    frequency_hz: NDArray[np.float64]
    damping_ratio: NDArray[np.float64]
    shapes: NDArray[np.float64]

    @property
    def poles(self) -> NDArray[np.complex128]:
        w = 2 * np.pi * self.frequency_hz
        z = self.damping_ratio
        return np.asarray(w * (-z + 1j * np.sqrt(1 - z**2)))

    @property
    def slowest_decay(self) -> float:
        """Least decay rate of a mode, rad/s."""
        return float(np.min(self.damping_ratio * self.frequency_hz * 2 * np.pi))

    def accelerance(self, frequency_hz: NDArray[np.float64], dofs_out: list[int], dofs_in: list[int]):
        """(n_out, n_in, n_lines), as a sum over modes of −ω² φφᵀ/(ω_r² − ω² + 2jζω_rω)."""
        w = 2 * np.pi * np.asarray(frequency_hz)
        wr = 2 * np.pi * self.frequency_hz[:, None]
        q = -(w**2) / (wr**2 - w**2 + 2j * self.damping_ratio[:, None] * wr * w)
        return np.einsum("ro,ri,rf->oif", self.shapes[:, dofs_out], self.shapes[:, dofs_in], q, optimize=True)


@dataclass(frozen=True)
class Hits:
    """Time records: force (n_inputs, n_hits, n), responses (n_inputs, n_hits, n_outputs, n)."""

    force: NDArray[np.float64]
    responses: NDArray[np.float64]
    sample_rate_hz: float
    pretrigger: int
    force_noise: float
    response_noise: NDArray[np.float64]
    quantity: str = "acceleration"


def simulate_hits(
    system: TrueSystem,
    dofs_out: list[int],
    dofs_in: list[int],
    *,
    f_max: float,
    record_s: float,
    n_hits: int,
    force_noise: float,
    response_noise: float,
    rng: np.random.Generator,
    pretrigger: int = 20,
    decay_rad_s: float = 0.0,
    drift: float = 0.0,
    wander: float = 0.0,
    alike: float = 0.0,
    softening: float = 0.0,
    calibration: float = 0.0,
    quantity: str = "acceleration",
) -> Hits:
    """Simulate hits; noise levels are rms of the noise over rms of the channel's signal in the record.

    `drift` is the standard deviation of a factor on all frequencies of a hit, `wander` that of a factor on each,
    `alike` the correlation of both from one hit to the next; `softening` the relative drop of the first half of the
    modes from the softest hit (80 N) to the hardest (160 N), zero in their middle; `calibration` the standard
    deviation of a constant factor on each channel; `quantity` what the sensors measure, one of `QUANTITIES`.

    Response noise is set per channel from its signal averaged over inputs, as a sensor's noise floor is.
    """
    rate = 2.56 * f_max
    n = round(record_s * rate)
    rate = n / record_s
    periods = int(np.ceil(max(2.0, 12.0 / (system.slowest_decay * record_s))))
    n_long = n * periods
    f = np.fft.rfftfreq(n_long, 1 / rate)
    taper = np.clip((0.5 * rate - f) / (0.5 * rate - 1.05 * f_max), 0, 1)
    taper = 0.5 - 0.5 * np.cos(np.pi * taper)
    integrated = (2j * np.pi * np.maximum(f, f[1])) ** -QUANTITIES.index(quantity)
    integrated[0] *= quantity == QUANTITIES[0]  # no static part of what is integrated
    still = system.accelerance(f, dofs_out, dofs_in) if not (drift or wander or softening) else None
    soft = np.arange(len(system.frequency_hz)) < len(system.frequency_hz) // 2
    width = 0.9 / f_max  # half-sine: first zero of the spectrum at 1.67 f_max
    force = np.zeros((len(dofs_in), n_hits, n))
    resp = np.zeros((len(dofs_in), n_hits, len(dofs_out), n))
    common, own = 0.0, np.zeros(len(soft))
    fresh = 1.0  # of the first hit, which follows none
    for i in range(len(dofs_in)):
        for h in range(n_hits):
            peak = rng.uniform(80, 160)
            if still is None:
                common = alike * common + fresh * rng.standard_normal()
                if wander:
                    own = alike * own + fresh * rng.standard_normal(len(own))
                fresh = np.sqrt(1 - alike**2)
                moved = (1 + drift * common + wander * own) * (1 - softening * soft * (peak - 120) / 80)
                here = replace(system, frequency_hz=system.frequency_hz * moved)
                column = here.accelerance(f, dofs_out, [dofs_in[i]])[:, 0]
            else:
                column = still[:, i]
            tau = width * rng.uniform(0.9, 1.1)
            a = np.pi * f * tau
            with np.errstate(divide="ignore", invalid="ignore"):
                spectrum = peak * tau * 2 / np.pi * np.cos(a) / (1 - (2 * a / np.pi) ** 2)
            spectrum = np.where(np.isfinite(spectrum), spectrum, peak * tau / 2)
            start = (pretrigger + rng.uniform(-0.5, 0.5)) / rate - tau / 2
            spectrum = spectrum * np.exp(-1j * (a + 2 * np.pi * f * start)) * taper
            force[i, h] = np.fft.irfft(spectrum, n_long)[:n] * rate
            resp[i, h] = np.fft.irfft(column * integrated * spectrum, n_long)[:, :n] * rate
    if calibration:
        resp = resp * (1 + calibration * rng.standard_normal(len(dofs_out)))[:, None]
    sigma_f = force_noise * np.sqrt(np.mean(force**2))
    sigma_y = response_noise * np.sqrt(np.mean(resp**2, axis=(0, 1, 3)))
    force = force + sigma_f * rng.standard_normal(force.shape)
    resp = resp + sigma_y[:, None] * rng.standard_normal(resp.shape)
    if decay_rad_s:
        window = np.exp(-decay_rad_s * np.arange(n) / rate)
        force, resp = force * window, resp * window
    return Hits(force, resp, rate, pretrigger, float(sigma_f), sigma_y, quantity)


def records_of(hits: Hits, dofs_out: list[int], dofs_in: list[int]) -> list[Record]:
    """The hits as records of one hit each, as ingest hands them on; DOF k is called ``pk.z``."""
    channels = tuple(ResponseChannel(f"a{k}", Dof(f"p{k}", "z"), hits.quantity) for k in dofs_out)
    return [
        Record(
            f"p{k}_{h}.h5",
            Dof(f"p{k}", "z"),
            hits.sample_rate_hz,
            "hammer",
            hits.force[i, h],
            hits.responses[i, h],
            channels,
        )
        for i, k in enumerate(dofs_in)
        for h in range(hits.force.shape[1])
    ]


def write_raw_folder(folder: Path, records: list[Record], window_decay_rad_s: float = 0.0) -> None:
    """Records of one impact and channel layout as HDF5 files, and the test.toml that describes them."""
    import h5py

    folder.mkdir(parents=True, exist_ok=True)
    lines = ["schema = 1", f"sample_rate_hz = {records[0].sample_rate_hz!r}"]
    if window_decay_rad_s:
        lines.append(f"exponential_window_rad_s = {window_decay_rad_s!r}")
    lines += ["[[channels]]", 'name = "hammer"', 'quantity = "force"', 'unit = "N"']
    for channel in records[0].channels:
        lines += ["[[channels]]", f'name = "{channel.name}"', 'quantity = "acceleration"', 'unit = "m/s^2"']
        lines.append(f'dof = "{channel.dof}"')
    for record in records:
        lines += ["[[records]]", f'file = "{record.file}"', f'impact = "{record.impact}"']
        with h5py.File(folder / record.file, "w") as file:
            file["hammer"] = record.force
            for channel, samples in zip(record.channels, record.responses, strict=True):
                file[channel.name] = samples
    (folder / "test.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def h1(hits: Hits, dofs_out: list[int], dofs_in: list[int], f_max: float, decay_rad_s: float = 0.0) -> FrfSet:
    """H1 estimate with its variance from the scatter over hits."""
    n = hits.force.shape[-1]
    spec_f = np.fft.rfft(hits.force)
    spec_y = np.fft.rfft(hits.responses)
    sff = np.sum(np.abs(spec_f) ** 2, axis=1)  # (in, f)
    frf = np.einsum("ihf,ihof->oif", spec_f.conj(), spec_y, optimize=True) / sff
    n_hits = hits.force.shape[1]
    if n_hits > 1:
        residual = spec_y - frf.transpose(1, 0, 2)[:, None] * spec_f[:, :, None]
        variance = np.sum(np.abs(residual) ** 2, axis=1).transpose(1, 0, 2) / ((n_hits - 1) * sff)
        syy = np.sum(np.abs(spec_y) ** 2, axis=1).transpose(1, 0, 2)
        coherence = np.abs(frf) ** 2 * sff / syy
    else:
        variance = np.full(frf.shape, np.nan)
        coherence = np.full(frf.shape, np.nan)
    frequency = np.fft.rfftfreq(n, 1 / hits.sample_rate_hz)
    return frf_set(
        frequency,
        frf,
        dofs_out,
        dofs_in,
        variance=variance,
        coherence=coherence,
        n_hits=n_hits,
        band_hz=(0.0, f_max),
        decay_rad_s=decay_rad_s,
        delay=hits.pretrigger / hits.sample_rate_hz,
    )


def frf_set(
    frequency,
    frf,
    dofs_out,
    dofs_in,
    *,
    variance=None,
    coherence=None,
    n_hits=1,
    band_hz=None,
    decay_rad_s=0.0,
    delay=0.0,
    names=None,
    force_calibrated=True,
    quantity="acceleration",
) -> FrfSet:
    """An FrfSet from arrays; DOF k is called ``pk.z`` unless `names` says otherwise."""
    name = names or {k: f"p{k}" for k in {*dofs_out, *dofs_in}}
    nan = np.full(frf.shape, np.nan)
    return FrfSet(
        frequency_hz=frequency,
        frf=frf,
        coherence=nan if coherence is None else coherence,
        variance=nan if variance is None else variance,
        outputs=tuple(Dof(name[k], "z") for k in dofs_out),
        inputs=tuple(Dof(name[k], "z") for k in dofs_in),
        quantities=(quantity,) * len(dofs_out),
        hits=np.where(np.isnan(frf[:, :, 1]), 0, n_hits).astype(np.int64),
        estimator="H1",
        record_s=1.0 / (frequency[1] - frequency[0]),
        response_decay_rad_s=decay_rad_s,
        delay_s=np.full(len(dofs_in), delay),
        band_hz=band_hz or (0.0, float(frequency[-1])),
        force_calibrated=force_calibrated,
        sensor_mass_kg=np.zeros(len(dofs_out)),
    )


def random_system(
    rng: np.random.Generator,
    *,
    n_modes: int,
    n_dofs: int,
    low_hz: float,
    high_hz: float,
    min_spacing: float = 0.01,
    damping: tuple[float, float] = (0.001, 0.03),
) -> TrueSystem:
    """Random modes in a band, at least `min_spacing` apart (relative), log-uniform damping, normal shapes."""
    while True:
        f = np.sort(low_hz * (high_hz / low_hz) ** rng.uniform(0, 1, n_modes))
        if n_modes == 1 or np.min(np.diff(f) / f[:-1]) >= min_spacing:
            break
    zeta = np.exp(rng.uniform(np.log(damping[0]), np.log(damping[1]), n_modes))
    shapes = rng.standard_normal((n_modes, n_dofs))
    return TrueSystem(f, zeta, shapes)
