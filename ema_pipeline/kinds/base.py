"""What a kind of test offers, and how the effects of its model are judged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NoReturn

from ema_pipeline.rigs.types import Rig
from ema_pipeline.run.types import Progress, Run

if TYPE_CHECKING:
    from ema_pipeline.frf.types import FrfSet
    from ema_pipeline.modal.types import ModalModel

Results = dict[str, object]
"""Results of a stage by the names that they have in the store."""


def _not_measured(run: Run, configuration: str, progress: Progress) -> NoReturn:
    raise AssertionError(f"{run.info.kind} has no such stage")


@dataclass(frozen=True)
class Judge:
    """How it is judged which effects a model needs.

    Attributes
    ----------
    diagnose : callable
        Gives what the model is missing, on top of the effects that the user added.
    ladder : callable
        Gives the effects that the user added, rung by rung.
    check_model : callable
        Raises EmaError where the model cannot have the effects that the user added.
    stages : frozenset of str
        Stages that work on the model.
    ladder_of_diagnosis : bool
        True where the ladder stage gives nothing that the diagnosis of the same effects has not given.
    """

    diagnose: Callable[[Run, Progress], Results]
    ladder: Callable[[Run, Progress], Results]
    check_model: Callable[[Run], None]
    stages: frozenset[str] = frozenset({"ladder", "diagnose"})
    ladder_of_diagnosis: bool = False


@dataclass(frozen=True)
class Kind:
    """What a kind of test offers.

    Attributes
    ----------
    name : str
        As test.toml states it.
    words : str
        What was recorded, in the plural, for messages.
    measures : tuple of str
        Stages that go from the raw data to what a model is compared with, in order.
    judge : callable
        Gives the judge of a run's model; None where the run has no model.
    read, frfs, modes : callable
        What the stages ``ingest``, ``frf`` and ``modal`` do for one configuration, where they are among `measures`.
    rig : str
        Rig where none is named; empty where there is no model then.
    check_rig : callable
        Takes a rig and the name or path that it was given by; raises EmaError where the test cannot be one of it.
    of_rig : bool
        True where configurations and DOFs of the test are those of the rig.
    next_measurement : str
        What to measure next where the diagnosis finds an effect that it does not know; empty leaves it its own advice.
    """

    name: str
    words: str
    measures: tuple[str, ...]
    judge: Callable[[Run], Judge | None]
    read: Callable[[Run, str, Progress], Results] = _not_measured
    frfs: Callable[[Run, str, Progress], FrfSet] = _not_measured
    modes: Callable[[Run, str, Progress], ModalModel] = _not_measured
    rig: str = ""
    check_rig: Callable[[Rig, str], None] = lambda rig, source: None
    of_rig: bool = True
    next_measurement: str = ""
