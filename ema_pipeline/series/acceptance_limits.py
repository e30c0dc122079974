"""Limits that tests are held against: written by hand, or learned from a good lot as tolerance intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
import scipy.stats
import tomlkit
from pydantic import Field, model_validator

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.files import replace_file
from ema_pipeline.series.features import DAMPING, FREQUENCY, PARAMETER, Features
from ema_pipeline.settings import FirstLayout, Settings, parse
from ema_pipeline.significance import tolerance_factor
from ema_pipeline.toml_text import read_toml

LEAST_LOT = 5
"""Tests of a good lot: from fewer the factors are so large that limits say nothing."""
_UNUSUAL = 0.01
"""p-value of the Shapiro-Wilk test below which a lot is said not to be normal."""


class Range(Settings):
    """Least and largest value that pass."""

    min: float | None = Field(None, description="least value that passes")
    max: float | None = Field(None, description="largest value that passes")

    @model_validator(mode="after")
    def _ordered(self) -> Range:
        if self.min is None and self.max is None:
            raise ValueError("give min, max or both")
        if self.min is not None and self.max is not None and self.min > self.max:
            raise ValueError(f"min {self.min:g} is above max {self.max:g}")
        return self


class Shape(Settings):
    """A mode's shape, by which it is recognised."""

    dofs: tuple[str, ...] = Field(description="where, e.g. 'm1.x'")
    re: tuple[float, ...] = Field(description="real parts")
    im: tuple[float, ...] = Field((), description="imaginary parts; 0 where left out")

    @model_validator(mode="after")
    def _complete(self) -> Shape:
        if len(self.re) != len(self.dofs) or len(self.im) not in (0, len(self.dofs)):
            raise ValueError("re, and im where given, have one number for each of dofs")
        for name in self.dofs:
            try:
                Dof.parse(name)
            except EmaError as error:
                raise ValueError(str(error)) from None
        return self


class ModeLimits(Settings):
    """Limits of one mode; it is recognised by its frequency, and by its shape where one is given."""

    configuration: str = Field("default", description="configuration that it was measured in")
    frequency_hz: float = Field(gt=0, description="about where it is, Hz")
    shape: Shape | None = Field(None, description="its shape")
    frequency: Range | None = Field(None, description="Hz")
    damping: Range | None = Field(None, description="damping ratio")
    mac: Range | None = Field(None, description="MAC with `shape`")


class ParameterLimits(Range):
    """Limits of a fitted parameter of the rig."""

    name: str = Field(description="the parameter")


class Limits(Settings):
    """The content of ``limits.toml``."""

    version: FirstLayout = Field(1, alias="schema", description="version of this file's layout")
    learnt_from: str = Field("", description="what they were learned from; empty where written by hand")
    lot: int = Field(0, ge=0, description="tests that they were learned from")
    content: float = Field(0.0, ge=0, lt=1, description="share of good tests within all limits together")
    confidence: float = Field(0.0, ge=0, lt=1, description="confidence of that")
    effects: Literal["fail", "ignore"] = Field(
        "fail", description="verdict on a test with a claimed physical effect"
    )
    modes: tuple[ModeLimits, ...] = Field((), description="limits of modes")
    parameters: tuple[ParameterLimits, ...] = Field((), description="limits of parameters")


def read_limits(path: Path) -> Limits:
    """Limits from a file.

    Raises
    ------
    EmaError
        If there is none, it cannot be read, or something in it is wrong.
    """
    if not path.exists():
        raise EmaError(f"{path}: there are no limits yet; 'ema series limits' learns them from good tests")
    limits = parse(Limits, read_toml(path), path)
    if not limits.modes and not limits.parameters and limits.effects == "ignore":
        raise EmaError(f"{path}: holds no limit; add [[modes]] or [[parameters]]")
    return limits


def reference_modes(limits: Limits) -> dict[str, MeasuredModes]:
    """The modes of the limits, by configuration, in the form that measured modes have."""
    found: dict[str, MeasuredModes] = {}
    for configuration in dict.fromkeys(m.configuration for m in limits.modes):
        own = [m for m in limits.modes if m.configuration == configuration]
        names = list(dict.fromkeys(d for m in own if m.shape for d in m.shape.dofs))
        shapes = np.full((len(own), len(names)), np.nan, complex)
        for r, m in enumerate(own):
            if m.shape is not None:
                imaginary = m.shape.im or (0.0,) * len(m.shape.re)
                shapes[r, [names.index(d) for d in m.shape.dofs]] = np.array(m.shape.re) + 1j * np.array(
                    imaginary
                )
        unknown = np.full(len(own), np.nan)
        complete = bool(names) and all(m.shape is not None for m in own)
        found[configuration] = MeasuredModes(
            configuration,
            np.array([m.frequency_hz for m in own]),
            unknown, unknown, unknown,
            shapes=shapes if complete else None,
            dofs=tuple(Dof.parse(n) for n in names) if complete else (),
        )  # fmt: skip
    return found


