"""``python -m mgpo_jax COMMAND FLAGS`` does the same as the console script ``mgpo``, from any folder.

``python -m experiments.COMMAND`` works only in a clone: elsewhere a folder named ``experiments`` in the
current directory would be found before this project's. Here the current directory is searched last.
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
