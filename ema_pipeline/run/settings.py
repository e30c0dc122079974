"""All settings of a pipeline: read from a shipped or own TOML file, changed by ``stage.key=value``."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal, cast

from pydantic import Field

from ema_pipeline.correlate.settings import CompareSettings, PairingSettings
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.ingest.file_size_limits import ReadLimits
from ema_pipeline.ingest.hit_settings import HitSettings
from ema_pipeline.levels.settings import LevelSettings
from ema_pipeline.loops.settings import LoopSettings
from ema_pipeline.modal.circle.settings import CircleSettings
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.report.settings import ReportSettings
from ema_pipeline.settings import Settings, parse, setting_names
from ema_pipeline.toml_text import parse_toml, read_toml

STAGES = (
    "ingest", "hits", "frf", "modal", "levels", "loops", "ladder", "diagnose", "fit", "correlate", "report",
)  # fmt: skip
"""All stages, in the order in which the data flow."""


class IngestSettings(ReadLimits):
    """Reading raw folders: all but the limits is said in test.toml."""


class CorrelateSettings(Settings):
    """Pairing and comparison."""

    pairing: PairingSettings = Field(PairingSettings(), description="when two modes may be the same")
    compare: CompareSettings = Field(CompareSettings(), description="how differences are counted")


class ModalStageSettings(Settings):
    """Identification, and the circle fits beside it."""

    method: Literal["lscf", "circle"] = Field(
        "lscf",
        description="'lscf': poles of all FRFs at once, circle fits as a check; 'circle': circle fits alone",
    )
    identify: ModalSettings = Field(ModalSettings(), description="poles, selection, shapes")
    circle: CircleSettings = Field(CircleSettings(), description="Nyquist circles")


class LadderSettings(Settings):
    """The ladder is measured with the settings of the diagnosis."""


class PipelineSettings(Settings):
    """All settings of a pipeline; ``pipelines/*.toml`` are files of this kind."""

    rig: str | None = Field(None, description="rig that this pipeline is made for")
    stages: tuple[str, ...] = Field(STAGES, description="stages to run, in order")
    effect_files: tuple[str, ...] = Field((), description="Python files with effects of the user's own")
    processes: int | None = Field(
        None,
        ge=1,
        le=64,
        description="configurations, or force levels of one, worked on at a time; left out: what suits the processors",
    )
    ingest: IngestSettings = Field(IngestSettings(), description="reading raw folders")
    hits: HitSettings = Field(HitSettings(), description="hit finding and quality limits")
    frf: FrfSettings = Field(FrfSettings(), description="windows and estimator")
    modal: ModalStageSettings = Field(ModalStageSettings(), description="modal identification")
    levels: LevelSettings = Field(LevelSettings(), description="what moves with the force of the hits")
    fit: FitSettings = Field(FitSettings(), description="fitting the model's parameters")
    correlate: CorrelateSettings = Field(CorrelateSettings(), description="pairing and comparison")
    diagnose: DiagnoseSettings = Field(DiagnoseSettings(), description="search for missing physics")
    loops: LoopSettings = Field(LoopSettings(), description="force-displacement loops")
    ladder: LadderSettings = Field(LadderSettings(), description="the ladder of added effects")
    report: ReportSettings = Field(ReportSettings(), description="tables, plots and the report")

    def of(self, stage: str) -> Settings:
        """Settings of one stage."""
        return cast(Settings, getattr(self, stage))

    def by_stage(self) -> dict[str, Settings]:
        """Settings of every stage, in the order in which the data flow."""
        return {stage: self.of(stage) for stage in STAGES}


def shipped_pipelines() -> dict[str, Path]:
    """Pipelines that come with the program, by name."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "pipelines", package.parent / "pipelines"):
        if folder.is_dir():
            return {p.stem: p for p in sorted(folder.glob("*.toml"))}
    return {}


def load_pipeline(name_or_path: str, overrides: Iterable[str] = ()) -> PipelineSettings:
    """Read a pipeline and apply overrides such as ``"modal.identify.engine=lscf"``.

    Parameters
    ----------
    name_or_path : str
        Name of a shipped pipeline, or path of a TOML file.
    overrides : iterable of str
        ``stage.key=value`` with a TOML value; a value that is no TOML is taken as text.

    Raises
    ------
    EmaError
        For an unknown pipeline, broken TOML, unknown keys and values of the wrong type.
    """
    shipped = shipped_pipelines()
    path = shipped.get(name_or_path, Path(name_or_path))
    if not os.path.exists(path):
        raise EmaError(
            f"no pipeline '{name_or_path}'{did_you_mean(name_or_path, shipped)}; or give a TOML file"
        )
    return _settings(read_toml(path), overrides, str(path))


def override(settings: PipelineSettings, overrides: Iterable[str], where: str | Path) -> PipelineSettings:
    """The settings with ``stage.key=value`` changed; `where` is named in error messages."""
    return _settings(settings.model_dump(mode="json"), overrides, str(where))


def _settings(data: dict[str, Any], overrides: Iterable[str], where: str) -> PipelineSettings:
    for change in overrides:
        key, sign, value = change.partition("=")
        if not sign or not key.strip():
            raise EmaError(f"--set {change}: is not of the form stage.key=value")
        if key.strip() == "rig":  # says for which rig a pipeline is made, and chooses none
            raise EmaError(f"--set {change}: name the rig of a test with --rig")
        *parents, last = key.strip().split(".")
        known = setting_names(PipelineSettings)
        if key.strip() not in known and (alike := [k for k in known if k.split(".")[-1] == last]):
            raise EmaError(
                f"--set {change}: there is no setting '{key.strip()}' (did you mean {' or '.join(alike)}?)"
            )
        table = data
        for parent in parents:
            table = table.setdefault(parent, {})
            if not isinstance(table, dict):
                raise EmaError(f"--set {change}: '{parent}' is no table of settings")
        table[last] = toml_value(value.strip())
        where = f"{where} with --set {change}"
    settings = parse(PipelineSettings, data, where)
    if not settings.stages:
        raise EmaError(f"{where}: stages = []: name one or more of {', '.join(STAGES)}")
    for stage in settings.stages:
        if stage not in STAGES:
            raise EmaError(f"{where}: unknown stage '{stage}'{did_you_mean(stage, STAGES)}")
    return settings


def toml_value(text: str) -> Any:
    """A value as TOML would read it; text that is no TOML is taken as it stands."""
    try:
        return parse_toml(f"value = {text}", text)["value"]
    except EmaError:
        return text