def learn_limits(
    features: Features,
    reference: Mapping[str, MeasuredModes],
    content: float = 0.95,
    confidence: float = 0.95,
    source: str = "",
) -> tuple[Limits, list[str]]:
    """Two-sided normal tolerance intervals of all features, from a good lot.

    Content and confidence hold for all limits together (Bonferroni): a share `content` of all good tests lies within
    every limit. Damping ratios and parameters are normal in their logarithms. MAC has no learnt limit: it is no normal
    variable.

    Parameters
    ----------
    features : Features
        Of the good lot alone.
    reference : dict of str to MeasuredModes
        The modes that number the features.
    content, confidence : float
    source : str
        What the lot is, for the file.

    Returns
    -------
    limits : Limits
    notes : list of str
        Features without limits, and those that do not look normal.

    Raises
    ------
    EmaError
        For fewer than `LEAST_LOT` tests, or shares outside (0, 1).
    """
    if not 0 < content < 1 or not 0 < confidence < 1:
        raise EmaError(f"content {content:g} and confidence {confidence:g}: give shares above 0 and below 1")
    if len(features.values) < LEAST_LOT:
        raise EmaError(f"{source}: {len(features.values)} good tests; limits need {LEAST_LOT} or more")
    learnable = features.about.index[features.about["quantity"].isin([FREQUENCY, DAMPING, PARAMETER])]
    full = [f for f in learnable if features.values[f].notna().sum() >= LEAST_LOT]
    notes = [f"{f}: found in fewer than {LEAST_LOT} tests, no limit" for f in learnable if f not in full]
    told = [f for f in full if not _hidden(features, f)]
    notes += [
        f"{f}: its uncertainty in one test exceeds the scatter of the lot, no limit"
        for f in full
        if f not in told
    ]
    share = len(told) or 1
    ranges: dict[str, Range] = {}
    for name in told:
        values = features.values[name].dropna().to_numpy()
        log = features.about.loc[name, "quantity"] != FREQUENCY
        found = np.log(values) if log and np.all(values > 0) else values
        if len(found) >= 8 and scipy.stats.shapiro(found).pvalue < _UNUSUAL:
            notes.append(
                f"{name}: the lot does not look normal (Shapiro-Wilk p < {_UNUSUAL:g}); check its limits"
            )
        k = tolerance_factor(len(found), 1 - (1 - content) / share, 1 - (1 - confidence) / share)
        centre, half = float(np.mean(found)), k * float(np.std(found, ddof=1))
        ends = (centre - half, centre + half)
        low, high = (float(np.exp(e)) for e in ends) if found is not values else ends
        ranges[name] = Range(min=low, max=high)
    return _collected(features, reference, ranges, content, confidence, source), notes


def _hidden(features: Features, name: str) -> bool:
    """True where one test's own uncertainty is larger than the scatter of the lot: no test could pass."""
    stds = features.stds[name].dropna()
    return bool(len(stds) and float(stds.median()) > float(features.values[name].std(ddof=1)))


def _collected(
    features: Features,
    reference: Mapping[str, MeasuredModes],
    ranges: Mapping[str, Range],
    content: float,
    confidence: float,
    source: str,
) -> Limits:
    about = features.about.loc[list(ranges)]

    def of(configuration: str, mode: int, quantity: str) -> Range | None:
        chosen = (
            (about["configuration"] == configuration)
            & (about["mode"] == mode)
            & (about["quantity"] == quantity)
        )
        return ranges[str(about.index[chosen][0])] if chosen.any() else None

    modes = tuple(
        ModeLimits(
            configuration=c,
            frequency_hz=float(own.frequency_hz[k]),
            shape=_shape(own, k),
            frequency=of(c, k + 1, FREQUENCY),
            damping=of(c, k + 1, DAMPING),
        )
        for c, own in reference.items()
        for k in range(len(own))
        if of(c, k + 1, FREQUENCY) is not None
    )
    parameters = tuple(
        ParameterLimits(name=str(name), min=ranges[str(name)].min, max=ranges[str(name)].max)
        for name in about.index[about["quantity"] == PARAMETER]
    )
    return Limits(
        learnt_from=source, lot=len(features.values), content=content, confidence=confidence, modes=modes,
        parameters=parameters,
    )  # fmt: skip


def _shape(modes: MeasuredModes, k: int) -> Shape | None:
    if modes.shapes is None:
        return None
    known = [(str(d), v) for d, v in zip(modes.dofs, modes.shapes[k], strict=True) if np.isfinite(v)]
    return Shape(
        dofs=tuple(d for d, _ in known), re=tuple(float(v.real) for _, v in known),
        im=tuple(float(v.imag) for _, v in known),
    )  # fmt: skip


def write_limits(limits: Limits, path: Path, notes: Iterable[str] = ()) -> None:
    """Write ``limits.toml``; limits that were learned before are replaced, nothing else is.

    Raises
    ------
    EmaError
        If something else is there, or the file cannot be written.
    """
    _check_replaceable(path)
    document = tomlkit.document()
    document.add(tomlkit.comment("Limits of 'ema series judge'. Remove what is not to be judged."))
    for text in notes:
        document.add(tomlkit.comment(text))
    for key, value in limits.model_dump(mode="json", by_alias=True, exclude_none=True).items():
        document.add(key, tomlkit.item(value))
    replace_file(path, tomlkit.dumps(document))


def _check_replaceable(path: Path) -> None:
    if not path.exists() or path.is_dir():  # a folder is refused where files are written
        return
    try:
        learned = parse(Limits, read_toml(path), path).learnt_from != ""
    except EmaError:
        learned = False
    if not learned:
        raise EmaError(
            f"{path}: holds something else than learned limits and is kept; name another with --to"
        )


def good_lot(tests: pd.DataFrame, wanted: Iterable[str] = ()) -> list[str]:
    """Names of the tests of a good lot: those that are wanted, or all with results and no claimed effect.

    Raises
    ------
    EmaError
        If a test that is wanted has no results.
    """
    with_results = list(tests.loc[tests["state"] == "ok", "test"])
    asked = list(wanted)
    for name in asked:
        if name not in with_results:
            raise EmaError(
                f"test '{name}': has no results in this series; see 'tests.csv' for those that have"
            )
    found = (tests["state"] == "ok") & ~tests["verdict"].isin(["effect", "ambiguous", "unknown_effect"])
    return asked or list(tests.loc[found, "test"])
