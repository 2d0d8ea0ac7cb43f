"""Commands, their results on disk, and figures."""

from __future__ import annotations

import os
import signal
import sys
import threading
from pathlib import Path


def _prefer_this_project() -> None:
    """Search the current folder last, so that nothing in it shadows our packages.

    ``python -m`` puts the current folder first.
    """
    root = str(Path(__file__).parent.parent)
    here = os.getcwd()
    if root != here and sys.path and sys.path[0] in ("", here):
        sys.path[0] = root
        sys.path.append(here)


def _leave_quietly() -> None:
    """Let Ctrl-C end a command at once and without a traceback while its modules are being imported.

    A KeyboardInterrupt in the middle of an import can be swallowed, or crash the interpreter.
    """
    started = Path(sys.argv[0]) if sys.argv else Path()
    # argv[0] is "-m" until ``python -m`` finds the module.
    as_command = started.name in ("-m", "mgpo") or started.parts[-2:] == ("mgpo_jax", "__main__.py")
    ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    if as_command and not ignored and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, lambda number, frame: os._exit(128 + number))


_prefer_this_project()
_leave_quietly()
