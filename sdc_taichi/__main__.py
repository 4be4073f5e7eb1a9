"""The program ``sdc-taichi``, which is ``python -m sdc_taichi`` as well."""

import os
import signal


def main() -> None:
    """Run the command line of this process, and exit."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        # Commands take a good part of a second to import, during which an exception may be lost
        # or replaced by another. 130 is the exit code of a program that Ctrl-C ended.
        signal.signal(signal.SIGINT, lambda *_: os._exit(130))
        from sdc_taichi.cli import app

        signal.signal(signal.SIGINT, signal.default_int_handler)
    else:  # a shell's background job, which ignores Ctrl-C
        from sdc_taichi.cli import app
    app.main()


if __name__ == "__main__":
    main()
