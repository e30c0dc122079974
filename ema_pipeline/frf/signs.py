"""Signs of single hits: a hit whose response or hammer was reversed cancels the others in the average."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.check_result import CheckResult, judged
from ema_pipeline.dof import Dof
from ema_pipeline.frf.checks import NODE_LEVEL, OBLIQUE_LEVEL

SIGN = "sign"

OPPOSITE = -0.7
"""Correlation of two hits from which on they are opposite. Noise makes them independent, and a resonance that has moved
turns the phase at its old place by a quarter of a period at most: neither makes a correlation below 0."""

STRONG_FORCE = 0.01
"""Lines with less of the largest force autospectrum tell no level: noise is large there."""

ACROSS_LEVEL = 0.8
"""FRFs across the blow above this share of the largest one along it have the structure's sign. A mode across that is
damped a third as much as those along a blow that is 8° off answers with 0.4, at either sign."""

_BLOCKS = 64
_FIRST_LINE = 4
"""Fewer periods in a record are drift."""


@dataclass
class HitLines:
    """Spectra of one pair of points in every single hit, at a few lines: the strongest of each block in the first hit.

    Attributes
    ----------
    lines : ndarray of int, (n_blocks,)
    hits : list of str
        File and number of each hit.
    cross : list of complex ndarray, (n_blocks,)
        Cross spectra of response and force, signs of the DOFs applied.
    force : list of ndarray, (n_blocks,)
        Force autospectra over their largest line.
    scale : list of float
        Those largest lines.
    """

    lines: NDArray[np.intp]
    hits: list[str] = field(default_factory=list)
    cross: list[NDArray[np.complex128]] = field(default_factory=list)
    force: list[NDArray[np.float64]] = field(default_factory=list)
    scale: list[float] = field(default_factory=list)

    def add(self, hit: str, cross: NDArray[np.complex128], power: NDArray[np.float64]) -> None:
        """Keep what one hit shows at these lines, of its spectra (n_lines,)."""
        self.hits.append(hit)
        self.scale.append(float(power.max()))
        self.cross.append(cross[self.lines])
        self.force.append(power[self.lines] / self.scale[-1])

    def inside(self, band: tuple[int, int]) -> NDArray[np.bool_]:
        """Mask of the lines in a band, (n_blocks,)."""
        return np.asarray((self.lines >= band[0]) & (self.lines <= band[1]))

    def frfs(self, band: tuple[int, int]) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
        """FRF of every hit, (n_hits, n_lines), and force over its largest, at the lines in a band."""
        inside = self.inside(band)
        force = np.array(self.force)[:, inside]
        cross = np.array(self.cross)[:, inside] / np.array(self.scale)[:, None]
        return np.divide(cross, force, out=np.zeros_like(cross), where=force > 0), force


def strongest_lines(cross: NDArray[np.complex128]) -> NDArray[np.intp]:
    """The line of largest size in each of some equal blocks of a spectrum (n_lines,)."""
    width = max((cross.size - _FIRST_LINE) // _BLOCKS, 1)
    count = max((cross.size - _FIRST_LINE) // width, 0)
    inside = cross[_FIRST_LINE : _FIRST_LINE + count * width].reshape(count, width)
    return np.asarray(
        np.argmax(inside.real**2 + inside.imag**2, axis=1) + _FIRST_LINE + width * np.arange(count)
    )


def check_signs(
    pairs: Mapping[tuple[str, str], HitLines],
    outputs: Mapping[str, Dof],
    quantities: Mapping[str, str],
    band: tuple[int, int],
) -> list[CheckResult]:
    """Compare the signs of single hits, pair by pair.

    Parameters
    ----------
    pairs : mapping
        From the points (output, input).
    outputs : mapping
        Outputs as messages name them, from their points.
    quantities : mapping
        What each output measures.
    band : tuple of int
        First and last line that count.

    Returns
    -------
    list of CheckResult
        One for each pair with two hits that is neither weak at its sensor nor beside its blow, which would have
        either sign; its value is the lowest correlation of a hit with the others.
    """
    # in an order of their own: threads found them in any
    kept = {pair: pairs[pair].frfs(band) for pair in sorted(pairs)}
    # Mean square over the hits, not of their average, which hits of opposite sign cancel.
    level = {pair: _largest(frfs, force) for pair, (frfs, force) in kept.items()}
    verdicts = []
    for (output, source), (frfs, force) in kept.items():
        if len(frfs) < 2:
            continue
        mine = level[output, source]
        at_sensor = max(x for (o, _), x in level.items() if o == output)
        of_blow = max(x for (o, i), x in level.items() if i == source and quantities[o] == quantities[output])
        # what an oblique blow makes along the sensor goes with what a blow along the sensor would make
        across = outputs[output].direction != Dof.parse(source).direction
        oblique = ACROSS_LEVEL * max(of_blow, at_sensor) if across else OBLIQUE_LEVEL * of_blow
        if mine <= max(NODE_LEVEL * at_sensor, oblique) or mine == 0:
            continue
        verdicts.append(_signs(f"{outputs[output]} over {source}", pairs[output, source].hits, frfs, force))
    return verdicts


def _largest(frfs: NDArray[np.complex128], force: NDArray[np.float64]) -> float:
    power = np.mean(np.where(force > STRONG_FORCE, np.abs(frfs) ** 2, 0.0), axis=0)
    return float(np.sqrt(power.max(initial=0.0)))


def _signs(
    name: str, hits: Sequence[str], frfs: NDArray[np.complex128], force: NDArray[np.float64]
) -> CheckResult:
    """The odd ones out: those against the sign that most hits have."""
    # Weighted by the force, the noise of all lines is alike.
    answers = frfs * np.sqrt(np.mean(force, axis=0))
    size = np.linalg.norm(answers, axis=1)
    reference = answers[int(np.argmax(size))]
    scale = size * np.linalg.norm(reference)
    likeness = np.real(answers @ reference.conj()) / np.where(scale > 0, scale, np.inf)
    odd = np.flatnonzero(likeness <= OPPOSITE)
    if 2 * odd.size > len(hits):  # most are against the strongest: then that one is odd
        odd = np.flatnonzero(likeness >= -OPPOSITE)
    others = [k for k in range(len(hits)) if k not in odd]
    fault = (
        f"hits of {name} have opposite signs ({_named(hits, odd)} and {_named(hits, others)}): look up direction and "
        "cable of sensor and hammer; put '-' before dof or impact of one, or leave it out"
    )
    value = float(likeness.min())
    return judged(SIGN, value, OPPOSITE, value > OPPOSITE, "", "warn", fault, channel=name)


def _named(hits: Sequence[str], some: Sequence[int] | NDArray[np.intp]) -> str:
    shown = ", ".join(hits[k] for k in some[:3])
    return shown if len(some) <= 3 else f"{shown} and {len(some) - 3} more"
