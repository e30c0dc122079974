"""Rigs: the analytical model of the test object, with the tolerances of its parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ema_pipeline.api.arguments import expect, plain, texts
from ema_pipeline.api.display import Report
from ema_pipeline.describe import checked_rig
from ema_pipeline.errors import EmaError
from ema_pipeline.rigs.base import ParametricRig, model_modes
from ema_pipeline.rigs.entries import MODAL_DAMPING_RATIO
from ema_pipeline.rigs.types import Parameter

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import RenderableType

__all__ = ["Parameter", "Rig", "load_rig"]


@dataclass(frozen=True, repr=False)
class Rig(Report, ParametricRig):
    """A rig: parameters with tolerances, and a function that builds its elements from their values.

    `Rig.of_elements` lists masses, springs and dampers in place of the function.

    Attributes
    ----------
    name : str
    configurations : tuple of str
    parameters : dict of str to Parameter
    build : callable
        ``build(configuration, values) -> Assembly``.
    uses : callable
        ``uses(configuration, parameter name) -> bool``; every configuration uses every parameter where left out.
    classifier : callable
        Gives every mode a family; ``"elastic"`` or ``"rigid body"`` where left out.
    modal_damping_scatter : float
        Standard deviation (1 σ) of ln ζ from mode to mode.
    """

    def __post_init__(self) -> None:
        expect("name", self.name, str, "a text")
        names = texts("configurations", self.configurations, "a list of names such as ('free', 'clamped')")
        if not names:
            raise EmaError(f"rig '{self.name}': has no configuration; give at least one name")
        expect(
            "parameters",
            self.parameters,
            Mapping,
            "ema.Parameter by name, e.g. {'k': ema.Parameter('k', 1e4, 'N/m')}",
        )
        for name, parameter in self.parameters.items():
            expect(f"parameter '{name}'", parameter, Parameter, f"ema.Parameter('{name}', value, unit)")
        for key in ("build", "uses", "classifier"):
            expect(key, getattr(self, key), Callable, "a function")  # type: ignore[arg-type]
        scatter = self.modal_damping_scatter
        if not isinstance(scatter, Real) or not 0 <= scatter < math.inf:
            raise EmaError(
                f"rig '{self.name}': modal_damping_scatter = {scatter!r}: give 0 or more, 1 sigma of ln ζ"
            )
        damping = self.parameters.get(MODAL_DAMPING_RATIO)
        if damping is not None and not 0 <= damping.value < 1:
            raise EmaError(
                f"rig '{self.name}': {MODAL_DAMPING_RATIO} = {damping.value:g}: a damping ratio lies from 0 to below 1"
            )

    @classmethod
    def of_elements(cls, name: str, **keys: Any) -> Rig:
        """A rig of masses, springs and dampers; the keys are those of a rig file.

        Parameters
        ----------
        name : str
        **keys
            ``masses``, ``springs``, ``dampers``, ``parameters``, ``configurations``, …, see "Adding a rig" in the
            documentation. Values in SI units.

        Raises
        ------
        EmaError
            Names the key of whatever is wrong.

        Examples
        --------
        >>> block = ema.Rig.of_elements(
        ...     "block",
        ...     parameters={"stiffness": {"value": 8e4, "unit": "N/m", "tolerance": 0.1}},
        ...     masses=[{"at": "block.x", "value": 2.0}],
        ...     springs=[{"at": "block.x", "value": "stiffness"}],
        ... )
        >>> float(block.table()["frequency_hz"].iloc[0].round(2))
        31.83
        """
        from ema_pipeline.rigs.element_entries import ElementRigFile
        from ema_pipeline.rigs.elements import rig_from_elements
        from ema_pipeline.rigs.entries import Mistake, parsed

        try:
            return _as_rig(rig_from_elements(parsed(ElementRigFile, {"name": name, **plain(keys)})))
        except Mistake as mistake:
            where = ".".join(str(step) for step in mistake.location)
            raise EmaError(f"rig '{name}'{f', {where}' if where else ''}: {mistake}") from None

    def table(self) -> pd.DataFrame:
        """The model's own modes at nominal values, counted from 1: frequency, damping ratio, family."""
        import pandas as pd

        rows = [
            (c, m.index + 1, m.frequency_hz, m.damping_ratio, m.family)
            for c in self.configurations
            for m in model_modes(self, c)
        ]
        return pd.DataFrame(
            rows, columns=["configuration", "mode", "frequency_hz", "damping_ratio", "family"]
        )

    def parameter_table(self) -> pd.DataFrame:
        """One row per parameter: nominal value, tolerance (relative, 1 σ), bounds, whether the data set it."""
        import pandas as pd

        rows = [
            (p.name, p.value, p.unit, p.tolerance, p.minimum, p.maximum, p.free)
            for p in self.parameters.values()
        ]
        columns = ["parameter", "value", "unit", "tolerance", "minimum", "maximum", "free"]
        return pd.DataFrame(rows, columns=columns)

    def _screen(self) -> RenderableType:
        return "\n".join([*self._headline(), "", self.parameter_table().to_string(index=False)])

    def _headline(self) -> Sequence[str]:
        return [f"Rig {self.name}", f"Configurations: {', '.join(self.configurations)}"]


def load_rig(name_or_path: str | Path) -> Rig:
    """A rig that ships with the program by its name, or a rig file by its path.

    Raises
    ------
    EmaError
        For an unknown name, or a mistake in the file: names file, line and key.

    Examples
    --------
    >>> ema.load_rig("planetary").configurations
    ('no_ring', 'with_ring')
    >>> ema.load_rig("planetery")
    Traceback (most recent call last):
    ema_pipeline.errors.EmaError: no rig 'planetery' (did you mean 'planetary'?); or give a rig file ending in .toml
    """
    expect("name_or_path", name_or_path, (str, Path), "the name of a rig or the path of a rig file")
    rig = checked_rig(str(name_or_path))
    assert isinstance(rig, ParametricRig)  # all that files and shipped rigs make
    return _as_rig(rig)


def _as_rig(rig: Any) -> Rig:
    return Rig(**{f.name: getattr(rig, f.name) for f in fields(ParametricRig)})
