"""The console script ``mgpo``: ``mgpo adapt FLAGS`` is ``python -m experiments.adapt FLAGS``."""

from __future__ import annotations

import importlib
import sys
from importlib.metadata import version

from envs.errors import nearest
from experiments.runtime import PRINT_COMPLETION

COMMANDS = {
    "list": "list the worlds, methods and networks, and what each needs",
    "info": "show what is installed, and on which devices",
    "collect": "collect a dataset of demonstrations",
    "data": "import, export, check and describe datasets of your own logs",
    "pretrain": "pre-train a policy",
    "adapt": "adapt a policy to unseen tasks",
    "evaluate": "evaluate optimized prompts once more, under noise or in another world",
    "check": "check a world of your own, or compare a world with its official implementation",
    "table": "compare adaptations in one table",
    "compare": "compare adaptations to the same tasks pair by pair, with intervals",
    "plot": "draw figures of adaptations",
    "report": "show adaptations in one HTML page, down to every episode",
    "playground": "make an HTML page in which anyone guides a policy by clicking goals",
    "export": "write a policy as ONNX models, which run without jax",
    "reproduce": "make tables and figures of the paper",
    "release": "package a pre-training run as a released policy",
    "bench": "measure speed in CPU time",
    "completion": "print a script that lets a shell complete these words",
}


def main() -> None:
    """Run the command that the first word of the command line names."""
    words = sys.argv[1:]
    if not words or words[0] in ("-h", "--help"):
        print("usage: mgpo COMMAND [FLAGS]; `mgpo COMMAND --help` shows the flags\n")
        print("\n".join(f"  {name:<10} {text}" for name, text in COMMANDS.items()))
        sys.exit(0)
    if words[0] == "--version":
        print(f"mgpo {version('mgpo-jax')}")
        sys.exit(0)
    if words[0] == PRINT_COMPLETION:
        words[0] = "completion"
    if words[0] not in COMMANDS:
        print(f"error: {nearest(words[0], COMMANDS, 'command')}", file=sys.stderr)
        sys.exit(2)
    importlib.import_module(f"experiments.{words[0]}").command(words[1:])


if __name__ == "__main__":
    main()
