"""Ctrl-C waits for what belongs together, and for nothing else."""

import os
import signal
import threading

import pytest

from sb3_skillgraph.interrupts import Interrupts


def press() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def test_it_waits_for_the_end_of_a_block() -> None:
    interrupts, done = Interrupts(), []
    with pytest.raises(KeyboardInterrupt), interrupts.watched():
        with interrupts:
            press()
            press()
            done.append("all")
        done.append("never")  # the interrupt comes before
    assert done == ["all"]


def test_it_comes_at_once_outside_of_blocks() -> None:
    interrupts, done = Interrupts(), []
    with pytest.raises(KeyboardInterrupt), interrupts.watched():
        with interrupts:
            done.append("one")
        press()
        done.append("never")
    assert done == ["one"]


def test_the_handler_is_put_back_and_what_was_held_back_is_not_heard_twice() -> None:
    before = signal.getsignal(signal.SIGINT)
    interrupts, heard = Interrupts(), []
    signal.signal(signal.SIGINT, lambda number, frame: heard.append(number))
    try:
        with interrupts.watched():
            with interrupts:
                press()
            with interrupts:
                pass
        assert heard == [signal.SIGINT]
        press()
        assert heard == [signal.SIGINT] * 2
    finally:
        signal.signal(signal.SIGINT, before)


def test_an_error_in_a_block_is_not_hidden() -> None:
    interrupts = Interrupts()
    with pytest.raises(ValueError, match="broken"), interrupts.watched(), interrupts:
        raise ValueError("broken")


def test_other_threads_just_run() -> None:
    interrupts, done = Interrupts(), []

    def work() -> None:
        with interrupts.watched(), interrupts:
            done.append("all")

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert done == ["all"]
