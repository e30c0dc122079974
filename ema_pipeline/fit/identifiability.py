"""Does the data determine a parameter? A number that it does not determine is not to be given."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.fit.space import Coordinate
from ema_pipeline.fit.types import Profile


@dataclass(frozen=True)
class Judgement:
    """Whether a parameter is identified, and why not (or what to mind)."""

    identified: bool
    note: str


def judge_free(
    coordinate: Coordinate, p: Profile, value: float, std: float, settings: FitSettings
) -> Judgement:
    """A free parameter: its profile must close inside the bounds, and its standard deviation be small.

    Parameters
    ----------
    coordinate : Coordinate
    p : Profile
    value, std : float
        Estimate and its standard deviation in the parameter's unit.
    settings : FitSettings
        `profile_rise`, `relative_std_limit`.
    """
    at = int(np.argmin(p.objective))
    below, above = float(p.objective[: at + 1].max()), float(p.objective[at:].max())
    at_low = at == 0 and coordinate.coordinate(value) <= coordinate.low + 1e-9
    at_high = at == p.values.size - 1 and coordinate.coordinate(value) >= coordinate.high - 1e-9
    unit = coordinate.parameter.unit
    if at_low and above >= settings.profile_rise and coordinate.kind == "linear":
        return Judgement(True, f"at its lower bound, {p.values[0]:.3g} {unit}")
    if at_high and below >= settings.profile_rise and coordinate.kind == "linear":
        return Judgement(True, f"at its upper bound, {p.values[-1]:.3g} {unit}")
    open_sides = [side for side, rise in (("below", below), ("above", above)) if rise < settings.profile_rise]
    if open_sides:
        where = " and ".join(open_sides)
        return Judgement(
            False,
            f"not identified: -2 log posterior rises by {below:.2g} below and {above:.2g} above the "
            f"estimate inside the bounds, {settings.profile_rise:g} is needed on both sides (open {where})",
        )
    reference = abs(value)
    if coordinate.kind == "linear":
        # an effect's size may well be zero: what counts is the size that would be clearly visible
        reference = max(reference, coordinate.scale)
    if std > settings.relative_std_limit * reference:
        return Judgement(
            False,
            f"not identified: standard deviation {100 * std / max(reference, 1e-300):.0f} % exceeds "
            f"{100 * settings.relative_std_limit:.0f} %",
        )
    return Judgement(True, "")


def judge_prior(
    std: float, prior_std: float, shift_z: float, at_bound: bool, settings: FitSettings
) -> Judgement:
    """A parameter with a tolerance: identified where the data narrow it; remarked where they contradict "
    "it."""
    identified = std < settings.narrowed * prior_std
    notes = []
    if abs(shift_z) > 3:
        notes.append(
            f"out of tolerance: the data put it {shift_z:+.1f} standard deviations from its nominal value"
        )
    if at_bound:
        notes.append("at its bound")
    if not identified:
        notes.append("the data say little: the tolerance determines it")
    return Judgement(identified, "; ".join(notes))
