"""SIGINT and SIGTERM end every program of armwright with exit status 130 and without a traceback, at any moment.

While a program starts, and when its work is done, nothing moves and nothing is open: it ends where it is. While a command
works, they raise KeyboardInterrupt, which closes what it has opened. A child process is started with both signals blocked:
Python by itself would answer them with a traceback until the child's first line.
"""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType

NUMBERS = (signal.SIGINT, signal.SIGTERM)
STATUS = 130
_AGAIN_S = 0.02


def run_command() -> int:
    """The command `armwright`: a sentence and exit status 2 where another package is in the way.

    It stands here, as the handlers come first: whatever is imported before them, an interrupt would answer with a traceback.
    """
    try:
        end_at_once("armwright")
        import importlib

        from firmware_iface import installation

        installation.claim()
    except KeyboardInterrupt:  # Python's own handler was still in force
        sys.stderr.write("armwright: interrupted\n")
        return STATUS
    except ImportError as error:
        sys.stderr.write(f"armwright: {error}\n")
        return 2
    status: int = importlib.import_module("console.main").main()
    return status


def end_at_once(name: str = "") -> None:
    """From now on they end this process, with one line on standard error if the program has a `name`."""

    def end(number: int, frame: FrameType | None) -> None:
        with contextlib.suppress(Exception):  # what was said is not lost, if this is no moment within the saying
            sys.stdout.flush()
        with contextlib.suppress(OSError):
            os.write(2, f"{name}: interrupted\n".encode() if name else b"")
        os._exit(STATUS)

    for number in NUMBERS:  # even if a script's background job or nohup ignored them
        signal.signal(number, end)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, NUMBERS)
    sys.unraisablehook = _unraisable


@contextlib.contextmanager
def heard() -> Iterator[None]:
    """They raise KeyboardInterrupt within the block, at its end at the latest; then they do what they did before."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, _interrupt) for number in NUMBERS}
    try:
        yield
    finally:
        with held():
            for number, handler in before.items():
                signal.signal(number, handler)
            # Later it would be lost, or kill a program that ends without a word: Python leaves SIGALRM at its default then.
            is_to_come = signal.setitimer(signal.ITIMER_REAL, 0.0)[0] > 0.0
        if is_to_come:
            raise KeyboardInterrupt


@contextlib.contextmanager
def held() -> Iterator[None]:
    """Deliver them at the end of the block. A process that is started within begins with them blocked, until `end_at_once`."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, NUMBERS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _interrupt(number: int, frame: FrameType | None) -> None:
    """KeyboardInterrupt, but not within an import: a compiled module turns it into an ImportError, or half works."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return _again(number)
        frame = frame.f_back
    raise KeyboardInterrupt


def _again(number: int) -> None:
    """Send the signal once more in a moment."""
    signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(number))
    signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)


def _unraisable(lost: "sys.UnraisableHookArgs") -> None:
    """An interrupt that fell into a destructor, where no exception leads out, is sent once more."""
    if issubclass(lost.exc_type, KeyboardInterrupt):
        _again(signal.SIGINT)
    else:
        sys.__unraisablehook__(lost)


_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def signal_on_death_of(parent: int, number: signal.Signals) -> Callable[[], None]:
    """What the child has to call: it then gets signal `number` when the thread of `parent` that started it ends.

    Elsewhere than on Linux only if the parent is dead already.
    """
    import ctypes  # and the library loaded here: neither is safe after a fork, and most programs start no child

    libc = ctypes.CDLL(None) if sys.platform == "linux" else None

    def in_child() -> None:
        if libc is not None:
            libc.prctl(_PR_SET_PDEATHSIG, number)
        if os.getppid() != parent:  # it died before the request
            os.kill(os.getpid(), number)

    return in_child


def ends_with_parent(number: signal.Signals) -> Callable[[], None]:
    """A `preexec_fn` for a `command`: no signal is ignored, and the child gets signal `number` when this process dies.

    A script's background job starts with SIGINT ignored, nohup's with SIGHUP, and exec inherits that: a child would ignore the
    signal that should end it. SIGINT and SIGTERM wait until the child hears them.
    """
    hear_death = signal_on_death_of(os.getpid(), number)

    def before_exec() -> None:
        for handled in (*NUMBERS, signal.SIGHUP):
            signal.signal(handled, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_SETMASK, NUMBERS)
        hear_death()

    return before_exec
