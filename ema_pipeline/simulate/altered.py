"""A rig whose elements are changed after it has assembled them: the true rig behind a model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.rigs.types import Parameter, Rig


@dataclass(frozen=True)
class AlteredRig:
    """A rig like another one, but for `change`.

    Attributes
    ----------
    rig : Rig
    change : callable
        ``change(configuration, assembly) -> assembly``.
    """

    rig: Rig
    change: Callable[[str, Assembly], Assembly]

    @property
    def name(self) -> str:
        """Name of the unchanged rig."""
        return self.rig.name

    @property
    def configurations(self) -> tuple[str, ...]:
        """Those of the unchanged rig."""
        return self.rig.configurations

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """Those of the unchanged rig."""
        return self.rig.parameters

    def used(self, configuration: str) -> tuple[str, ...]:
        """See `Rig.used`."""
        return self.rig.used(configuration)

    def assembly(self, configuration: str, values: Mapping[str, float] | None = None) -> Assembly:
        """See `Rig.assembly`; changed."""
        return self.change(configuration, self.rig.assembly(configuration, values))

    def system(self, configuration: str, values: Mapping[str, float] | None = None) -> LinearSystem:
        """See `Rig.system`; changed."""
        return self.assembly(configuration, values).system()

    def knows(self, configuration: str, dof: Dof) -> bool:
        """See `Rig.knows`."""
        return self.rig.knows(configuration, dof)

    def classify(
        self, system: LinearSystem, frequency_hz: NDArray[np.float64], shapes: NDArray[np.float64]
    ) -> tuple[tuple[str, ...], NDArray[np.float64]]:
        """See `Rig.classify`."""
        return self.rig.classify(system, frequency_hz, shapes)
