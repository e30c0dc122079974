"""Two tests, as raw folders or results → what changed."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ema_pipeline.answers import CHANGES_FILE
from ema_pipeline.changes.modes import ModeChanges, mode_changes
from ema_pipeline.changes.physics import PhysicalChange, Progress, modes_of_both, physical_change
from ema_pipeline.describe import checked_rig
from ema_pipeline.errors import EmaError
from ema_pipeline.files import replace_file
from ema_pipeline.job import run_raw
from ema_pipeline.kinds import kind_of
from ema_pipeline.observations.pair import RepeatSettings
from ema_pipeline.pipeline import ShowStage
from ema_pipeline.report.summary_files import finite
from ema_pipeline.results_folder import RESULTS_FILE
from ema_pipeline.run.opening import existing_run
from ema_pipeline.run.types import Run

MEASURING = 'stages=["ingest", "hits", "frf", "modal", "levels"]'
"""Stages that are run where a test is given as a raw folder: its modes, and no diagnosis of its own."""


@dataclass(frozen=True)
class Changes:
    """What changed from A to B.

    Attributes
    ----------
    a, b : str
        The two tests, as they were named.
    modes : ModeChanges
    physics : PhysicalChange or None
        None without a rig.
    """

    a: str
    b: str
    modes: ModeChanges
    physics: PhysicalChange | None = None

    @property
    def verdict(self) -> Literal["same", "changed"]:
        """``"changed"`` where the data support a physical effect; without a rig where a mode changed.

        With a rig that explains neither the difference nor its absence, the modes decide.
        """
        if self.physics is None or (
            self.physics.diagnosis.verdict == "unknown_effect" and not self.physics.claimed
        ):
            return "changed" if self.modes.changed else "same"
        return "changed" if self.physics.claimed else "same"


def open_test(
    path: Path,
    rig: str | None,
    into: Path,
    show: ShowStage | None = None,
    effect_files: Sequence[str] = (),
) -> Run:
    """A test as a run with modes: a results folder as it is, a raw folder run up to its modes.

    Parameters
    ----------
    path : Path
    rig : str or None
        Takes the place of the rig that the results were made with.
    into : Path
        Where the results of a raw folder go.
    show : callable, optional
    effect_files : sequence of str
        Python files with the user's own effects.

    Raises
    ------
    EmaError
        If there are no modes, or the rig does not know the test's configurations.
    """
    if (path / RESULTS_FILE).is_file():
        run = existing_run(path, effect_files)
        if rig is not None:
            run = dataclasses.replace(run, built_rig=checked_rig(rig))
    else:
        run, _ = run_raw(path, rig, into, None, [MEASURING], show, effect_files=effect_files)
    kind = kind_of(run.info)
    if "modal" not in kind.measures:
        raise EmaError(f"{path}: {kind.words} have no modes; compare hammer tests")
    for name in run.info.configurations:
        if not run.store.key("modal", name):
            raise EmaError(f"{path}: has no modes of '{name}'; run 'ema run' to its end")
        if run.rig is not None and name not in run.rig.configurations:
            known = ", ".join(run.rig.configurations)
            raise EmaError(f"{path}: configuration '{name}' is not one of rig '{run.rig.name}' ({known})")
    return run


def compare_runs(
    a: Run,
    b: Run,
    progress: Progress = lambda share, text: None,
    repeat: RepeatSettings | None = None,
    by_rig: bool = True,
) -> Changes:
    """What changed from one run to another; physically where both have a rig that is to be used."""
    of_a, of_b, _ = modes_of_both(a, b)
    physics = None
    if by_rig and a.rig is not None and b.rig is not None:
        physics = physical_change(a, b, progress, repeat)
    return Changes(a.info.raw, b.info.raw, mode_changes(of_a, of_b), physics)


def changes_content(found: Changes) -> dict[str, Any]:
    """Contents of ``changes.json``."""
    content: dict[str, Any] = {
        "schema": 1,
        "a": found.a,
        "b": found.b,
        "verdict": found.verdict,
        "changes": [],
    }
    if found.physics is not None:
        diagnosis = found.physics.diagnosis
        sign = -1 if found.physics.reverse else 1
        content["changes"] = [
            {
                "effect": c.effect, "at": c.at, "parameter": name, "value": sign * size.value, "std": size.std,
                "unit": size.unit, "probability": c.probability, "also_called": list(c.equivalents),
            }
            for c in found.physics.claimed
            for name, size in c.parameters.items()
        ]  # fmt: skip
        content["diagnosis"] = {
            "verdict": diagnosis.verdict,
            "in": "A" if found.physics.reverse else "B",
            "error_before": diagnosis.ladder.rungs[0].error,
            "error_after": diagnosis.ladder.rungs[-1].error,
            "nothing_changed_probability": diagnosis.null_probability,
            "indistinguishable": [list(g) for g in diagnosis.indistinguishable],
            "limits": [dataclasses.asdict(limit) for limit in diagnosis.detection_limits],
        }
    content["modes"] = [_mode(m) for m in found.modes.modes]
    content["only_a"] = [_lone(m) for m in found.modes.only_a]
    content["only_b"] = [_lone(m) for m in found.modes.only_b]
    content["common_shift"] = {c: dataclasses.asdict(s) for c, s in found.modes.common_shift.items()}
    return dict(finite(content))


def _mode(m: Any) -> dict[str, Any]:
    frequency, damping = m.frequency_change, m.damping_change
    return dataclasses.asdict(m) | {
        "frequency_change": frequency[0],
        "frequency_change_std": frequency[1],
        "damping_change": damping[0],
        "damping_change_std": damping[1],
        "changed": list(m.changed),
    }


def _lone(mode: tuple[str, int, float]) -> dict[str, Any]:
    return {"configuration": mode[0], "mode": mode[1], "frequency_hz": mode[2]}


def write_changes(found: Changes, out: Path) -> Path:
    """Write ``changes.json`` into a folder."""
    path = out / CHANGES_FILE
    replace_file(path, json.dumps(changes_content(found), indent=2, ensure_ascii=False) + "\n")
    return path
