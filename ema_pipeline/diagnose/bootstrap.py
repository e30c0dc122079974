"""False-alarm thresholds for this very test: its fitted null is simulated, measured and diagnosed many times.

The shipped thresholds hold for rigs and tests like those that they were simulated with. Here the base model as it was
fitted is taken for the truth; every sample draws new nominal values from the tolerances, new modes from the measured
modes' own uncertainties, and goes through the same fits. The largest gain of each family of hypotheses in each sample
makes the table (A. C. Davison, D. V. Hinkley, *Bootstrap Methods and their Application*, 1997, section 4.2).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.correlate.residuals import observable_modes
from ema_pipeline.diagnose.climbing import first_ranking
from ema_pipeline.diagnose.fitting import Case, Fitted, fit_null, holds
from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.diagnose.ladder import noise_of
from ema_pipeline.diagnose.noise import floors
from ema_pipeline.diagnose.progress import Progress, part
from ema_pipeline.diagnose.screening import screen
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.thresholds import from_null_gains
from ema_pipeline.effects.library import Library
from ema_pipeline.fit.evidence import Dataset
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.rigs.base import ParametricRig
from ema_pipeline.rigs.types import Rig
from ema_pipeline.threads import single_blas_thread

_REACH = 3.0
"""Nominal values are drawn within so many tolerances."""


def own_thresholds(
    rig: Rig,
    measured: Mapping[str, MeasuredModes],
    settings: DiagnoseSettings,
    library: Library | None,
    memory: Path,
    version: str,
    tell: Progress,
) -> dict[str, float]:
    """Thresholds of every family from `settings.bootstrap` simulated tests with nothing missing.

    Parameters
    ----------
    rig, measured, settings, library
        As for `diagnose.diagnose`.
    memory : Path
        File that keeps the gains of every sample, one JSON object a line; samples that it holds for the same
        data, rig, settings and version are not simulated again.
    version : str
        Of the program and of the user's own effects.
    tell : callable

    Returns
    -------
    dict of family to gain
    """
    key = _fingerprint(rig, measured, settings, version)
    gains = _remembered(memory, key)[: settings.bootstrap]
    if len(gains) < settings.bootstrap:
        null = fitted_null(rig, measured, settings, library)
        lines = [{"key": key}, *gains]  # written anew: a crash may have cut off the last line
        memory.write_text("".join(json.dumps(entry) + "\n" for entry in lines), encoding="utf-8")
        for found in null_gains(null, len(gains), settings.bootstrap, tell):
            gains.append(found)
            with memory.open("a", encoding="utf-8") as file:
                file.write(json.dumps(found) + "\n")
    return from_null_gains(gains)


def _fingerprint(
    rig: Rig, measured: Mapping[str, MeasuredModes], settings: DiagnoseSettings, version: str
) -> str:
    digest = hashlib.sha256(version.encode())
    digest.update(settings.model_dump_json(exclude={"bootstrap", "processes"}).encode())
    digest.update(repr(sorted(rig.parameters.items())).encode())
    for name, m in sorted(measured.items()):
        digest.update(f"{name} {m.dofs} {m.band_hz} {m.references}".encode())
        for array in (
            m.frequency_hz,
            m.frequency_std_hz,
            m.damping_ratio,
            m.damping_std,
            m.shapes,
            m.shape_std,
        ):
            digest.update(b"-" if array is None else np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _remembered(memory: Path, key: str) -> list[dict[str, float]]:
    """Gains that an earlier run kept; a line that was cut off by a crash ends the list."""
    if not memory.is_file():
        return []
    found: list[dict[str, float]] = []
    for number, line in enumerate(memory.read_text(encoding="utf-8").splitlines()):
        try:
            entry = json.loads(line)
        except json.JSONDecodeError:
            break
        if number == 0:
            if entry.get("key") != key:
                return []
            continue
        found.append({str(k): float(v) for k, v in entry.items()})
    return found


@dataclass(frozen=True)
class FittedNull:
    """The base model as the data have it, and how exactly they do.

    Attributes
    ----------
    case : Case
    base : Fitted
    fit : FitSettings
        At the noise level that the base model leaves.
    """

    case: Case
    base: Fitted
    fit: FitSettings


def fitted_null(
    rig: Rig,
    measured: Mapping[str, MeasuredModes],
    settings: DiagnoseSettings,
    library: Library | None = None,
) -> FittedNull:
    """Fit the base model to what was measured."""
    case = Case(rig, screen(rig, measured).measured, settings, library)
    with single_blas_thread():
        base = fit_null(case, Hypothesis(), settings.fit, None)
        level = noise_of(case, base) if holds(base) else floors(settings.fit)
    return FittedNull(case, base, level.applied(settings.fit))


def null_gains(null: FittedNull, first: int, count: int, tell: Progress) -> Iterator[dict[str, float]]:
    """Largest gain of each family in simulated tests with nothing missing.

    Parameters
    ----------
    null : FittedNull
    first, count : int
        Numbers of the samples, first … count - 1; each has its own random numbers, so that a run that was
        interrupted goes on where it stopped.
    tell : callable

    Yields
    ------
    dict of family to gain
        One per sample.
    """
    for k in range(first, count):
        told = part(tell, k / count, (k + 1) / count)
        told(0.0, f"simulated null {k + 1} of {count}")
        rig, measured = simulate_null(null, np.random.default_rng([20240229, k]))
        case = replace(null.case, rig=rig, measured=measured)
        with single_blas_thread():
            ranking, _ = first_ranking(case, lambda share, text: None)
        best: dict[str, float] = {}
        for f in ranking.fitted:
            family = f.hypothesis.family
            best[family] = max(best.get(family, 0.0), ranking.gain(f))
        yield best
        told(1.0, f"simulated null {k + 1} of {count}")


def simulate_null(null: FittedNull, rng: np.random.Generator) -> tuple[Rig, dict[str, MeasuredModes]]:
    """A rig with new nominal values, and new modes, both scattered about the fitted null."""
    problem = null.case.problem(Hypothesis(), null.fit)
    values = null.base.values
    x = problem.space.point(values)
    measured = {
        e.measured.configuration: _simulated(null.case.measured[e.measured.configuration], e, x, pairs, rng)
        for e, pairs in zip(problem.evidence, problem.assignments(x), strict=True)
    }
    return _redrawn(problem.rig, values, rng), measured


def _redrawn(rig: Rig, values: Mapping[str, float], rng: np.random.Generator) -> Rig:
    assert isinstance(rig, ParametricRig)
    changed = dict(rig.parameters)
    for name, p in rig.parameters.items():
        z = float(np.clip(rng.normal(), -_REACH, _REACH))
        if p.free or p.tolerance <= 0 or name not in values:
            continue
        # the tolerance stays what it is in the parameter's unit
        nominal = values[name] + z * p.tolerance * p.value
        if nominal > 0:
            changed[name] = replace(p, value=nominal, tolerance=p.tolerance * p.value / nominal)
    return replace(rig, parameters=changed)


def _simulated(
    given: MeasuredModes,
    e: Dataset,
    x: NDArray[np.float64],
    pairs: NDArray[np.int64],
    rng: np.random.Generator,
) -> MeasuredModes:
    """The model's modes in place of those paired with them; a mode without partner stays as it was."""
    modes = observable_modes(e.family.at(x[None]))
    exact = e.measured  # with floors
    has = pairs >= 0
    k = pairs[has]
    f, zeta = given.frequency_hz.copy(), given.damping_ratio.copy()
    f[has] = modes.omega[0, k] / (2 * np.pi) + exact.frequency_std_hz[has] * rng.normal(size=k.size)
    known = has & np.isfinite(zeta)
    drawn = modes.damping_ratio[0, pairs[known]] + exact.damping_std[known] * rng.normal(
        size=int(known.sum())
    )
    zeta[known] = np.maximum(drawn, 1e-5)
    shapes = None
    if given.shapes is not None and exact.shape_std is not None:
        shapes = given.shapes.copy()
        model = (e.rows @ modes.shapes[0][:, k]).T
        old = np.nan_to_num(given.shapes[has])
        # as large as the measured shape, and turned as it is
        scale = np.sum(old * model.conj(), axis=1) / np.maximum(np.sum(np.abs(model) ** 2, axis=1), 1e-300)
        new = model * scale[:, None]
        # the shape's length follows that of the model's, not the projection's
        size = np.linalg.norm(old, axis=1) / np.maximum(np.linalg.norm(new, axis=1), 1e-300)
        sigma = np.nan_to_num(exact.shape_std[has])
        scatter = sigma * rng.normal(size=new.shape)
        if np.any(np.nan_to_num(given.shapes).imag):
            scatter = scatter + 1j * sigma * rng.normal(size=new.shape)
        shapes[has] = np.where(np.isfinite(given.shapes[has]), new * size[:, None] + scatter, np.nan)
    order = np.argsort(f, kind="stable")
    return replace(
        given,
        frequency_hz=f[order],
        frequency_std_hz=given.frequency_std_hz[order],
        damping_ratio=zeta[order],
        damping_std=given.damping_std[order],
        shapes=None if shapes is None else shapes[order],
        shape_std=None if given.shape_std is None else given.shape_std[order],
    )
