"""What both fuzzers share: a limit on memory, and what counts as a finding.

They need ``pip install "loam_gtsam[fuzz]"``, a folder for what they learn (``mkdir corpus_config``)
and a new start every few minutes, for the instrumentation loses memory with every exception.

A finding is an exception that is no :class:`LoamError`, a warning of numpy included. It does not
stop the run: its input goes to ``findings/``, one for every place in the code.
"""

from __future__ import annotations

import hashlib
import resource
import sys
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path

import atheris

from loam_gtsam.types import LoamError

FINDINGS = Path("findings")
_MEMORY = 3 << 30
"""Bytes of address space; the libraries alone take two thirds of it."""


def fuzz(target: Callable[[bytes], object]) -> None:
    """Run ``target`` on inputs until libFuzzer's own limits (``-max_total_time=...``) end it."""
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    warnings.simplefilter("error")
    seen: set[str] = set()

    def once(data: bytes) -> None:
        try:
            target(data)
        except LoamError:
            pass
        except Exception as error:
            where = traceback.extract_tb(error.__traceback__)
            place = " < ".join(f"{f.name}:{f.lineno}" for f in reversed(where) if f.lineno)
            name = hashlib.sha1(f"{type(error).__name__} {place}".encode()).hexdigest()[:12]
            if name not in seen:
                seen.add(name)
                FINDINGS.mkdir(exist_ok=True)
                (FINDINGS / name).write_bytes(data)
                (FINDINGS / f"{name}.txt").write_text(traceback.format_exc(), encoding="utf-8")

    if len(sys.argv) == 3 and sys.argv[1] == "--show":
        target(Path(sys.argv[2]).read_bytes())
        return
    atheris.Setup(sys.argv, once)
    atheris.Fuzz()
