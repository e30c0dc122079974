"""Modes that grow once the exponential window is taken off: the records had a weaker window than is stated."""

from __future__ import annotations

from ema_pipeline.errors import EmaError
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.left_out import taken_out_and_named
from ema_pipeline.modal.types import GROWS, ModalModel, Mode

CLEARLY = 3.0
"""Standard deviations below zero from which on a damping ratio is negative whatever the noise."""

REMEDY = "state the window that was applied as exponential_window_rad_s in test.toml, 0 if none"


def without_growing(modal: ModalModel, frfs: FrfSet) -> ModalModel:
    """The modes without those of clearly negative damping, which are named among what is left out.

    Parameters
    ----------
    modal : ModalModel
    frfs : FrfSet

    Raises
    ------
    EmaError
        Where most modes have it.
    """
    gone = [k for k, mode in enumerate(modal.modes) if _grows(mode)]
    if not frfs.response_decay_rad_s or not gone:
        return modal
    first = modal.modes[gone[0]]
    if 2 * len(gone) > len(modal.modes):
        raise EmaError(
            f"{len(gone)} of {len(modal.modes)} modes have negative damping ({100 * first.damping_ratio:.3g} % at "
            f"{first.frequency_hz:.5g} Hz) once the exponential window of {frfs.response_decay_rad_s:.3g} rad/s is "
            f"taken off, which decays faster than the responses: {REMEDY}"
        )
    return taken_out_and_named(modal, gone, "mode", GROWS)


def _grows(mode: Mode) -> bool:
    return mode.damping_ratio < -CLEARLY * mode.damping_std
