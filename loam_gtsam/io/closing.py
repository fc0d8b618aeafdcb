"""What is written while a run goes on, and closed when its block is left."""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import nullcontext, suppress
from types import TracebackType
from typing import Self

from loam_gtsam.types import OutputError


class ClosedByBlock(ABC):
    """A context manager that closes itself, after an error or Ctrl-C too."""

    @abstractmethod
    def close(self) -> None:
        """Finish what was written."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        # What ended the block matters more than what closing says on a full disk.
        with nullcontext() if kind is None else suppress(OutputError):
            self.close()
