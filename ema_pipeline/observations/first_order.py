"""What effects that are not there yet would change, to first order: many of them at one point of the model without any.

Every effect alone costs a model of its own, its modes and all their derivatives. At no size they share all of these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.mechanics.terms import MASS, STIFFNESS, Matrices
from ema_pipeline.observations.rig_model import RigModel

_SAME = 1e-9
"""Difference up to which matrices M, C, K and the structural one are those of the model without the effect, over the
largest entry of M, K, and of the root of both for C."""


class FirstOrderModel(RigModel):
    """A model at one point, with the sizes of effects that it does not have as further unknowns.

    Matrices do not depend on these, but have derivatives.

    Parameters
    ----------
    model : RigModel
    added : sequence of RigModel
        The same with one effect more, each.
    configurations : sequence of str
    x : ndarray, (n,)
        Unknowns of `model`.

    Attributes
    ----------
    together : tuple of RigModel
        Those of `added` whose effects do nothing where their unknowns are 0, as others do that begin at a size.
    """

    def __init__(
        self,
        model: RigModel,
        added: Sequence[RigModel],
        configurations: Sequence[str],
        x: NDArray[np.float64],
    ) -> None:
        damping = model.own_damping, model.middle_hz, model.joints
        super().__init__(model.rig, model.effects, None, model.dependence, *damping)
        self._model = model
        self._further: dict[str, list[NDArray[np.float64]]] = {c: [] for c in configurations}
        together = []
        for one in added:
            found = [_slopes(one, model, c, x) for c in configurations]
            known = [by_shape for by_shape in found if by_shape is not None]
            if len(known) == len(found):
                together.append(one)
                for configuration, by_shape in zip(configurations, known, strict=True):
                    self._further[configuration].append(by_shape)
        self.together = tuple(together)
        self.sizes = {name: size for of in (model, *together) for name, size in of.sizes.items()}

    def matrices(self, configuration: str, x: NDArray[np.float64], derivatives: bool = True) -> Matrices:
        """See `RigModel`."""
        found = self._model.matrices(configuration, x[: len(self._model.unknowns)], derivatives)
        if not derivatives:
            return found
        by_shape = np.concatenate([found.by_shape, *self._further[configuration]])
        skew = np.zeros((len(by_shape), *found.skew.shape))
        skew[: len(found.skew_by_shape)] = found.skew_by_shape
        return replace(found, by_shape=by_shape, skew_by_shape=skew)


def _slopes(
    one: RigModel, model: RigModel, configuration: str, x: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Derivatives of the matrices by the sizes that `one` has more than `model`, (k, 4, n, n).

    None where it is another model at unknowns of 0, and for an effect that lets shapes lag behind: with it those of all
    modes are complex.
    """
    sizes = len(one.sizes) - len(model.sizes)
    own = one.matrices(configuration, np.concatenate([x, np.zeros(sizes)]))
    without, solution = model.modes(configuration, x)
    if solution is None or own.dense.shape != without.dense.shape:
        return None
    by_shape, skew = own.by_shape[-sizes:], own.skew_by_shape[-sizes:]
    mass, stiffness = (np.max(np.abs(without.dense[kind])) for kind in (MASS, STIFFNESS))
    damping = np.sqrt(mass * stiffness)
    off = np.max(np.abs(own.dense - without.dense), axis=(1, 2)) / [mass, damping, stiffness, stiffness]
    same = max(np.max(off), np.max(np.abs(own.skew - without.skew)) / damping) < _SAME
    return by_shape if same and not np.any(skew) else None
