"""The compiled loops of comparing measured modes with the model's.

A hundred modes at a dozen sensors are too few numbers for array operations to pay, and their derivatives by a hundred
unknowns too many to be gone through once for every operation.
"""

from __future__ import annotations

import numba
import numpy as np

_LEAST = 1e-300


@numba.njit(cache=True)
def scaled_rows(  # type: ignore[no-untyped-def]
    places, seen, measured, weight, read, turned, read_slope, turned_slope, mixed, along, difference, slope
):
    """Differences of some shapes from those that are read, times the factor that fits each best, row by row.

    Parameters
    ----------
    places : ndarray of int, (k,)
        Modes that are compared, of m.
    seen : ndarray of bool, (m, s)
        Where shapes were measured.
    measured, weight, read, turned : ndarray, (m, s)
        Measured shapes and one over their variances; what is read, and what is added to that beside the factor.
    read_slope, turned_slope : ndarray, (m, s, n)
        Derivatives of the last two by all unknowns; without modes where none are wanted.
    mixed : ndarray of int, (q, 2)
    along : ndarray, (q, s)
        See `close_modes.Mixed`.
    difference : ndarray, (n_rows,)
    slope : ndarray, (n_rows, n)
        Both made: a row for every place and sensor where the shape was measured.
    """
    sensors, n = seen.shape[1], slope.shape[1]
    derivatives = len(read_slope) > 0
    change = np.zeros(n)
    row = 0
    for k in places:
        square, product = 0.0, 0.0
        for s in range(sensors):
            square += weight[k, s] * read[k, s] * read[k, s]
            product += weight[k, s] * read[k, s] * measured[k, s]
        square = max(square, _LEAST)
        factor = product / square
        if derivatives:
            for j in range(n):
                change[j] = 0.0
            for s in range(sensors):
                towards = weight[k, s] * (measured[k, s] - 2 * factor * read[k, s]) / square
                if towards != 0.0:
                    for j in range(n):
                        change[j] += towards * read_slope[k, s, j]
            for q in range(len(mixed)):
                if mixed[q, 0] == k:
                    for s in range(sensors):
                        change[mixed[q, 1]] -= weight[k, s] * read[k, s] * along[q, s] / square
        for s in range(sensors):
            if not seen[k, s]:
                continue
            whole = read[k, s] + turned[k, s]
            difference[row] = measured[k, s] - factor * whole
            if derivatives:
                for j in range(n):
                    slope[row, j] = factor * (read_slope[k, s, j] + turned_slope[k, s, j]) + whole * change[j]
                for q in range(len(mixed)):
                    if mixed[q, 0] == k:
                        slope[row, mixed[q, 1]] += along[q, s]
            row += 1


@numba.njit(cache=True)
def turning_rows(places, seen, measured, weight, read, slopes, difference, slope):  # type: ignore[no-untyped-def]
    """The same of complex shapes up to a complex factor: all real parts, then all imaginary ones.

    Parameters
    ----------
    places, seen
        As above.
    measured, read : complex ndarray, (m, s)
    weight : ndarray, (m, s)
    slopes : complex ndarray, (k, s, n)
        Derivatives of what is read of these modes; of none where they are not wanted.
    difference, slope
        As above, two rows for every place and sensor.
    """
    sensors, n, half = seen.shape[1], slope.shape[1], len(difference) // 2
    derivatives = len(slopes) > 0
    change_re, change_im = np.zeros(n), np.zeros(n)
    row = 0
    for i in range(len(places)):
        k = places[i]
        square, product = 0.0, 0.0j
        for s in range(sensors):
            p = read[k, s]
            square += weight[k, s] * (p.real * p.real + p.imag * p.imag)
            product += weight[k, s] * p.conjugate() * measured[k, s]
        square = max(square, _LEAST)
        factor = product / square
        if derivatives:
            for j in range(n):
                change_re[j], change_im[j] = 0.0, 0.0
            for s in range(sensors):
                w, y, p = weight[k, s] / square, measured[k, s], read[k, s]
                for j in range(n):
                    d = slopes[i, s, j]
                    grown = 2 * (p.real * d.real + p.imag * d.imag)
                    change_re[j] += w * (y.real * d.real + y.imag * d.imag - factor.real * grown)
                    change_im[j] += w * (y.imag * d.real - y.real * d.imag - factor.imag * grown)
        for s in range(sensors):
            if not seen[k, s]:
                continue
            p = read[k, s]
            left = measured[k, s] - factor * p
            difference[row], difference[half + row] = left.real, left.imag
            if derivatives:
                for j in range(n):
                    d, re, im = slopes[i, s, j], change_re[j], change_im[j]
                    slope[row, j] = factor.real * d.real - factor.imag * d.imag + p.real * re - p.imag * im
                    slope[half + row, j] = (
                        factor.real * d.imag + factor.imag * d.real + p.real * im + p.imag * re
                    )
            row += 1


