"""The program ``sdc-taichi``, outside of the package, whose import takes a good part of a second.

It makes sure that Ctrl-C, closed streams and short memory end the program properly from its very
beginning. What the commands do is in ``sdc_taichi.cli``.
"""

import os
import signal
import sys

EXIT_FAILURE, EXIT_INTERRUPTED = 1, 130


def main() -> None:
    """Run the command line of this process, and exit."""
    _open_closed_streams()
    ends_on_interrupt = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if ends_on_interrupt:
        # Nothing has been begun. An exception may be lost or turned into another within an import.
        signal.signal(signal.SIGINT, lambda *_: os._exit(EXIT_INTERRUPTED))
    try:
        from sdc_taichi.cli import app
    except Exception as error:
        reason = " ".join(str(error).split())[:300]
        sys.stderr.write(f"error: sdc_taichi cannot be loaded: {type(error).__name__}: {reason}\n")
        sys.exit(EXIT_FAILURE)
    if ends_on_interrupt:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        app.main()
    finally:
        if ends_on_interrupt:
            # The interpreter gives its signals back to the system before it ends, which would then
            # end a command that is done as one that was interrupted.
            signal.signal(signal.SIGINT, signal.SIG_IGN)


def _open_closed_streams() -> None:
    """Give the standard streams that are closed to the null device.

    Otherwise the next file that is opened takes their place, and gets what is printed.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
        if getattr(sys, name) is None:
            mode = "w" if number else "r"
            setattr(sys, name, open(number, mode, encoding="utf-8", closefd=False))  # noqa: SIM115


if __name__ == "__main__":
    main()
