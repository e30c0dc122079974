"""Close modes compared as a group: the space that they span, and the matrix of the model in it.

Where two modes come close, a part that is off by little turns their shapes into each other, and where they change
places nothing is linear: no descent leads through that point. The matrix of the model between them, in the basis of
the measured shapes, is smooth all the way. Its diagonal is compared with the measured frequencies, and what stands
beside the diagonal is the rotation of the shapes to first order.

References
----------
T. Kato, Perturbation theory for linear operators, 2nd ed., Springer 1976, II.2: what the modes of a group span, and
the matrix there, are analytic where single shapes are not.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.observations.close_modes_kernel import Seen, add_slopes, seen

Real = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Slopes:
    """Derivatives of modes of the model by all unknowns.

    Attributes
    ----------
    log_frequency : ndarray, (m, n)
    shapes : ndarray, (m, s, n)
        Of what the sensors read of every mode, none turned into another one.
    turned : ndarray, (m, s, n)
        Of what close modes hold of each other beside it: 0 of single ones.
    """

    log_frequency: Real
    shapes: Real
    turned: Real


@dataclass(frozen=True)
class Mixed:
    """What measured shapes are less because unknowns say that they hold it of others.

    Attributes
    ----------
    at : ndarray of int, (q, 2)
        Mode and unknown.
    along : ndarray, (q, s)
        Shape that is taken off per unit of the unknown.
    """

    at: Integers
    along: Real


@dataclass(frozen=True)
class Groups:
    """Groups of c of the model's modes each, seen in the basis of the measured shapes.

    Attributes
    ----------
    read : ndarray, (g, s, c)
        What the sensors read of the model's modes, mass-normalised.
    measured, weight : ndarray, (g, c, s)
        Measured shapes, and one over the variance of each entry; 0 where not measured.
    frequency_hz, measured_hz : ndarray, (g, c)
    uncertain : ndarray, (g, c)
        1 σ of ln f, measured and model.
    """

    read: Real
    measured: Real
    weight: Real
    frequency_hz: Real
    measured_hz: Real
    uncertain: Real

    def only(self, keep: NDArray[np.bool_]) -> Groups:
        """Some of them, by a mask (g,)."""
        return Groups(*(getattr(self, f.name)[keep] for f in fields(self)))

    @cached_property
    def _arrays(self) -> tuple[Real, ...]:
        return tuple(np.ascontiguousarray(getattr(self, f.name)) for f in fields(self))

    @cached_property
    def _seen(self) -> Seen:
        return Seen(*seen(*self._arrays))

    @property
    def told_apart(self) -> NDArray[np.bool_]:
        """True where the sensors tell the modes of a group apart, the model's and the measured ones, (g,)."""
        return self._seen.told_apart

    @property
    def log_frequency(self) -> Real:
        """ln of frequencies in Hz, of the diagonal, (g, c)."""
        return self._seen.log_frequency

    @property
    def shapes(self) -> Real:
        """What the sensors read of the combination nearest to every measured shape, (g, c, s)."""
        return self._seen.shapes

    @property
    def turned(self) -> Real:
        """What a rotation adds to it, (g, c, s)."""
        return self._seen.turned

    def turn_slopes(
        self, slopes: Slopes, members: Integers, reduced: Real, between: Integers, mixed: Mixed
    ) -> None:
        """Turn derivatives of single modes into those of the groups that they are members of.

        Parameters
        ----------
        slopes : Slopes
            Of all modes; those of members are overwritten.
        members : ndarray of int, (g, c)
            Their places among these.
        reduced, between : ndarray, (q, n_model) and (m, m)
            See `ModeDerivatives`.
        mixed : Mixed
        """
        add_slopes(  # type: ignore[call-arg]
            self._seen, *self._arrays[:3], members, reduced, between, mixed.at, mixed.along,
            slopes.log_frequency, slopes.shapes, slopes.turned,
        )  # fmt: skip
