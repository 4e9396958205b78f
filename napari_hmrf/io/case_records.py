"""Records of the inputs and outcomes of solved cases."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pydantic

from napari_hmrf.io.case_tables import NamedCase

#: Name of the file in a case's folder that stores the table row, digests and outcome of the case.
RECORD = "case.json"
#: Largest number of names listed in a message.
_LISTED = 5


@dataclass(frozen=True)
class CaseOutcome:
    """Outcome of a case in a batch.

    Attributes
    ----------
    case : str
        Name of the case.
    state : {"done", "failed", "not done"}
    error : str
        Error message, if the case failed.
    notes : str
        Assumptions made when reading the files, and shortcomings of the field.
    seconds : float
        Run time of the case, including reading and writing files, in seconds.
    folds : int
        Number of pixels at which the tissue folds over itself, which is physically impossible.
    error_bound : float, optional
        Estimated bound on the error of the field, in pixels; None if the model provides no
        estimate.
    largest_displacement : float, optional
        Largest magnitude of the displacement, in `unit`.
    unit : str
        Unit of length of the image.
    """

    case: str
    state: Literal["done", "failed", "not done"] = "not done"
    error: str = ""
    notes: str = ""
    seconds: float = 0.0
    folds: int = 0
    error_bound: float | None = None
    largest_displacement: float | None = None
    unit: str = ""


class CaseRecord(pydantic.BaseModel):
    """Content of the record file of a case.

    Attributes
    ----------
    cells : dict of str to str
        Cells of the table row, by column title.
    outcome : CaseOutcome
    inputs : dict of str to str
        Digests of the input files.
    outputs : dict of str to str
        Digests of the output files.
    """

    cells: dict[str, str]
    outcome: CaseOutcome
    inputs: dict[str, str]
    outputs: dict[str, str]


def record_in(folder: Path) -> CaseRecord | None:
    """Return the record in a folder, or None if there is no valid record."""
    try:
        return CaseRecord.model_validate_json((folder / RECORD).read_bytes())
    except (OSError, pydantic.ValidationError):
        return None


def finished_cases(
    cases: Sequence[NamedCase], folder: Path
) -> tuple[dict[str, CaseOutcome], list[str]]:
    """Return the outcomes of solved cases, and messages about cases to solve again.

    A case is solved again if its table row, its input files or its output files have changed.
    """
    outcomes: dict[str, CaseOutcome] = {}
    repeated: dict[str, list[str]] = {}
    digests: dict[Path, str] = {}
    for case in cases:
        record = record_in(folder / case.name)
        if record is None:
            continue
        if record.cells != dict(case.cells):
            reason = "the line in the table has changed"
        elif record.inputs != fingerprints(case, digests):
            reason = "input files have changed"
        elif not _is_intact(folder / case.name, record):
            reason = "files of the result are damaged or missing"
        else:
            outcomes[case.name] = record.outcome
            continue
        repeated.setdefault(reason, []).append(case.name)
    return outcomes, [
        f"solved again, because {reason}: {_listed(names)}" for reason, names in repeated.items()
    ]


def output_digests(folder: Path) -> dict[str, str]:
    """Return a digest of each file in the folder of a case, except the record, by file name."""
    paths = sorted(path for path in folder.iterdir() if path.name != RECORD)
    return {path.name: _digest(path) for path in paths}


def _is_intact(folder: Path, record: CaseRecord) -> bool:
    """Return whether the result in a folder is unchanged."""
    return all(_digest(folder / name) == digest for name, digest in record.outputs.items())


def leftovers(cases: Sequence[NamedCase], folder: Path) -> list[str]:
    """Return messages about folders of cases that are no longer in the table."""
    named = {case.name.casefold() for case in cases}
    others = [
        path.parent.name
        for path in sorted(folder.glob(f"*/{RECORD}"))
        if path.parent.name.casefold() not in named and record_in(path.parent) is not None
    ]
    if not others:
        return []
    return [f"ignored, because no case in the table has this name: {_listed(others)}"]


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return f"{', '.join(names[:_LISTED])}{more}"


def fingerprints(case: NamedCase, known: dict[Path, str] | None = None) -> dict[str, str]:
    """Return a digest of each input file of a case ("" for an unreadable file).

    Parameters
    ----------
    case : NamedCase
    known : dict of Path to str, optional
        Cache of digests, to which the digests of the case are added.
    """
    digests = {} if known is None else known
    for path in case.inputs:
        if path not in digests:
            digests[path] = _digest(path)
    return {f"{number} {path.name}": digests[path] for number, path in enumerate(case.inputs)}


def _digest(path: Path) -> str:
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    total = hashlib.sha256()
    try:
        for each in files:
            if each.is_file():
                with open(each, "rb") as file:
                    total.update(hashlib.file_digest(file, "sha256").digest())
            elif each is path:
                return ""
    except OSError:
        return ""
    return total.hexdigest()
