"""Roots of the denominators of all orders that can be poles of modes: stable, and not too heavily damped.

Companion eigenvalues give all roots of one polynomial at a time, at n³ each, and most of them are unstable.
Here the annulus of the stable ones is searched for all orders at once: values on a few circles (fast Fourier
transforms) tell by the argument principle which cells between the circles hold a root, and Newton's method
polishes the roots of all orders together. Whether none is missing is counted likewise: after division by the
roots found, the polynomial must wind equally often around both rims of the annulus. An order that fails this
count is left to its companion matrix.

References
----------
Henrici, P., "Applied and Computational Complex Analysis", vol. 1, Wiley, 1974 (argument principle).
"""

from __future__ import annotations

import numpy as np
import scipy.fft
from numpy.typing import NDArray

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

OUTER_RADIUS = 1.6
"""Poles beyond have decayed to 1/1.6 after one sample of the mapped band: no mode looks like that."""

OVERSAMPLING = 4
"""Points on a circle per coefficient."""

ITERATIONS = 12
TOLERANCE = 1e-11
"""Newton steps below this end the search; the root is then exact to its square."""

SAME = 1e-8
RIM = 0.5
"""Roots this far inside the unit circle, in grid steps, are found too: they would spoil the count."""

LARGEST_STEP = 0.1
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
    large = [k for k, c in enumerate(coefficients) if len(c) > FEW]
    found: dict[int, Complex] = {}
    if large:
        width = max(len(coefficients[k]) for k in large)
        table = np.zeros((len(large), width))
        for row, k in enumerate(large):
            table[row, : len(coefficients[k])] = coefficients[k] / np.max(np.abs(coefficients[k]))
        found = {large[row]: z for row, z in _search(table).items()}
    out = []
    for k, c in enumerate(coefficients):
        z = found[k] if k in found else np.roots(c[::-1]).astype(np.complex128)
        out.append(z[(z.imag < -1e-12) & (np.abs(z) > 1) & (np.abs(z) < OUTER_RADIUS)])
    return out


def _circles(width: int) -> Real:
    """Radii: dense near the unit circle, where the resolution of the order needs it."""
    logs, step = [0.0], 0.8 / width
    while logs[-1] < np.log(OUTER_RADIUS):
        logs.append(logs[-1] + step)
        step *= 1.5
    logs[-1] = np.log(OUTER_RADIUS)
    return np.exp(np.array(logs))


def _search(table: Real) -> dict[int, Complex]:
    """All roots in the annulus (lower half and real axis) for the rows that pass the count."""
    n_rows, width = table.shape
    n = scipy.fft.next_fast_len(OVERSAMPLING * width, real=True)
    power = np.arange(width)
    inner = 1 - RIM * 2 * np.pi / n
    radii = np.concatenate([[inner], _circles(width)])
    angle = 2 * np.pi * np.arange(n // 2 + 1) / n  # z = ρ exp(−jθ), as the real transform has it
    rows, starts = [], []
    below = scipy.fft.rfft(table * inner**power, n, axis=1)
    turn_below = _along(below)
    inside = turn_below.sum(axis=1)
    for k in range(1, len(radii)):
        above = scipy.fft.rfft(table * radii[k] ** power, n, axis=1)
        turn_above = _along(above)
        across = np.angle(above * below.conj())
        # a polynomial winds around the cells that hold its roots
        around = turn_below + across[:, 1:] - turn_above - across[:, :-1]
        row, column = np.nonzero(np.abs(around) > np.pi)
        middle = np.sqrt(radii[k] * radii[k - 1])
        rows.append(row)
        starts.append(middle * np.exp(-1j * (angle[column] + np.pi / n)))
        for edge, sign in ((0, 1.0), (-1, -1.0)):
            real = np.flatnonzero(below[:, edge].real * above[:, edge].real < 0)
            rows.append(real)
            starts.append(np.full(len(real), sign * middle + 0j))
        below, turn_below = above, turn_above
    expected = (inside - turn_below.sum(axis=1)) / np.pi
    row = np.concatenate(rows)
    z = _newton(table, row, np.concatenate(starts))
    sound = np.isfinite(z) & (np.abs(z) > 1 - RIM * 2 * np.pi / n) & (np.abs(z) < OUTER_RADIUS)
    out: dict[int, Complex] = {}
    for r in range(n_rows):
        mine = z[(row == r) & sound]
        mine = np.where(np.abs(mine.imag) < 1e-10, mine.real + 0j, mine.real - 1j * np.abs(mine.imag))
        out[r] = _distinct(mine)
    missing = [r for r, found in out.items() if abs(_count(found) - expected[r]) > 0.5]
    for r in missing:  # miscounted where a root lies on a rim, or really not found
        if not _complete(table[r], out[r], n):
            del out[r]
    return out


def _along(values: Complex) -> Real:
    """Change of phase from point to point of a circle."""
    return np.asarray(np.angle(values[:, 1:] * values[:, :-1].conj()))


def _count(roots: Complex) -> int:
    """Number of roots, conjugates included."""
    return 2 * len(roots) - int(np.count_nonzero(roots.imag == 0))


def _newton(table: Real, row: NDArray[np.int64], z: Complex) -> Complex:
    """Newton's method on all starts together, each on its own polynomial."""
    z = z.copy()
    done = np.zeros(len(z), dtype=bool)
    active = np.arange(len(z))
    degree = np.arange(table.shape[1])
    for _ in range(ITERATIONS):
        at = z[active]
        terms = _powers(at, len(degree))
        terms *= table[row[active]]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            step = at * terms.sum(axis=1) / (terms @ degree)
        size = np.abs(step)
        step = np.where(size > LARGEST_STEP, LARGEST_STEP * step / np.maximum(size, 1e-300), step)
        z[active] = at - step
        done[active] = size < TOLERANCE
        radius = np.abs(z[active])
        active = active[(size >= TOLERANCE) & (radius > 0.9) & (radius < 1.2 * OUTER_RADIUS)]
        if not len(active):
            break
    return np.where(done, z, np.nan)


def _powers(z: Complex, count: int) -> Complex:
    """z⁰ … z^(count − 1) by doubling, (n, count)."""
    out = np.ones((len(z), count), dtype=np.complex128)
    done, factor = 1, z.copy()
    while done < count:
        more = min(done, count - done)
        np.multiply(out[:, :more], factor[:, None], out=out[:, done : done + more])
        factor = factor * factor
        done *= 2
    return out


def _distinct(z: Complex) -> Complex:
    """Each root once."""
    if len(z) < 2:
        return z
    close = np.abs(z[:, None] - z[None]) < SAME
    return z[np.argmax(close, axis=1) == np.arange(len(z))]


def _complete(polynomial: Real, roots: Complex, n: int) -> bool:
    """True where no root is left in the annulus once those found are divided out."""
    angle = 2 * np.pi * np.arange(n // 2 + 1) / n
    winding = []
    for radius in (1.0, OUTER_RADIUS):
        value = scipy.fft.rfft(polynomial * radius ** np.arange(len(polynomial)), n)
        z = radius * np.exp(-1j * angle)
        for root in roots:
            value = value / ((z - root) if root.imag == 0 else (z - root) * (z - root.conjugate()))
            value /= np.maximum(np.abs(value), 1e-300)
        winding.append(_along(value[None]).sum())
    return bool(abs(winding[1] - winding[0]) < 0.5 * np.pi)