@numba.njit(cache=True)
def whiten(  # type: ignore[no-untyped-def]
    difference, own, unit, least, blur, slope, noise, scatter, heat, values, jacobian, of_noise, of_scatter
):
    """Differences and derivatives over their σ; Σ ln(σ/σ₀), without what blurs.

    Parameters
    ----------
    difference, own, unit : ndarray, (k,)
    least, blur : ndarray, (k,)
        Empty where there is none.
    slope : ndarray, (k, n)
        Without rows where no derivatives are wanted.
    noise, scatter : tuple of float
        Factors on `own` and `unit` as they are tried and stated.
    heat : float
        Factor on all σ.
    values : ndarray, (k,)
    jacobian : ndarray, (k, n)
    of_noise, of_scatter : ndarray, (k,)
        Made: shares of each σ²; the last three without rows where no derivatives are wanted.
    """
    total = 0.0
    for i in range(len(difference)):
        tested, added = (noise[0] * own[i]) ** 2, (scatter[0] * unit[i]) ** 2
        always = least[i] * least[i] if len(least) else 0.0
        variance = tested + added + always
        total += 0.5 * np.log(variance / ((noise[1] * own[i]) ** 2 + (scatter[1] * unit[i]) ** 2 + always))
        if len(blur):
            variance += blur[i] * blur[i]
        known = 1.0 / (np.sqrt(variance) * heat)
        values[i] = difference[i] * known
        if len(slope):
            of_noise[i], of_scatter[i] = tested / variance, added / variance
            for j in range(slope.shape[1]):
                jacobian[i, j] = -slope[i, j] * known
    return total


@numba.njit(cache=True)
def turn_slopes(read, slopes, result):  # type: ignore[no-untyped-def]
    """See `sensing.turned_slopes`: complex (k, s) and (k, s, n) into real ones, (k, s, n)."""
    modes, sensors, n = slopes.shape
    angle = np.zeros(n)
    for k in range(modes):
        square = 0.0j
        for s in range(sensors):
            square += read[k, s] * read[k, s]
        if square == 0.0:  # no sensor reads the mode: nothing turns
            square = 1.0 + 0.0j
        half = -0.5 * np.arctan2(square.imag, square.real)
        back = complex(np.cos(half), np.sin(half))
        for j in range(n):
            angle[j] = 0.0
        for s in range(sensors):
            share = read[k, s] / square
            for j in range(n):
                d = slopes[k, s, j]
                angle[j] += share.real * d.imag + share.imag * d.real
        for s in range(sensors):
            across = (back * read[k, s]).imag
            for j in range(n):
                d = slopes[k, s, j]
                result[k, s, j] = back.real * d.real - back.imag * d.imag + across * angle[j]


@numba.njit(cache=True)
def nearest_seen(frequency_hz, width, to, asked, strength, least):  # type: ignore[no-untyped-def]
    """Nearest mode within a half-width of each of some that is none of them, and that is seen at all; -1 for none.

    Parameters
    ----------
    frequency_hz, width, strength : ndarray, (n,)
        Of all modes; half-widths in Hz, and sums of squares of what sensors read.
    to : ndarray of int, (k,)
    asked : ndarray of bool, (k,)
        False where the answer is none.
    least : float
        Share of the strength of the one that the other has at least.
    """
    found = np.full(len(to), -1)
    paired = np.zeros(len(frequency_hz), np.bool_)
    paired[to] = True
    for k in range(len(to)):
        if not asked[k]:
            continue
        own, nearest = to[k], width[to[k]]
        for i in range(len(frequency_hz)):
            distance = abs(frequency_hz[i] - frequency_hz[own])
            if distance < nearest and not paired[i] and strength[i] >= least * strength[own]:
                found[k], nearest = i, distance
    return found


@numba.njit(cache=True)
def number_blocks(mode, first, block):  # type: ignore[no-untyped-def]
    """Number values, (k,), by the mode that they belong to, modes in their order from `first` on; how many there are.

    `block`, (k,), is made.
    """
    place = np.full(mode.max() + 1, -1)
    for m in mode:
        place[m] = 0
    count = 0
    for m in range(len(place)):
        if place[m] == 0:
            place[m] = first + count
            count += 1
    for i in range(len(mode)):
        block[i] = place[mode[i]]
    return count


@numba.njit(cache=True)
def likeness(known, squares, seen, read):  # type: ignore[no-untyped-def]
    """Modal assurance criterion of every measured shape and every one that is read, (m, n), from measured entries.

    Parameters
    ----------
    known : ndarray, (m, s)
    squares : ndarray, (m,)
        Sums of their squares.
    seen : ndarray, (m, s)
        1 where they were measured, 0 elsewhere.
    read : ndarray, (s, n)
    """
    m, sensors = known.shape
    n = read.shape[1]
    result = np.zeros((m, n))
    for r in range(m):
        for k in range(n):
            product, square = 0.0, 0.0
            for s in range(sensors):
                product += known[r, s] * read[s, k]
                square += seen[r, s] * read[s, k] * read[s, k]
            result[r, k] = product * product / max(squares[r] * square, _LEAST)
    return result
