"""Cancel flags that are set during a solve."""

from napari_hmrf.compute.thread import compute_thread


class During:
    """Flag that is set while the compute thread reports a given stage."""

    def __init__(self, words: str) -> None:
        self._words = words

    def is_set(self) -> bool:
        return self._words in compute_thread.stage


class AfterLooks:
    """Flag that is set after a given number of checks."""

    def __init__(self, looks: int) -> None:
        self.left = looks

    def is_set(self) -> bool:
        self.left -= 1
        return self.left < 0
