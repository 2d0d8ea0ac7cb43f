"""``python -m mgpo_jax COMMAND FLAGS`` is the console script ``mgpo``, in any folder.

``python -m experiments.COMMAND`` is for a clone: a folder named ``experiments`` in the current one comes
before ours. Here the current folder is searched last.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path


def main() -> None:
    """Run the command that the first word of the command line names."""
    root = str(Path(__file__).parent.parent)
    if sys.path and sys.path[0] in ("", os.getcwd()) and os.getcwd() != root:
        sys.path[0] = root
        sys.path.append(os.getcwd())
    from experiments.__main__ import main as run

    run()


if __name__ == "__main__":
    main()
