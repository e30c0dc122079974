"""From hammer hits to the physics that the model is missing.

The names below are the whole public interface. Each is loaded when it is first used, so that importing the package
costs next to nothing.

Examples
--------
>>> import ema_pipeline as ema
>>> ema.load_rig("frame").configurations
('default',)
"""

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from ema_pipeline.api.continuous import ContinuousTest
    from ema_pipeline.api.diagnosis import Diagnosis, diagnose
    from ema_pipeline.api.fits import Fit, fit
    from ema_pipeline.api.frfs import Frfs
    from ema_pipeline.api.ladder import Ladder
    from ema_pipeline.api.modes import Modes, identify, read_modes
    from ema_pipeline.api.records import Test, read
    from ema_pipeline.api.results import Results, open, run
    from ema_pipeline.api.rigs import Parameter, Rig, load_rig
    from ema_pipeline.errors import EmaError

_HOMES = {
    "ContinuousTest": "api.continuous",
    "Diagnosis": "api.diagnosis",
    "EmaError": "errors",
    "Fit": "api.fits",
    "Frfs": "api.frfs",
    "Ladder": "api.ladder",
    "Modes": "api.modes",
    "Parameter": "api.rigs",
    "Results": "api.results",
    "Rig": "api.rigs",
    "Test": "api.records",
    "diagnose": "api.diagnosis",
    "fit": "api.fits",
    "identify": "api.modes",
    "load_rig": "api.rigs",
    "open": "api.results",
    "read": "api.records",
    "read_modes": "api.modes",
    "run": "api.results",
}
"""Public name to the module that defines it."""

__all__ = [
    "ContinuousTest",
    "Diagnosis",
    "EmaError",
    "Fit",
    "Frfs",
    "Ladder",
    "Modes",
    "Parameter",
    "Results",
    "Rig",
    "Test",
    "__version__",
    "diagnose",
    "fit",
    "identify",
    "load_rig",
    "open",
    "read",
    "read_modes",
    "run",
]


class _FrontDoor(ModuleType):
    """The package: its functions `fit` and `diagnose` are not replaced by the subpackages of the same name.

    Python binds a subpackage to its parent once it is imported; these two are imported from by their full names only.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _HOMES and isinstance(value, ModuleType)):
            super().__setattr__(name, value)

    def __getattr__(self, name: str) -> Any:
        if name not in _HOMES:
            raise AttributeError(f"module '{self.__name__}' has no attribute '{name}'")
        found = getattr(importlib.import_module(f"{self.__name__}.{_HOMES[name]}"), name)
        setattr(self, name, found)
        return found

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *_HOMES})


sys.modules[__name__].__class__ = _FrontDoor
