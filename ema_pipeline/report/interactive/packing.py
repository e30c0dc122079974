"""Measured FRFs in few bytes for the page's script: logarithm of the magnitude and phase in 16 bits each, packed."""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.frf.overview import cmif, representative_frfs
from ema_pipeline.frf.types import FrfSet

POINTS = 600_000
"""FRF lines that a report holds at most, about 2.7 MB; of more FRFs it holds the most telling ones."""

DECADES = (-12.0, 8.0)
"""Range of log10 of the magnitude; a step of 16 bits is 0.07 %."""
SIGMA_DECADES = (-5.0, 1.0)
"""Range of log10 of the relative standard deviation; a step of 8 bits is 6 %."""
NONE = 255
"""Stands for a coherence or a deviation that is not known."""


def packed_frfs(frfs: FrfSet, high_hz: float, points: int | None = POINTS) -> dict[str, Any]:
    """FRFs with coherence and standard deviation up to a frequency.

    Parameters
    ----------
    frfs : FrfSet
    high_hz : float
    points : int or None
        Lines over all FRFs that are kept at most; None keeps all FRFs.

    Returns
    -------
    dict
        ``pairs`` are (output, input, hits) of the FRFs, one row each in the arrays ``magnitude``, ``phase``,
        ``coherence``, ``sigma`` and ``multiple``, which are base64 of deflated bytes; ``multiple``, the multiple
        coherence, is None but for several forces at once.
    """
    lines = (frfs.frequency_hz > 0) & (frfs.frequency_hz <= high_hz)
    all_pairs = [(int(o), int(i)) for o, i in np.argwhere(frfs.hits > 0)]
    room = len(all_pairs) if points is None else max(points // max(int(lines.sum()), 1), 1)
    kept = all_pairs if len(all_pairs) <= room else sorted(representative_frfs(frfs, room))
    factors = 2j * np.pi * frfs.frequency_hz[lines]
    power = {"acceleration": 0, "velocity": 1, "displacement": 2}
    h = np.stack([frfs.frf[o, i, lines] * factors ** power[frfs.quantities[o]] for o, i in kept])
    relative = np.stack(
        [np.sqrt(frfs.variance[o, i, lines]) / np.abs(frfs.frf[o, i, lines]) for o, i in kept]
    )
    coherence = np.stack([frfs.coherence[o, i, lines] for o, i in kept])
    frequency = frfs.frequency_hz[lines]
    size = np.maximum(np.abs(h), 10.0 ** DECADES[0])
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = _steps(np.log10(relative), SIGMA_DECADES, 254)
    sigma[~(np.isfinite(relative) & (relative > 0))] = NONE
    return {
        "unit": "(m/s²)/N" if frfs.force_calibrated else "(m/s²)/V",
        "start": float(frequency[0]) if frequency.size else 0.0,
        "step": float(frfs.frequency_hz[1] - frfs.frequency_hz[0]) if frfs.frequency_hz.size > 1 else 1.0,
        "lines": int(lines.sum()),
        "total": len(all_pairs),
        "average": frfs.averaged,
        "outputs": [d.point for d in frfs.outputs],
        "inputs": [d.point for d in frfs.inputs],
        "pairs": [[o, i, int(frfs.hits[o, i])] for o, i in kept],
        "magnitude": _packed(_differences(_steps(np.log10(size), DECADES, 65534))),
        "phase": _packed(_differences(_steps(np.angle(h), (-np.pi, np.pi), 65535))),
        "coherence": _packed(_bytes(coherence)),
        "sigma": _packed(sigma.astype(np.uint8)),
        "multiple": _multiple(frfs, kept, lines),
        "decades": DECADES,
        "sigma_decades": SIGMA_DECADES,
        "levels": _levels(frfs, kept, lines),
    }  # fmt: skip


def _multiple(frfs: FrfSet, kept: list[tuple[int, int]], lines: NDArray[np.bool_]) -> str | None:
    """Multiple coherence of the responses of the kept FRFs; None for one force at a time."""
    multiple = frfs.multiple_coherence
    return None if multiple is None else _packed(_bytes(np.stack([multiple[o, lines] for o, _ in kept])))


LEVELS = ("noise", "distortion", "odd", "even")
"""Of a multisine: 1 σ of the FRF by noise and by distortion, and distortion of odd and even order."""


def _levels(frfs: FrfSet, kept: list[tuple[int, int]], lines: NDArray[np.bool_]) -> dict[str, str] | None:
    """Levels of noise and distortion of the kept FRFs as accelerance; None where a test does not tell them apart."""
    noise, distortion, detected = frfs.noise_variance, frfs.distortion_variance, frfs.detected_distortion
    if noise is None or distortion is None or detected is None or not np.isfinite(noise).any():
        return None
    omega = 2 * np.pi * frfs.frequency_hz[lines]
    power = {"acceleration": 0, "velocity": 1, "displacement": 2}
    found: dict[str, list[NDArray[np.float64]]] = {name: [] for name in LEVELS}
    for o, i in kept:
        sizes = (np.sqrt(noise[o, i]), np.sqrt(distortion[o, i]), *detected[o])
        for name, size in zip(LEVELS, sizes, strict=True):
            found[name].append(size[lines] * omega ** power[frfs.quantities[o]])
    return {name: _packed(_differences(_level_steps(np.stack(rows)))) for name, rows in found.items()}


def _level_steps(sizes: NDArray[np.float64]) -> NDArray[np.int64]:
    """Steps as those of the magnitude; 65535 where there is nothing."""
    there = np.isfinite(sizes) & (sizes > 10.0 ** DECADES[0])
    return np.where(there, _steps(np.log10(np.where(there, sizes, 1.0)), DECADES, 65534), 65535)


_LINES_AT_ONCE = 1024
"""Lines of all FRFs that are copied at a time."""


def packed_cmif(frfs: FrfSet, high_hz: float, most: int = 1500) -> dict[str, list[float]]:
    """The first mode indicator over the frequency; of groups of lines the largest."""
    shown = np.flatnonzero((frfs.frequency_hz > 0) & (frfs.frequency_hz <= high_hz))
    begin, stop = (int(shown[0]), int(shown[-1]) + 1) if shown.size else (0, 0)
    blocks = [slice(k, min(k + _LINES_AT_ONCE, stop)) for k in range(begin, stop, _LINES_AT_ONCE)]
    first = np.concatenate([np.zeros(0), *(cmif(frfs.accelerance(lines), 1)[0] for lines in blocks)])
    frequency = frfs.frequency_hz[shown]
    step = -(-frequency.size // most) or 1
    size = frequency.size // step * step
    return {
        "f": frequency[:size].reshape(-1, step)[:, step // 2].tolist(),
        "value": [float(f"{v:.4g}") for v in first[:size].reshape(-1, step).max(axis=1)],
    }


def _steps(values: NDArray[np.float64], limits: tuple[float, float], steps: int) -> NDArray[np.int64]:
    low, high = limits
    share = (np.nan_to_num(values, nan=low, posinf=high, neginf=low) - low) / (high - low)
    return np.rint(np.clip(share, 0, 1) * steps).astype(np.int64)


def _differences(values: NDArray[np.int64]) -> NDArray[np.uint16]:
    """Each row's first value and the differences that follow, modulo 2¹⁶."""
    steps = values.astype(np.uint16)
    steps[:, 1:] -= steps[:, :-1].copy()
    return steps


def _bytes(coherence: NDArray[np.float64]) -> NDArray[np.uint8]:
    scaled = np.rint(np.clip(np.nan_to_num(coherence), 0, 1) * 250)
    return np.where(np.isfinite(coherence), scaled, NONE).astype(np.uint8)


def _packed(values: NDArray[np.uint16] | NDArray[np.uint8]) -> str:
    """Low bytes before high bytes, deflated: the high bytes of neighbouring lines are alike."""
    planes = np.ascontiguousarray(values).view(np.uint8).reshape(-1, values.itemsize).T
    return base64.b64encode(zlib.compress(np.ascontiguousarray(planes).tobytes(), 6)).decode("ascii")
