"""Entry point of the program ``sdc-taichi``, which ``python -m sdc_taichi`` also starts."""

import os
import signal


def main() -> None:
    """Run the command that this process was started with, and exit."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        # During imports, which take a good part of a second, a KeyboardInterrupt may be lost or
        # replaced by another exception, so Ctrl-C ends the process directly. Its exit code 130 is
        # the usual one after Ctrl-C.
        signal.signal(signal.SIGINT, lambda *_: os._exit(130))
        from sdc_taichi.cli import app

        signal.signal(signal.SIGINT, signal.default_int_handler)
    else:  # a background job of a shell, which ignores Ctrl-C
        from sdc_taichi.cli import app
    app.main()


if __name__ == "__main__":
    main()
