"""The command line for as long as another process lives: ``python -m diransac.cli.attached FD WORDS``.

``FD`` is the end of a pipe whose other end that process alone holds.
"""

from __future__ import annotations

import os
import signal
import sys
import threading

from diransac.cli import main


def _end_with_the_other(channel: int) -> None:
    """End this group of processes once nobody can write to a pipe any more."""
    os.read(channel, 1)
    os.killpg(0, signal.SIGKILL)


if __name__ == "__main__":
    threading.Thread(target=_end_with_the_other, args=(int(sys.argv.pop(1)),), daemon=True).start()
    main()
