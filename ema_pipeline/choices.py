"""What the user decided about hits and modes: excluded, or included though the selection left them out.

Choices are kept with the run and honoured by every later one. Raw data never change.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ema_pipeline.errors import EmaError


@dataclass(frozen=True)
class HitChoice:
    """A hit, as ``configuration/file#number``; numbers within a file begin at 1."""

    configuration: str
    file: str
    number: int

    def __str__(self) -> str:
        return f"{self.configuration}/{self.file}#{self.number}"


@dataclass(frozen=True)
class ModeChoice:
    """A mode by where it lies, as ``configuration:hertz``: its number changes when others come or go.

    Attributes
    ----------
    configuration : str
    frequency_hz, damping_ratio : float
        As they were when it was chosen.
    """

    configuration: str
    frequency_hz: float
    damping_ratio: float

    def __str__(self) -> str:
        return f"{self.configuration}:{self.frequency_hz:.8g}"


@dataclass(frozen=True)
class Choices:
    """All choices of a run, in the order in which they were made.

    Attributes
    ----------
    excluded_hits : tuple of HitChoice
    excluded_modes : tuple of ModeChoice
    included_modes : tuple of ModeChoice
        Taken from the stabilisation chart, where the selection had left them out.
    """

    excluded_hits: tuple[HitChoice, ...] = ()
    excluded_modes: tuple[ModeChoice, ...] = ()
    included_modes: tuple[ModeChoice, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.excluded_hits or self.excluded_modes or self.included_modes)

    def of(self, configuration: str) -> Choices:
        """Those of one configuration."""
        return self.among((configuration,))

    def among(self, configurations: Sequence[str]) -> Choices:
        """Those of some configurations."""
        return Choices(
            tuple(x for x in self.excluded_hits if x.configuration in configurations),
            tuple(x for x in self.excluded_modes if x.configuration in configurations),
            tuple(x for x in self.included_modes if x.configuration in configurations),
        )

    def of_modes(self) -> Choices:
        """Without those about hits."""
        return replace(self, excluded_hits=())

    def fingerprint(self) -> str:
        """Equal for equal choices; empty where there are none."""
        every = (self.excluded_hits, self.excluded_modes, self.included_modes)
        return json.dumps([[vars(x) for x in kind] for kind in every]) if self else ""


NO_CHOICES = Choices()


def options_between(before: Choices, after: Choices) -> list[tuple[str, str, str]]:
    """What leads from one set of choices to another, as ``("exclude", "--hit", "no_ring/sun_y_3.uff#1")``."""
    found = []
    for kind, option, exclude, include in (
        ("excluded_hits", "--hit", "exclude", "include"),
        ("excluded_modes", "--mode", "exclude", "include"),
        ("included_modes", "--mode", "include", "exclude"),
    ):
        old, new = getattr(before, kind), getattr(after, kind)
        found += [(include, option, str(x)) for x in old if x not in new]
        found += [(exclude, option, str(x)) for x in new if x not in old]
    return found


def split_hit(text: str, configurations: Sequence[str]) -> tuple[str, str, int | None]:
    """Configuration, file and number that a user named; number None where only the file is named.

    Raises
    ------
    EmaError
        Where no configuration is named and there are several.
    """
    configuration, found, file = text.partition("/")
    if not found or configuration not in configurations:
        configuration, file = _only(text, "hit", "CONFIGURATION/FILE#NUMBER", configurations), text
    name, sign, number = file.rpartition("#")
    return (configuration, name, int(number)) if sign and number.isdecimal() else (configuration, file, None)


def split_mode(text: str, configurations: Sequence[str]) -> tuple[str, float]:
    """Configuration and frequency, Hz, that a user named.

    Raises
    ------
    EmaError
        Where no configuration is named and there are several, or the frequency is no positive number.
    """
    configuration, found, hertz = text.rpartition(":")
    if not found or configuration not in configurations:
        configuration, hertz = (
            _only(text, "mode", "CONFIGURATION:HERTZ", configurations),
            hertz if found else text,
        )
        if found:
            raise EmaError(
                f"there is no configuration '{text.rpartition(':')[0]}'; it is one of {_list(configurations)}"
            )
    try:
        frequency = float(hertz)
    except ValueError:
        frequency = 0.0
    if not 0 < frequency < float("inf"):
        raise EmaError(f"mode '{text}': name it by its frequency, CONFIGURATION:HERTZ")
    return configuration, frequency


def _only(text: str, what: str, form: str, configurations: Sequence[str]) -> str:
    if len(configurations) != 1:
        raise EmaError(
            f"{what} '{text}': name it as {form}, with one of the configurations {_list(configurations)}"
        )
    return configurations[0]


def _list(names: Sequence[str]) -> str:
    return ", ".join(f"'{n}'" for n in names)
