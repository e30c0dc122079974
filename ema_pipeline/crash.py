"""Crash reports: what the developers need of an error that is the program's own fault."""

from __future__ import annotations

import os
import platform
import sys
import tempfile
import time
import traceback

from ema_pipeline import __version__

_PACKAGES = ("numpy", "scipy", "h5py", "pandas", "pydantic", "rich", "typer")


def write_crash_report(error: BaseException) -> str | None:
    """Write what happened into a new file that only the user can read.

    Parameters
    ----------
    error : BaseException
        With its traceback.

    Returns
    -------
    str or None
        Path of the file; None where it could not be written.
    """
    try:
        handle, path = tempfile.mkstemp(prefix=time.strftime("ema-crash-%Y%m%d-%H%M%S-"), suffix=".txt")
        with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
            file.write(_report(error))
    except OSError:
        return None
    return path


def _report(error: BaseException) -> str:
    modules = {name: getattr(sys.modules.get(name), "__version__", "not loaded") for name in _PACKAGES}
    facts = {
        "time": time.strftime("%Y-%m-%d %H:%M:%S %z"),
        "ema": __version__,
        "Python": f"{platform.python_version()} on {platform.platform()}",
        "packages": ", ".join(f"{name} {version}" for name, version in modules.items()),
        "command": " ".join(sys.argv),
        "folder": os.getcwd(),
    }
    lines = [f"{name}: {value}" for name, value in facts.items()]
    return "\n".join(lines) + "\n\n" + "".join(traceback.format_exception(error))
