"""Python's garbage collector, which would look for garbage where there is none."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def paused() -> Iterator[None]:
    """Collect nothing meanwhile; all that is alive at the end counts as old.

    What imports and the translation of kernels make is kept. The collector would go through all of
    it several times while it is young, for a twentieth of a start.
    """
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            if not gc.get_freeze_count():  # Nobody else holds objects back.
                gc.freeze()
                gc.unfreeze()
            gc.enable()
