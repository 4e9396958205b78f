"""Processes of two checkouts that work in turn, so that other load affects both equally."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from benchmarks.clock import now, since

ROOT = Path(__file__).resolve().parent.parent
#: Result of a turn: quantities by name.
Turn = dict[str, Any]
# Prefix of the lines with answers, because libraries also print.
_ANSWER = "answer: "
# Program of a worker. Benchmarks and problems are those of this checkout, also where the other one
# has folders of the same names.
_WORKER = """
import importlib, sys
import benchmarks, validation
root, name, *arguments = sys.argv[1:]
for package in (benchmarks, validation):
    package.__path__ = [f"{root}/{package.__name__}"]
importlib.import_module(name).work(*arguments)
"""


class CheckoutWorker:
    """Process that runs a benchmark with the package of a checkout, and answers requests.

    Parameters
    ----------
    checkout : Path
        Root folder of the checkout.
    name : str
        Module of this checkout whose function `work` is run, whatever the checkout.
    arguments : sequence of str
        Arguments of this function.

    Attributes
    ----------
    ready : dict
        First answer of the process, after its preparation.
    """

    def __init__(self, checkout: Path, name: str, arguments: Sequence[str]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", _WORKER, str(ROOT), name, *arguments],
            cwd=checkout,
            env={
                **os.environ,
                "PYTHONPATH": os.pathsep.join([str(checkout), str(ROOT)]),
                "NAPARI_HMRF_COMPILE": "here",
            },
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.ready = self._answer()

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
            if line.startswith(_ANSWER):
                found: Turn = json.loads(line.removeprefix(_ANSWER))
                return found
        raise RuntimeError(f"a worker ended without an answer: exit code {self._process.wait()}")


def serve(ready: Turn, turn: Callable[[Turn], Turn]) -> None:
    """Answer the requests of the parent process, in a worker."""
    print(_ANSWER + json.dumps(ready), flush=True)
    for line in sys.stdin:
        print(_ANSWER + json.dumps(turn(json.loads(line))), flush=True)


def start_workers(
    name: str, arguments: Sequence[str], against: Path | None
) -> list[CheckoutWorker]:
    """Start a worker of this checkout, or workers of this one, of another one, and of this again.

    The third worker is the control: its ratio to the first shows the error of a comparison.
    """
    checkouts = [ROOT] if against is None else [ROOT, against, ROOT]
    workers: list[CheckoutWorker] = []
    try:
        for checkout in checkouts:
            workers.append(CheckoutWorker(checkout, name, arguments))
    except RuntimeError:
        for worker in workers:
            worker.end()
        raise
    return workers


def in_turn(
    workers: Sequence[CheckoutWorker], request: Turn, turns: int, seconds: float
) -> list[list[Turn]]:
    """Return the answers of each worker; the order of the workers alternates.

    At least three turns are taken, and no further turn after a number of `seconds`.
    """
    answers: list[list[Turn]] = [[] for _ in workers]
    begun = now()
    for number in range(turns):
        if number >= 3 and since(begun).wall > seconds:
            break
        order = range(len(workers)) if number % 2 == 0 else reversed(range(len(workers)))
        for index in order:
            answers[index].append(workers[index].ask(request))
    return answers


class Ratio(NamedTuple):
    """Geometric mean of paired ratios, and its 95 % confidence interval."""

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        """Return the ratio as text."""
        return f"{self.mean:.2f} ({self.low:.2f} to {self.high:.2f})"


def ratio(ours: Sequence[float], others: Sequence[float]) -> Ratio:
    """Return the mean ratio of paired values."""
    logs = np.log(ours) - np.log(others)
    mean = float(logs.mean())
    low, high = stats.t.interval(0.95, len(logs) - 1, mean, stats.sem(logs) + 1e-12)
    return Ratio(*(float(value) for value in np.exp([mean, low, high])))


def checkout(path: str) -> Path:
    """Return the root folder of another checkout, as the type of a command-line argument."""
    folder = Path(path).resolve()
    if not (folder / "napari_hmrf").is_dir():
        raise argparse.ArgumentTypeError(f"{path} is not a checkout of this repository")
    return folder
