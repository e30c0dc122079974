"""Tables of modes in place of raw data, from a paper or another program."""

from __future__ import annotations

from pathlib import Path

from ema_pipeline.kinds import by_modes
from ema_pipeline.kinds.base import Kind
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.run.types import Progress, Run


def _modes(run: Run, configuration: str, progress: Progress) -> ModalModel:
    from ema_pipeline.correlate.measured import to_modal_model
    from ema_pipeline.exchange.mode_table import read_mode_table

    measured = read_mode_table(Path(run.info.raw), run.require_model("modal"))
    return to_modal_model(measured[configuration])


KIND = Kind(
    name="modes",
    words="tables of modes",
    measures=("modal",),
    judge=by_modes.judge,
    modes=_modes,
    next_measurement=(  # nobody can strike a table
        "Add shapes at further points where measurement and model differ most, and the standard deviations of the "
        "numbers; only hits at several force levels can show whether the missing effect depends on amplitude."
    ),
)
