"""Keeping what belongs together together when Ctrl-C is pressed."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType


class Interrupts:
    """Holds back a KeyboardInterrupt while a block that belongs together runs: ``with interrupts: ...``.

    The signal's handler is set once, around all such blocks, by :meth:`watched`: setting it costs more than a step's
    worth of holding. Only the main thread receives interrupts; elsewhere, and under handlers that are not Python's, the
    blocks just run.
    """

    def __init__(self) -> None:
        self._handler: Callable[[int, FrameType | None], object] | None = None
        self._holding = False
        self._received: tuple[int, FrameType | None] | None = None

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Hear of interrupts for the length of a block, in which others can be held back."""
        handler = signal.getsignal(signal.SIGINT)
        if threading.current_thread() is not threading.main_thread() or not callable(handler):
            yield
            return
        self._handler = handler
        signal.signal(signal.SIGINT, self._receive)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, handler)
            self._handler = None

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self._received = (number, frame)
        if not self._holding:
            self._deliver()

    def _deliver(self) -> None:
        received, self._received = self._received, None
        if received is not None and self._handler is not None:
            self._handler(*received)

    def __enter__(self) -> None:
        self._holding = True

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._holding = False
        self._deliver()
