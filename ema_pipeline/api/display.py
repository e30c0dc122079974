"""How results show themselves: as text where they are printed, as HTML in a notebook, on axes where they are drawn."""

from __future__ import annotations

import html
import io
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING

from ema_pipeline.api.arguments import expect
from ema_pipeline.plain_text import printable

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from rich.console import RenderableType

WIDTH = 100
"""Characters of a line of printed results."""


class Report(ABC):
    """A result that prints as a report and shows as HTML in a notebook."""

    @abstractmethod
    def _screen(self) -> RenderableType:
        """What is printed."""

    @abstractmethod
    def _headline(self) -> Sequence[str]:
        """Title, then one sentence a line, above the table in a notebook."""

    @abstractmethod
    def table(self) -> pd.DataFrame:
        """The result as a table."""

    def __repr__(self) -> str:
        from rich.console import Console

        text = io.StringIO()
        plain = Console(
            file=text,
            width=WIDTH,
            color_system=None,
            highlight=False,
            markup=False,
            emoji=False,
            force_jupyter=False,
        )
        plain.print(self._screen())
        # Names from files must not steer the terminal.
        return "\n".join(printable(line.rstrip()) for line in text.getvalue().splitlines())

    def _repr_html_(self) -> str:
        title, *lines = (html.escape(line) for line in self._headline())
        paragraphs = "".join(f"<p>{line}</p>" for line in lines)
        table = self.table().to_html(index=False, border=0, na_rep="", float_format="{:.5g}".format)
        return f"<h4>{title}</h4>{paragraphs}{table}"


def axes_or_new(ax: Axes | None, height_in: float = 3.2) -> Axes:
    """The axes given, or those of a new pyplot figure.

    Raises
    ------
    EmaError
        If what is given is no axes.
    """
    if ax is not None:
        from matplotlib.axes import Axes

        expect("ax", ax, Axes, "axes of Matplotlib, e.g. those of plt.subplots()")
        return ax
    from matplotlib import pyplot

    return pyplot.subplots(figsize=(7.2, height_in), layout="constrained")[1]
