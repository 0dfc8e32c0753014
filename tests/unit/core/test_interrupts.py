"""Ctrl-C while a command prepares."""

import signal

import pytest

from wm_nodes.core.interrupts import remembering_interrupts


def test_an_interrupt_that_was_lost_is_raised_at_the_next_check_and_not_later() -> None:
    before = signal.getsignal(signal.SIGINT)
    with remembering_interrupts() as check:
        check()
        with pytest.raises(KeyboardInterrupt):  # whatever is in between swallows it
            signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            check()
    assert signal.getsignal(signal.SIGINT) is before


def test_whoever_ignores_ctrl_c_goes_on_ignoring_it() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with remembering_interrupts() as check:
            signal.raise_signal(signal.SIGINT)
            check()
    finally:
        signal.signal(signal.SIGINT, before)


def importing_in_c() -> None:
    """As `import torch`, in which a KeyboardInterrupt becomes another error."""
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        raise TypeError("expected a message argument") from None


def test_an_interrupt_that_became_another_error_is_one_and_an_error_stays_one() -> None:
    with pytest.raises(KeyboardInterrupt), remembering_interrupts():
        importing_in_c()
    with pytest.raises(TypeError), remembering_interrupts():
        raise TypeError("of its own")
