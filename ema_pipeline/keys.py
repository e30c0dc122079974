"""Keys of results: an equal key means equal inputs, settings and program."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from functools import cache, cached_property
from pathlib import Path

from ema_pipeline.errors import EmaError
from ema_pipeline.kinds import stages_of
from ema_pipeline.run.types import Run
from ema_pipeline.stages.base import configurations_of, stage_module
from ema_pipeline.store import ALL


class Keys:
    """Keys of all stages of a run: equal keys mean equal inputs, settings and program.

    Stages that are not to be run are taken as they are in the store.
    """

    def __init__(self, run: Run, names: Iterable[str]) -> None:
        self._run = run
        self._names = frozenset(names)
        self._known: dict[tuple[str, str], str] = {}

    def __call__(self, name: str, configuration: str) -> str:
        """Key that the result of a stage should have."""
        if (name, configuration) not in self._known:
            make = self._compute if name in self._names else self._stored
            self._known[name, configuration] = make(name, configuration)
        return self._known[name, configuration]

    def _stored(self, name: str, configuration: str) -> str:
        key = self._run.store.key(name, configuration)
        if not key:
            where = "" if configuration == ALL else f" for configuration '{configuration}'"
            raise EmaError(
                f"{self._run.store.path}: holds no result of stage '{name}'{where}; "
                f"run 'ema {name} {self._run.store.folder}' first"
            )
        return key

    @cached_property
    def _in_store(self) -> frozenset[str]:
        """Stages that the store held at first: no stage but those to be run can join them."""
        return frozenset(name for name, _ in self._run.store.provenance())

    def _compute(self, name: str, configuration: str) -> str:
        stage, run = stage_module(name), self._run
        there = stages_of(run)
        present = [o for o in getattr(stage, "USES", ()) if o in self._names or o in self._in_store]
        needed = [
            self(other, c)
            for other in (*stage.NEEDS, *present)
            if other in there
            for c in (
                (configuration,) if configuration != ALL else configurations_of(stage_module(other), run)
            )
        ]
        parts = {
            "stage": name,
            "code": code_fingerprint(),
            "settings": run.settings.of(name).model_dump_json(),
            "rig": [run.info.rig, run.info.effects] if stage.NEEDS_RIG else "",
            "inputs": stage.inputs(run, configuration),
            "needed": needed,
        }
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


@cache
def code_fingerprint() -> str:
    """Hash of the package's source and its pages' templates, so that a changed program does not trust old results."""
    root = Path(__file__).resolve().parent
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*")):
        if path.suffix in (".py", ".j2", ".js"):
            digest.update(path.read_bytes())
    return digest.hexdigest()
