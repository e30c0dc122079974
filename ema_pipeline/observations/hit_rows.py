"""What of single hits is compared: rows at unit σ, without what all hits of a sheet share.

Neither the rows nor their σ depend on the model, so that both are the same from step to step of a fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from ema_pipeline.observations.hit_data import HitData

Real = NDArray[np.float64]
Integers = NDArray[np.int64]

HIT_FREQUENCY = "hit_frequency_scatter"
HIT_DAMPING = "hit_damping_scatter"
HIT_QUADRATURE = "hit_quadrature_scatter"
HIT_AIM = "hit_aim_scatter"
_KINDS = HIT_FREQUENCY, HIT_DAMPING, HIT_QUADRATURE
_REMEMBERED = 8
"""Scatters at which the standard deviations are kept."""


@dataclass(frozen=True)
class Whitening:
    """Standard deviations of all rows at given scatters.

    Attributes
    ----------
    sigma : ndarray, (3n,)
    share : dict of str to ndarray, (3n,)
        Of each scatter in the variances.
    log_scale : float
        See `Residuals`.
    group : ndarray of int, (3n,)
        Rows of one number share a mean that has no prior.
    sums : sparse array, (n_groups, 3n)
        Makes weighted sums over the rows of every group.
    norm : ndarray, (n_groups,)
        Sums of the squared weights.
    """

    sigma: Real
    share: Mapping[str, Real]
    log_scale: float
    group: Integers
    sums: scipy.sparse.csr_array
    norm: Real

    def whitened(self, rows: Real) -> Real:
        """Rows, (3n,) or (3n, k), at unit σ less their weighted mean in every group."""
        weight = 1 / self.sigma
        flat = rows.reshape(len(rows), -1) * weight[:, None]
        total = np.asarray(self.sums.dot(flat)) / self.norm[:, None]
        return np.asarray((flat - weight[:, None] * total[self.group]).reshape(rows.shape))


class HitRows:
    """Rows of one configuration's hits: all frequencies, then damping ratios, then sizes in quadrature.

    Of a size only the imaginary part counts, over the mean of the sheet: a hit that is aimed otherwise than the others
    changes the real one. Its arc tangent counts: how far a weak mode is driven beyond what it was at first no
    calculation tells well.

    Parameters
    ----------
    data : HitData
    defaults : dict of str to float
        Scatters as they are stated, to which the price of wider ones refers.
    cut_off : bool
        True where friction damps: modes with many times the usual damping are known less well.

    Attributes
    ----------
    hit, mode : ndarray of int, (n,)
        What is compared, whether the model has the mode or not: to leave it out must not pay.
    measured : ndarray, (3, n)
        ln f, ln ζ and the arc tangent of the size in quadrature.
    """

    def __init__(self, data: HitData, defaults: Mapping[str, float], cut_off: bool = False) -> None:
        self._defaults, used = dict(defaults), data.used
        self.hit, self.mode = np.nonzero(used)
        at = (slice(None), self.hit, self.mode)
        usual, turned = np.where(used, data.damping, 1.0), data.relative_size.imag
        self.measured = np.stack([data.log_frequency, np.log(usual), np.arctan(turned)])[at]
        bent = 1 / (1 + turned**2)
        own = np.stack([data.log_frequency_std, data.damping_std / usual, data.quadrature_std * bent])
        in_decay_rates = np.stack([data.usual_damping, *np.ones((2, len(data.modes)))])[:, None]
        left = np.hypot(data.linearised_std, data.cut_off_std) if cut_off else data.linearised_std
        own = np.hypot(own, left * in_decay_rates) * data.irregularity
        self._noise = own[at].ravel() ** 2
        # not bent by the arc tangent: where aim alone excites a mode, its phase is anything
        self._otherwise = (data.otherwise * in_decay_rates)[at].ravel()
        self._kind = np.repeat(np.arange(len(_KINDS)), len(self.hit))
        of_sheet = data.sheet[self.hit] * (int(self.mode.max(initial=0)) + 1) + self.mode
        of_kind = np.arange(len(_KINDS))[:, None] * (of_sheet.max(initial=0) + 1)
        self._group = np.unique(of_kind + of_sheet, return_inverse=True)[1].ravel()
        self._known: dict[tuple[float, ...], Whitening] = {}

    @property
    def groups(self) -> int:
        """Number of means that are taken off."""
        return int(self._group.max(initial=-1)) + 1

    def whitening(self, scatters: Mapping[str, float], heat: float) -> Whitening:
        """At scatters as they are tried, with a factor on all uncertainties."""
        key = (*(scatters[name] for name in (*_KINDS, HIT_AIM)), heat)
        if key not in self._known:
            if len(self._known) >= _REMEMBERED:
                self._known.clear()
            self._known[key] = self._whitening(scatters, heat)
        return self._known[key]

    def _whitening(self, scatters: Mapping[str, float], heat: float) -> Whitening:
        now, group = self._added(scatters), self._group
        variance = self._noise + sum(now.values())
        default = self._noise + sum(self._added(self._defaults).values())
        sigma = np.sqrt(variance) * heat
        counted = np.log(np.bincount(group, 1 / variance) / np.bincount(group, 1 / default))
        return Whitening(
            sigma=sigma,
            share={k: v / variance for k, v in now.items()},
            log_scale=0.5 * float(np.sum(np.log(variance / default))) + 0.5 * float(np.sum(counted)),
            group=group,
            sums=scipy.sparse.csr_array(
                (1 / sigma, (group, np.arange(len(sigma)))), shape=(self.groups, len(sigma))
            ),
            norm=np.asarray(np.bincount(group, sigma**-2.0), float),
        )

    def _added(self, sizes: Mapping[str, float]) -> dict[str, Real]:
        """Variances that every scatter adds, (3n,)."""
        own = {k: np.where(self._kind == i, sizes[k], 0.0) ** 2 for i, k in enumerate(_KINDS)}
        return {**own, HIT_AIM: (sizes[HIT_AIM] * self._otherwise) ** 2}
