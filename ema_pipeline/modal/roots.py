"""Roots of the denominators of all orders that can be poles of modes: stable, and not too heavily damped.

Companion eigenvalues give all roots of one polynomial at a time, at n³ each, and most of them are unstable.
Here the annulus of the stable ones is searched for all orders at once: values on a few circles (fast Fourier
transforms) tell by the argument principle which cells between the circles hold a root, and short Taylor series
polish the roots of all orders together. Whether none is missing is counted likewise: after division by the
roots found, the polynomial must wind equally often around both rims of the annulus. An order that fails this
count is left to its companion matrix.

References
----------
Henrici, P., "Applied and Computational Complex Analysis", vol. 1, Wiley, 1974 (argument principle).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import scipy.fft
from numpy.typing import NDArray

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]
Integer = NDArray[np.int64]

OUTER_RADIUS = 1.6
"""Poles beyond have decayed to 1/1.6 after one sample of the mapped band: no mode looks like that."""

OVERSAMPLING = 4
"""Points on a circle per coefficient."""

GROWTH = 2.0
"""From one distance of circles to the next."""

ITERATIONS = 12
TERMS = 6
"""Of the Taylor series about a point."""

EXACT = 1e-3
"""Steps below this, as a share of the radius where the series is short enough, leave nothing to improve."""

SAME = 1e-8
RIM = 0.5
"""Roots this far inside the unit circle, in grid steps, are found too: they would spoil the count."""

AT_ONCE = 128
"""Roots polished together: their powers should stay in the cache."""

FEW = 24
"""Below this order companion eigenvalues are as fast."""


def stable_roots(coefficients: list[Real]) -> list[Complex]:
    """Roots with 1 < |z| < 1.6 and −π < arg z < 0 of real polynomials.

    Parameters
    ----------
    coefficients : list of ndarray
        Ascending powers, the highest coefficient not 0.

    Returns
    -------
    list of complex ndarray
        One per polynomial, in no order.
    """
    found: dict[int, Complex] = {}
    large = [k for k, c in enumerate(coefficients) if len(c) > FEW]
    if large:
        table = np.zeros((len(large), max(len(coefficients[k]) for k in large)))
        for row, k in enumerate(large):
            table[row, : len(coefficients[k])] = coefficients[k]
        found = {large[row]: z for row, z in _search(table).items()}
    left = [k for k in range(len(coefficients)) if k not in found]
    found.update(zip(left, _eigenvalues([coefficients[k] for k in left]), strict=True))
    return [_wanted(found[k]) for k in range(len(coefficients))]


def _wanted(z: Complex) -> Complex:
    radius = np.abs(z)
    return z[(z.imag < -1e-12) & (radius > 1) & (radius < OUTER_RADIUS)]


def _eigenvalues(polynomials: list[Real]) -> list[Complex]:
    """All roots as eigenvalues of companion matrices; further roots at 0 where the orders differ."""
    if not polynomials:
        return []
    size = max(len(c) for c in polynomials) - 1
    companion = np.zeros((len(polynomials), size, size))
    for matrix, c in zip(companion, polynomials, strict=True):
        n = len(c) - 1
        matrix[0, :n] = -c[-2::-1] / c[-1]
        matrix[range(1, n), range(n - 1)] = 1.0
    return list(np.linalg.eigvals(companion).astype(np.complex128))


def _radii(width: int, rim: float) -> Real:
    """Of the circles: dense near the unit circle, where the resolution of the order needs it."""
    logs, step = [0.0], 0.8 / width
    while logs[-1] < np.log(OUTER_RADIUS):
        logs.append(logs[-1] + step)
        step *= GROWTH
    return np.array([1 - rim, *np.exp(logs[:-1]), OUTER_RADIUS])


def _search(table: Real) -> dict[int, Complex]:
    """The roots of the lower half in the annulus, for the rows that pass the count."""
    n_rows, width = table.shape
    n = scipy.fft.next_fast_len(OVERSAMPLING * width, real=True)
    rim = RIM * 2 * np.pi / n
    radii = _radii(width, rim)
    rows: list[Integer] = []
    starts: list[Complex] = []
    real = np.zeros((len(radii) - 1, n_rows), dtype=np.int64)
    expected = np.zeros(n_rows)
    for k, (inner, outer) in enumerate(pairwise(_Circle.of(table, radius, n) for radius in radii)):
        row, column = _cells(inner, outer)
        rows.append(row)
        starts.append(np.sqrt(radii[k] * radii[k + 1]) * np.exp(-2j * np.pi * column / n))
        real[k] = np.count_nonzero(inner.negative_ends != outer.negative_ends, axis=1)
        expected += inner.half_turns - outer.half_turns
    row, z = _all_polished(table, np.concatenate(rows), np.concatenate(starts))
    radius = np.abs(z)
    row, z = _distinct(row, z, (radius > 1 - rim) & (radius < OUTER_RADIUS))
    count = np.bincount(row, minlength=n_rows)
    out = dict(enumerate(np.split(z, np.cumsum(count)[:-1])))
    for r in np.flatnonzero(2 * count + real.sum(axis=0) != expected).tolist():
        # miscounted where a root lies on a rim, or really not found
        if not _complete(table[r], out[r], int(real[1:, r].sum()), n):
            del out[r]
    return out


@dataclass(frozen=True)
class _Circle:
    """Polynomials (rows) at the points z = ρ exp(−jθ), 0 ≤ θ ≤ π.

    Attributes
    ----------
    parts : ndarray, (2, n_rows, n_points)
        Real and imaginary parts.
    along : ndarray of int, (n_rows, n_points − 1)
        Crossings of the negative real axis from point to point.
    """

    parts: Real
    along: NDArray[np.int8]

    @classmethod
    def of(cls, table: Real, radius: float, n: int) -> _Circle:
        values = scipy.fft.rfft(table * radius ** np.arange(table.shape[1]), n, axis=1)
        parts = np.stack([values.real, values.imag])
        return cls(parts, _crossings(parts[..., :-1], parts[..., 1:]))

    @cached_property
    def negative_ends(self) -> NDArray[np.bool_]:
        """Where the polynomials are negative on the real axis, (n_rows, 2)."""
        return np.asarray(self.parts[0][:, [0, -1]] < 0)

    @cached_property
    def half_turns(self) -> Real:
        """Change of phase over the half circle, in units of π."""
        ends = self.negative_ends
        return np.asarray(2.0 * self.along.sum(axis=1) + ends[:, 1] - 1.0 * ends[:, 0])


def _cells(inner: _Circle, outer: _Circle) -> tuple[Integer, Real]:
    """Where roots lie between two circles: row, and place along the circle in points.

    A polynomial winds around the cells between the points that hold its roots, once for each.
    """
    across = _crossings(inner.parts, outer.parts)
    around = np.abs(inner.along - outer.along + across[:, 1:] - across[:, :-1])
    row, column = np.nonzero(around)
    several = around[row, column] > 1
    place = np.concatenate([column + np.where(several, 0.25, 0.5), column[several] + 0.75])
    return np.concatenate([row, row[several]]), place


def _crossings(a: Real, b: Real) -> NDArray[np.int8]:
    """How often lines from a to b (real and imaginary parts) cross the negative real axis, anticlockwise > 0."""
    above, still_above = a[1] >= 0, b[1] >= 0
    anticlockwise = a[0] * b[1] > a[1] * b[0]
    positive = above & ~still_above & anticlockwise
    negative = still_above & ~above & ~anticlockwise
    return positive.view(np.int8) - negative.view(np.int8)


def _all_polished(table: Real, row: Integer, z: Complex) -> tuple[Integer, Complex]:
    """The roots beside starts of any rows, by row."""
    order = np.argsort(row, kind="stable")
    row, z = row[order], z[order]
    for start in range(0, len(z), AT_ONCE):
        part = slice(start, start + AT_ONCE)
        mine = table[row[start] : row[part][-1] + 1]
        width = int(np.flatnonzero(mine.any(axis=0))[-1]) + 1
        z[part] = _polished(mine[:, :width], row[part] - row[start], z[part])
    return row, z


def _polished(table: Real, row: Integer, z: Complex) -> Complex:
    """Roots of polynomials beside starts, each of its own row; NaN where there is none near by.

    Every round takes the Taylor series of the polynomial in log z at all points, and goes to its root.
    """
    out = np.full(len(z), np.nan, dtype=np.complex128)
    at = np.arange(len(z))
    width = table.shape[1]
    degree = np.arange(width) - 0.5 * width  # z^(−width/2) p has the same roots and a shorter series
    series = np.cumprod([np.ones(width), *(degree / m for m in range(1, TERMS))], axis=0)
    coefficients = np.ascontiguousarray(table[row].T)
    for _ in range(ITERATIONS):
        terms = _powers(z, width).view(np.float64).reshape(width, len(z), 2)
        terms *= coefficients[..., None]
        taylor = (series @ terms.reshape(width, -1)).view(np.complex128)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            step = _nearest_root(taylor)
            size = 0.5 * width * np.abs(step)
            z = z * np.exp(step * np.minimum(1.0, 1.0 / size))
        done = size < EXACT
        out[at[done]] = z[done]
        radius = np.abs(z)
        active = ~done & (radius > 0.9) & (radius < 1.2 * OUTER_RADIUS)
        if not active.any():
            break
        at, z, coefficients = at[active], z[active], coefficients[:, active]
    return out


def _nearest_root(taylor: Complex) -> Complex:
    """Root of polynomials, ascending coefficients (TERMS, n), near 0: a step of Halley's method, two of Newton's."""
    x = -taylor[0] * taylor[1] / (taylor[1] ** 2 - taylor[0] * taylor[2])
    for _ in range(2):
        value, slope = taylor[-1], np.zeros_like(x)
        for c in taylor[-2::-1]:
            slope = slope * x + value
            value = value * x + c
        x = x - value / slope
    return x


def _powers(z: Complex, count: int) -> Complex:
    """z⁰ … z^(count − 1) by doubling, (count, n)."""
    out = np.ones((count, len(z)), dtype=np.complex128)
    done, factor = 1, z
    while done < count:
        more = min(done, count - done)
        np.multiply(out[:more], factor, out=out[done : done + more])
        factor = factor * factor
        done *= 2
    return out


def _distinct(row: Integer, z: Complex, sound: NDArray[np.bool_]) -> tuple[Integer, Complex]:
    """The sound roots off the real axis, turned to the lower half, each once, by row."""
    sound = sound & (np.abs(z.imag) > 1e-10)
    row, z = row[sound], z.real[sound] - 1j * np.abs(z.imag[sound])
    order = np.lexsort((z.real, z.imag, row))
    row, z = row[order], z[order]
    fresh = np.ones(len(z), dtype=bool)
    fresh[1:] = (np.diff(row) != 0) | (np.abs(np.diff(z)) > SAME)
    return row[fresh], z[fresh]


def _complete(polynomial: Real, roots: Complex, n_real: int, n: int) -> bool:
    """True where only real roots are left in the annulus once those found are divided out."""
    circle = np.exp(-2j * np.pi * np.arange(n // 2 + 1) / n)
    winding = []
    for radius in (1.0, OUTER_RADIUS):
        value = scipy.fft.rfft(polynomial * radius ** np.arange(len(polynomial)), n)
        found = (radius * circle - roots[:, None]) * (radius * circle - roots[:, None].conj())
        rest = value / np.abs(value).max() / np.prod(found / np.abs(found), axis=0)
        winding.append(np.angle(rest[1:] * rest[:-1].conj()).sum())
    return bool(abs(winding[0] - winding[1] - n_real * np.pi) < 0.5 * np.pi)
