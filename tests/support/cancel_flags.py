"""Cancel flags that are set on the way."""

from napari_hmrf.solver.backends.thread import compute_thread


class During:
    """Set while the work says that it is at some stage, before anybody else is told."""

    def __init__(self, words: str) -> None:
        self._words = words

    def is_set(self) -> bool:
        return self._words in compute_thread.stage


class AfterLooks:
    """Set once it has been looked at so many times."""

    def __init__(self, looks: int) -> None:
        self.left = looks

    def is_set(self) -> bool:
        self.left -= 1
        return self.left < 0
