"""The coordinates in which parameters are fitted: multiples of the tolerance, or logarithms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.rigs.types import Parameter

Kind = Literal["prior", "log", "linear"]

# A free parameter whose bounds lie further apart than this ratio is fitted by its logarithm.
_LOG_RATIO = 5.0


@dataclass(frozen=True)
class Coordinate:
    """One fitted parameter.

    Attributes
    ----------
    parameter : Parameter
    kind : {"prior", "log", "linear"}
        ``prior``: x = (value - nominal)/(tolerance · nominal), standard normal. ``log``: x = ln value, free.
        ``linear``: x = value/scale, free.
    scale : float
        Value per unit of x (``prior``, ``linear``); 1 for ``log``.
    low, high : float
        Bounds of x.
    """

    parameter: Parameter
    kind: Kind
    scale: float
    low: float
    high: float

    def value(self, x: float) -> float:
        """Parameter value at coordinate x."""
        if self.kind == "log":
            return float(np.exp(x))
        origin = self.parameter.value if self.kind == "prior" else 0.0
        return origin + self.scale * x

    def coordinate(self, value: float) -> float:
        """Coordinate at a parameter value, inside the bounds."""
        if self.kind == "log":
            x = float(np.log(max(value, np.exp(self.low))))
        else:
            x = (value - (self.parameter.value if self.kind == "prior" else 0.0)) / self.scale
        return float(np.clip(x, self.low, self.high))

    def slope(self, x: float) -> float:
        """d value / d x."""
        return float(np.exp(x)) if self.kind == "log" else self.scale


@dataclass(frozen=True)
class Space:
    """All fitted parameters; the others stay at their nominal values."""

    coordinates: tuple[Coordinate, ...]

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(c.parameter.name for c in self.coordinates)

    @cached_property
    def low(self) -> NDArray[np.float64]:
        return np.array([c.low for c in self.coordinates])

    @cached_property
    def high(self) -> NDArray[np.float64]:
        return np.array([c.high for c in self.coordinates])

    @cached_property
    def has_prior(self) -> NDArray[np.bool_]:
        return np.array([c.kind == "prior" for c in self.coordinates], dtype=bool)

    @cached_property
    def _logarithmic(self) -> NDArray[np.int64]:
        return np.array([i for i, c in enumerate(self.coordinates) if c.kind == "log"], dtype=np.int64)

    @cached_property
    def _scale(self) -> NDArray[np.float64]:
        return np.array([c.scale for c in self.coordinates])

    @cached_property
    def _origin(self) -> NDArray[np.float64]:
        return np.array([c.parameter.value if c.kind == "prior" else 0.0 for c in self.coordinates])

    def values(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Parameter values at points x, (..., n)."""
        out = self._origin + self._scale * x
        out[..., self._logarithmic] = np.exp(x[..., self._logarithmic])
        return np.asarray(out)

    def slopes(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """d value / d x at a point, (n,)."""
        out = self._scale.copy()
        out[self._logarithmic] = np.exp(x[self._logarithmic])
        return np.asarray(out)

    def point(self, values: Mapping[str, float] | None = None) -> NDArray[np.float64]:
        """Coordinates at named values; nominal where left out."""
        given = values or {}
        return np.array(
            [c.coordinate(given.get(c.parameter.name, c.parameter.value)) for c in self.coordinates]
        )

    def named(self, x: NDArray[np.float64]) -> dict[str, float]:
        """Named values at a point."""
        return {n: float(v) for n, v in zip(self.names, self.values(x), strict=True)}

    def retract(self, x: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take a Gauss-Newton step and stay inside the bounds.

        The step of a logarithm is taken as a relative step of the value itself: the dynamic residual is
        linear in a stiffness, so that this lands at once where steps of the logarithm would creep.
        """
        out = x + step
        log = self._logarithmic
        out[log] = x[log] + np.log(np.clip(1 + step[log], 0.02, 50.0))
        return np.clip(out, self.low, self.high)

    def starts(self, per_decade: int, most: int = 64) -> NDArray[np.float64]:
        """Grid of starting points over the logarithms, the others at their values, (n_starts, n)."""
        axes = [_axis(c, per_decade) for c in self.coordinates]
        while np.prod([float(len(a)) for a in axes]) > most and per_decade > 1:
            per_decade -= 1
            axes = [_axis(c, per_decade) for c in self.coordinates]
        while np.prod([float(len(a)) for a in axes]) > most:
            longest = int(np.argmax([len(a) for a in axes]))
            axes[longest] = axes[longest][::2]
        grid = np.array(list(product(*axes)), dtype=float).reshape(-1, len(axes))
        return np.vstack([self.point()[None, :], grid])


def make_space(parameters: Sequence[Parameter]) -> Space:
    """Coordinates for all parameters that are free or have a tolerance.

    Raises
    ------
    EmaError
        If a free parameter has neither a value nor bounds to set its scale.
    """
    return Space(tuple(c for p in parameters if (c := _coordinate(p)) is not None))


def _coordinate(p: Parameter) -> Coordinate | None:
    if not p.free:
        sigma = abs(p.tolerance * p.value)
        if sigma == 0:
            return None
        # Half of one percent of the nominal value keeps masses and stiffnesses off zero.
        low = max((p.minimum - p.value) / sigma, (0.005 - 1) / p.tolerance if p.value > 0 else -np.inf)
        return Coordinate(p, "prior", sigma, low, (p.maximum - p.value) / sigma)
    if p.minimum > 0 and np.isfinite(p.maximum) and p.maximum / p.minimum > _LOG_RATIO:
        return Coordinate(p, "log", 1.0, float(np.log(p.minimum)), float(np.log(p.maximum)))
    if p.value > 0 and p.minimum == 0 and p.maximum == np.inf:
        # Free without bounds: three decades to either side of the start.
        return Coordinate(p, "log", 1.0, float(np.log(p.value * 1e-3)), float(np.log(p.value * 1e3)))
    # The value is a size that would be clearly visible; bounds may lie decades further out.
    finite = [abs(p.value)] if p.value else [abs(v) for v in (p.minimum, p.maximum) if np.isfinite(v) and v]
    if not finite:
        raise EmaError(f"free parameter '{p.name}' has neither a value nor bounds: give it 'min' and 'max'")
    scale = max(finite)
    return Coordinate(p, "linear", scale, p.minimum / scale, p.maximum / scale)


def _axis(c: Coordinate, per_decade: int) -> NDArray[np.float64]:
    start = c.coordinate(c.parameter.value)
    if c.kind == "log":
        count = max(2, round((c.high - c.low) / np.log(10) * per_decade))
        edges = np.linspace(c.low, c.high, count + 1)
        return np.asarray(0.5 * (edges[1:] + edges[:-1]))
    return np.array([start])
