"""Ctrl-C and SIGTERM on the command line: one line, status 130 or 143, no partial files.

Python's default handler raises an exception in the main thread. That is not enough. In a destructor
or a callback of the garbage collector or of C++ the exception is swallowed and the run continues;
during an import it becomes another error; and while the main thread compiles or computes in
C++, which takes minutes for a large network, it is not raised at all.

So nothing is raised. The handler removes temporary files and ends the process. Python calls it
between two steps of the main thread. If it is not called within `GRACE`, because the main thread is
in C++ or in a `defer_interrupts` block, a thread woken by the signal does the same.

Importing jaxbundle installs nothing: only the command line calls `handle_interrupts`.
"""

import os
import signal
import sys
import time

TYPE_CHECKING = False  # avoids importing typing
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import NoReturn

# Seconds for the main thread to handle a signal. It takes milliseconds unless it is in C++; short
# enough that nobody presses Ctrl-C again.
GRACE = 0.3

# Seconds to finish a block of `defer_interrupts`, the renaming of finished files: milliseconds,
# unless the disk hangs, which delays the exit no longer than this.
LONGEST_DEFERRAL = 10.0

WORDS: dict[int, str] = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
if hasattr(signal, "SIGHUP"):
    WORDS[signal.SIGHUP] = "the terminal is gone"
if hasattr(signal, "SIGBREAK"):  # Ctrl-Break of Windows
    WORDS[signal.SIGBREAK] = "interrupted"
# Windows writes signals to sockets only, other systems to pipes as well.
SOCKETS = os.name == "nt"

_advice = ""
_status = 1
# Standard error: after `handle_interrupts` a duplicate, because a raster writer silences the first.
_screen = 2
# A lock, and the module of temporary files, once imported.
_ending = _temporaries = None


def handle_interrupts() -> None:
    """End this process by the rules above from now on; ignored signals stay ignored (nohup).

    The process exits without finalising the interpreter, which takes up to a second with JAX,
    during which a signal would end it differently.
    """
    global _ending, _screen, _temporaries
    for number in WORDS:
        if signal.getsignal(number) in (signal.default_int_handler, signal.SIG_DFL):
            try:
                signal.signal(number, _handle)
            except ValueError:  # Only the main thread may.
                return
    # Only now: these imports take as long as the start of Python.
    import atexit
    import threading

    from jaxbundle.system import temporaries

    _ending = threading.RLock()
    _temporaries = temporaries
    _open_standard_streams()
    _screen = os.dup(2)
    atexit.register(_leave)  # the first to be registered is the last to be called
    read_byte, writer = _open_channel()
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(read_byte,), daemon=True).start()


def _open_channel() -> "tuple[Callable[[], bytes], int]":
    """What reads a byte, and the descriptor to which Python writes one at a signal. A full channel
    must not block the handler: one byte is enough."""
    if not SOCKETS:
        reader, writer = os.pipe()
        os.set_blocking(writer, False)
        return lambda: os.read(reader, 1), writer
    import socket

    reader_socket, writer_socket = socket.socketpair()
    writer_socket.setblocking(False)
    _open_sockets.append(writer_socket)
    return lambda: reader_socket.recv(1), writer_socket.fileno()


# Sockets that must stay open as long as the process.
_open_sockets: list[object] = []


def advise(words: str) -> None:
    """Set the message shown at an interrupt, on how to resume."""
    global _advice
    _advice = words


def set_status(status: int) -> None:
    """The exit status of the process, if nothing interrupts it any more."""
    global _status
    _status = status


def _handle(number: int, _frame: object) -> None:
    if _temporaries is None:  # Then nothing is.
        _say_and_exit(number)
    if not _temporaries.defer(lambda: _end(number)):
        _end(number)


def _watch(read_byte: "Callable[[], bytes]") -> None:
    """Wait for the byte that Python writes on a signal, independently of the main thread."""
    import threading

    number = 0
    while number not in WORDS:
        number = read_byte()[0]
    time.sleep(GRACE)
    # The disk does not answer.
    timer = threading.Timer(2 * LONGEST_DEFERRAL, _say_and_exit, (number,))
    timer.daemon = True
    timer.start()
    _end(number)


def _end(number: int) -> None:
    """Clean up, print the line, and end; a second thread waits here for the end."""
    if _ending is None or _temporaries is None:
        _say_and_exit(number)
    # Never released: whoever comes second waits here until the process is gone.
    _ending.acquire()
    _become_deaf()
    _temporaries.remove_temporaries(LONGEST_DEFERRAL)
    _say_and_exit(number)


def _become_deaf() -> None:
    """In the main thread, which runs the handlers: a second signal changes nothing.

    Not "ignore": Python reports pending signals that are then ignored.
    """
    try:
        for number in WORDS:
            if signal.getsignal(number) is _handle:
                signal.signal(number, lambda *_: None)
    except ValueError:
        pass  # another thread; the main thread would come to wait in `_end`


def _say_and_exit(number: int) -> "NoReturn":
    line = f"jaxbundle: {WORDS[number]}" + (_advice and f"; {_advice}") + "\n"
    try:
        if os.isatty(_screen):  # A progress bar may have hidden the cursor.
            line = "\r\x1b[2K\x1b[?25h" + line
        os.write(_screen, line.encode(errors="backslashreplace"))
    except OSError:
        pass  # Nobody listens.
    os._exit(128 + number)


def _leave() -> None:
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            pass  # Nobody reads.
    os._exit(_status)


def _open_standard_streams() -> None:
    """Open the null device for closed standard streams (`>&-`): otherwise the next opened file
    would get their number and receive messages for the user."""
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))
