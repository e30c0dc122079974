"""Many rows to few: poles and participations are the same in any real combination of rows.

Scaled to equal noise, the strongest combinations hold all that many rows know about the poles, at a
fraction of the work. Only the shapes need every row.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.data import FitData
from ema_pipeline.modal.fit import Estimate, synthesis
from ema_pipeline.modal.noise import Noise, NoiseLaw
from ema_pipeline.threads import in_order

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

MAX_ROWS = 20


@dataclass(frozen=True)
class Window:
    """Lines of a sub-band with all their rows; modes of the other sub-bands are taken off where it is used.

    Attributes
    ----------
    data : FitData
        As measured.
    noise : NoiseLaw
    from_hits : bool
        True where the noise is known from the scatter over hits; else it is a first guess.
    far : Estimate
    far_shapes : complex ndarray, (n_rows, n_far_modes)
    """

    data: FitData
    noise: NoiseLaw
    from_hits: bool
    far: Estimate
    far_shapes: Complex

    def rows(self, rows: slice) -> Window:
        """The same for some rows."""
        return replace(
            self, data=self.data.rows(rows), noise=self.noise.rows(rows), far_shapes=self.far_shapes[rows]
        )

    def lines(self, first: int, stop: int) -> Window:
        """The same on lines ``first:stop``."""
        return replace(self, data=self.data.lines(first, stop), noise=self.noise.lines(first, stop))

    def near(self) -> Local:
        """Data without far modes, and noise, as arrays."""
        frf = self.data.frf
        if len(self.far.poles):
            left = frf - synthesis(self.data, self.far, self.far_shapes)
            frf = np.where(self.data.measured[..., None], left, 0.0)
        return Local(replace(self.data, frf=frf), self.noise.at(self.data.frf), self.from_hits)


@dataclass(frozen=True)
class Local:
    """Few rows of a sub-band as the fit takes them.

    Attributes
    ----------
    data : FitData
    noise : Noise
    from_hits : bool
    """

    data: FitData
    noise: Noise
    from_hits: bool

    @property
    def hits(self) -> Noise | None:
        """Noise from the scatter over hits, None where that is not known."""
        return self.noise if self.from_hits else None


def compressible(data: FitData) -> bool:
    """True where rows are many, and all were measured for all references."""
    return bool(len(data.frf) > MAX_ROWS and data.measured.all())


def compress(window: Window) -> Local:
    """The strongest combinations of rows with their noise; all rows where they are few or gappy.

    Parameters
    ----------
    window : Window
    """
    data = window.data
    if not compressible(data):
        return window.near()
    n_rows, n_ref, n_lines = data.frf.shape

    def log_variance(lines: slice) -> Real:
        part = window.lines(lines.start, lines.stop)
        return np.asarray(np.log(part.noise.at(part.data.frf).variance).sum(axis=(1, 2)))

    blocks = data.line_blocks()
    level = np.exp(-0.5 * sum(in_order(log_variance, blocks)) / (n_ref * n_lines))

    def products(lines: slice) -> Real:
        local = window.lines(lines.start, lines.stop).near()
        scaled = (local.data.frf * level[:, None, None]).reshape(n_rows, -1)
        return np.asarray((scaled @ scaled.conj().T).real)

    gram = sum(in_order(products, blocks))
    mixer = np.linalg.eigh(gram)[1][:, ::-1][:, :MAX_ROWS].T * level  # (kept, rows)
    shape = MAX_ROWS, n_ref, n_lines
    frf, noise = np.empty(shape, dtype=np.complex128), Noise(np.empty(shape), np.empty(shape))

    def mix(lines: slice) -> None:
        frf[..., lines], some = _mixed(window.lines(lines.start, lines.stop), mixer)
        noise.common[..., lines], noise.own[..., lines] = some.common, some.own

    for _ in in_order(mix, blocks):
        pass
    small = replace(
        data,
        frf=frf,
        variance=np.broadcast_to(np.nan, shape),
        measured=np.ones((MAX_ROWS, n_ref), dtype=bool),
    )
    return Local(small, noise, window.from_hits)


def _mixed(window: Window, mixer: Real) -> tuple[Complex, Noise]:
    """Combinations of rows on a few lines, and their noise."""
    local, measured = window.near(), window.data.frf
    own = np.einsum("ko,oil->kil", mixer**2, local.noise.own, optimize=True)
    if window.data.transposed:  # rows are inputs, whose force noise is independent
        common = np.einsum("ko,oil->kil", mixer**2, local.noise.common, optimize=True)
    else:
        power = np.sum(np.abs(measured) ** 2, axis=0)
        alpha = local.noise.common.sum(axis=0) / np.where(power > 0, power, 1.0)
        common = alpha * np.abs(np.einsum("ko,oil->kil", mixer, measured, optimize=True)) ** 2
    return np.einsum("ko,oil->kil", mixer, local.data.frf, optimize=True), Noise(common, own)
