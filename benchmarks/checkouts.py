"""Processes of two checkouts that work in turn, so that other load affects both equally."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

_Worker = TypeVar("_Worker")

#: Result of a turn: quantities by name.
Turn = dict[str, Any]


class CheckoutWorker:
    """Process that runs a script with the package of a checkout, and answers requests.

    Parameters
    ----------
    checkout : Path
        Root folder of the checkout.
    script : Path
    arguments : sequence of str
        Arguments of the script after ``--worker``.
    prefix : str
        Prefix of the lines with answers, because libraries also print.
    environment : dict
        Additional environment variables.
    """

    def __init__(
        self,
        checkout: Path,
        script: Path,
        arguments: Sequence[str],
        prefix: str,
        **environment: str,
    ) -> None:
        self._prefix = prefix
        self._process = subprocess.Popen(
            [sys.executable, str(script), "--worker", *arguments],
            cwd=checkout,
            env={
                **os.environ,
                "PYTHONPATH": str(checkout),
                "NAPARI_HMRF_COMPILE": "here",
                **environment,
            },
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._answer()

    def ask(self, request: Turn) -> Turn:
        """Send a request and return the answer."""
        assert self._process.stdin is not None
        print(json.dumps(request), file=self._process.stdin, flush=True)
        return self._answer()

    def end(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()

    def _answer(self) -> Turn:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith(self._prefix):
                told: Turn = json.loads(line.removeprefix(self._prefix))
                return told
        raise SystemExit(f"a worker ended without an answer: exit code {self._process.wait()}")


def answer(prefix: str, told: Turn) -> None:
    """Answer the request of the parent process."""
    print(prefix + json.dumps(told), flush=True)


def in_turn(
    workers: Sequence[_Worker], turns: int, work: Callable[[_Worker], Turn]
) -> list[list[Turn]]:
    """Return the results of each worker; the order of the workers alternates."""
    told: list[list[Turn]] = [[] for _ in workers]
    for number in range(turns):
        order = range(len(workers)) if number % 2 == 0 else reversed(range(len(workers)))
        for each in order:
            told[each].append(work(workers[each]))
    return told
