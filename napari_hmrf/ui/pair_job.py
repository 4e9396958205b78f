"""Job of the window that compares the image with the second image, such as a registration."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

from psygnal import Signal

from napari_hmrf.layers.second_picture import second_picture
from napari_hmrf.registration.study_registration import SecondPicture
from napari_hmrf.study.study import Study
from napari_hmrf.ui.controller import Controller
from napari_hmrf.ui.jobs import BackgroundJobs

T = TypeVar("T")


class JobWords(NamedTuple):
    """Words of the window about a job.

    Attributes
    ----------
    doing : str
        Word for the progress, such as "Registering".
    cancelled, failed : str
        Sentences that end the job; the reason follows `failed`.
    """

    doing: str
    cancelled: str
    failed: str


class PairJob:
    """Job on the compute thread that needs the current study and the second image.

    The footer shows its progress and cancels it. Edits during the job have their effect when it has
    ended.

    Parameters
    ----------
    controller : Controller
    words : JobWords
    on_end : callable
        Called with a message after the job was cancelled, has failed, or was ended by `end`.
    """

    #: Emitted with a message about the job.
    message = Signal(str)

    def __init__(
        self, controller: Controller, words: JobWords, on_end: Callable[[str], object]
    ) -> None:
        self._controller, self._words, self._on_end = controller, words, on_end
        self._jobs = BackgroundJobs(lambda reason: self.end(f"{words.failed} {reason}"))
        # Flag that cancels the current job.
        self._cancel = threading.Event()
        controller.form.footer.cancel.changed.connect(self.cancel)

    @property
    def busy(self) -> bool:
        """True while the job is running."""
        return self._jobs.busy()

    def read_pair(self) -> tuple[Study, SecondPicture] | None:
        """Return the current study and the second image on its grid.

        Returns
        -------
        (Study, SecondPicture) or None
            None if one of them is missing or invalid; the reason is shown.
        """
        form = self._controller.form
        second = form.result.second.value
        if second is None or not self._controller.refresh():
            return None
        study = self._controller.session.study
        assert study is not None
        try:
            picture = second_picture(
                second, study.grid.known_place, study.grid.shape, self._controller.view
            )
        except Exception as error:  # noqa: BLE001 - a layer may raise anything
            self._controller.refuse(error)
            return None
        return study, picture

    def start(self, work: Callable[[threading.Event], T], finish: Callable[[T], object]) -> None:
        """Run `work` with a flag that cancels it, and call `finish` with its result."""
        self._cancel = threading.Event()
        self._controller.engine.cancel()
        self._jobs.submit("job", partial(work, self._cancel), partial(self._finish, finish))
        self._controller.progress.start(self._words.doing, at_once=True)

    def cancel(self, *_: object) -> None:
        """Stop the job; nothing is changed."""
        if self.busy:
            self._cancel.set()
            self._jobs.cancel()
            self.end(self._words.cancelled)

    def end(self, text: str) -> None:
        """Show the latest result and a message, in place of the progress."""
        self._controller.progress.stop()
        self._on_end(text)
        self._controller.show_again()
        if text:
            self.message.emit(text)

    def release(self) -> None:
        """Stop the job without a message."""
        self._cancel.set()
        self._jobs.release()

    def _finish(self, finish: Callable[[T], object], result: T) -> None:
        self._controller.progress.stop()
        finish(result)
