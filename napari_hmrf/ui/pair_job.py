"""Job of the window that compares the image with the second image, such as a registration."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, TypeVar

from psygnal import Signal

from napari_hmrf.layers.second_picture import second_picture
from napari_hmrf.registration.study_registration import SecondPicture
from napari_hmrf.study.session import Part, Session
from napari_hmrf.study.study import Study
from napari_hmrf.ui.controller import Controller
from napari_hmrf.ui.events import EventConnections
from napari_hmrf.ui.jobs import reason_of
from napari_hmrf.ui.registration_form import RegistrationForm

T = TypeVar("T")
#: Message after the registration of a slice was removed.
REMOVED = "The registration was removed; Undo restores it."
#: Description of a job in the messages of edits that wait for it.
_DOING = "a {} in 'Soft tissue' (press Cancel there to stop it)"


class PairJob(ABC):
    """Job on the compute thread that needs the current study and the second image.

    The footer shows its progress and cancels it. Edits during the job have their effect when it has
    ended.

    Parameters
    ----------
    controller : Controller
    session : Session
        Session that receives the result, as one undo step.
    """

    #: Name of the job, such as "registration", and its progress, such as "Registering".
    name: ClassVar[str]
    doing: ClassVar[str]
    #: Sentence before the reason why the job failed.
    failed: ClassVar[str]

    #: Emitted with a message about the job.
    message = Signal(str)

    def __init__(self, controller: Controller, session: Session) -> None:
        self._controller, self._session = controller, session
        self._second = controller.form.result.second
        self._form: RegistrationForm = controller.form.result.registration
        controller.form.footer.cancel.changed.connect(self.cancel)
        self._connections = EventConnections(
            (session.changed, self._on_changed),
            (controller.slice_changed, self._refresh),
            (self._second.changed, self._refresh),
        )
        self._refresh()

    @property
    def busy(self) -> bool:
        """True while the job is running."""
        return self._controller.jobs.busy(self.name)

    def cancel(self, *_: object) -> None:
        """Stop the job; nothing is changed."""
        if self.busy:
            self._controller.jobs.cancel(self.name)
            self._end(f"The {self.name} was cancelled; nothing was changed.")

    def release(self) -> None:
        """Disconnect from all events."""
        self._connections.release()

    @abstractmethod
    def _refresh(self, *_: Any) -> None:
        """Show whether the job is possible, and whether it is running."""

    @abstractmethod
    def _on_changed(self, part: Part, *_: Any) -> None:
        """Respond to a change of a part of the session."""

    def _read_pair(self) -> tuple[Study, SecondPicture] | None:
        """Return the current study and the second image on its grid.

        Returns
        -------
        (Study, SecondPicture) or None
            None if one of them is missing or invalid; the reason is shown.
        """
        second = self._second.value
        if second is None or not self._controller.refresh():
            return None
        study = self._controller.session.study
        assert study is not None
        place, shape = study.grid.known_place, study.grid.shape
        try:
            return study, second_picture(second, place, shape, self._controller.view)
        except Exception as error:  # noqa: BLE001 - a layer may raise anything
            self._controller.refuse(error)
            return None

    def _run(self, work: Callable[[], T], finish: Callable[[T], object]) -> None:
        """Run `work` on the compute thread, and call `finish` with its result."""
        self._controller.engine.cancel()
        show, doing = partial(self._finish, finish), _DOING.format(self.name)
        self._controller.jobs.submit(self.name, work, show, self._on_error, doing=doing)
        self._controller.progress.start(self.doing, at_once=True)
        self._refresh()

    def _finish(self, finish: Callable[[T], object], result: T) -> None:
        self._controller.progress.stop()
        finish(result)
        self._refresh()

    def _on_error(self, error: Exception) -> None:
        self._end(f"{self.failed} {reason_of(error)}")

    def _end(self, text: str) -> None:
        """Show the latest result and a message, in place of the progress."""
        self._controller.progress.stop()
        self._refresh()
        self._controller.show_again()
        self.message.emit(text)
