"""Reproduce one source, or write the page about all of them."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, get_args

from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.report.style import png
from ema_pipeline.reproduce.gearbox import reproduce_gearbox
from ema_pipeline.reproduce.isolator import reproduce_isolator
from ema_pipeline.reproduce.planetary import reproduce_planetary
from ema_pipeline.reproduce.text import markdown, terminal_text
from ema_pipeline.reproduce.types import Reproduction
from ema_pipeline.threads import single_blas_thread

Which = Literal["planetary", "gearbox", "isolator"]
NAMES: tuple[Which, ...] = get_args(Which)
_MAKERS = {
    "planetary": reproduce_planetary,
    "gearbox": reproduce_gearbox,
    "isolator": reproduce_isolator,
}
PAGE = """# What the sources print, and what comes out here

This program began with three published tests. Every number and curve below was computed by it
(`ema reproduce`) and is shown beside the printed one. Where the two differ, the last column gives the reason,
if it is known.

"""


def reproduce(which: str, out: Path | None = None) -> Reproduction:
    """Compute the tables and figures of one source.

    Parameters
    ----------
    which : {"planetary", "gearbox", "isolator"}
    out : Path, optional
        Folder for ``<which>.txt`` and the figures as PNG; nothing is written where left out.

    Raises
    ------
    EmaError
        For an unknown name, or a folder that cannot be written.
    """
    if which not in _MAKERS:
        raise EmaError(f"nothing to reproduce for '{which}'{did_you_mean(which, _MAKERS)}")
    with single_blas_thread():
        result = _MAKERS[which]()
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
            (out / f"{which}.txt").write_text(terminal_text(result), encoding="utf-8")
            write_figures(result, out)
        except OSError as error:
            raise EmaError(f"{out}: cannot be written ({error.strerror}); name another folder") from None
    return result


def write_figures(result: Reproduction, folder: Path) -> None:
    """All figures as PNG."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in result.figures.items():
        (folder / f"{name}.png").write_bytes(png(figure))


def write_page(docs: Path) -> None:
    """Write ``seeds.md`` and ``figures/*.png`` of all sources into `docs`."""
    parts = [PAGE]
    for name in NAMES:
        result = reproduce(name)
        write_figures(result, docs / "figures")
        parts.append(markdown(result))
    (docs / "seeds.md").write_text("\n".join(parts).rstrip() + "\n", encoding="utf-8")
