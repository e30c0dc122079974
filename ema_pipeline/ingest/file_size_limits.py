"""How large a record file may be: checked before anything is read, so that no file can fill the memory."""

from __future__ import annotations

from pydantic import Field

from ema_pipeline.errors import EmaError
from ema_pipeline.settings import Settings

SMALL_MB = 64.0
"""What a packed file may always unpack to: quiet channels pack a hundredfold, and this much hurts nobody."""


class ReadLimits(Settings):
    """Limits of what is read from a record file."""

    largest_mb: float = Field(
        default=4000.0, gt=0, description="Largest record file, and the most that it may unpack to, MB"
    )
    largest_text_mb: float = Field(
        default=500.0,
        gt=0,
        description="Largest record file of text, MB; text takes several times as much to read",
    )
    unpack_ratio: float = Field(
        default=20.0,
        ge=1,
        description=f"A packed file may unpack to this many times its own size, and {SMALL_MB:g} MB in any case",
    )
    most_channels: int = Field(
        default=5000, ge=1, description="Most channels, datasets or variables of one record file"
    )

    def check_file(self, size_bytes: int, text: bool = False) -> None:
        """Refuse a file that is too large.

        Raises
        ------
        EmaError
        """
        name = "largest_text_mb" if text else "largest_mb"
        limit = min(self.largest_mb, self.largest_text_mb) if text else self.largest_mb
        if size_bytes > limit * 1e6:
            raise EmaError(
                f"has {size_bytes / 1e6:.4g} MB, of which at most {limit:g} MB are read; cut it, "
                f"or allow more with --set ingest.{name}={size_bytes / 1e6:.0f}"
            )

    def unpacked_bytes(self, file_bytes: int) -> int:
        """The most that a file of this size may unpack to."""
        return int(min(self.largest_mb, max(SMALL_MB, self.unpack_ratio * file_bytes / 1e6)) * 1e6)

    def check_unpacked(self, unpacked_bytes: int, file_bytes: int, what: str) -> None:
        """Refuse content that is out of proportion to the file that holds it.

        Raises
        ------
        EmaError
        """
        if unpacked_bytes > self.unpacked_bytes(file_bytes):
            raise EmaError(
                f"{what} would take {unpacked_bytes / 1e6:.4g} MB from a file of {file_bytes / 1e6:.4g} MB: it is "
                "damaged or a trap; export it again, or allow it with --set ingest.unpack_ratio and ingest.largest_mb"
            )

    def check_channels(self, count: int) -> None:
        """Refuse a file with more channels than anybody measures.

        Raises
        ------
        EmaError
        """
        if count > self.most_channels:
            raise EmaError(
                f"holds {count} channels or datasets, of which at most {self.most_channels} are read; "
                f"export what was measured, or allow them with --set ingest.most_channels={count}"
            )
