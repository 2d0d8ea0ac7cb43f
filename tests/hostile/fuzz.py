"""The fuzz suite as a program.

    PYTHONPATH=tests python -m hostile.fuzz --cases 5000 --seed 0 --report report.md

Runs cases of ``grammar.py`` one after another, and writes a report with counts of their outcomes and the
smallest example of each kind of failure. ``--first 17 --cases 1`` repeats case 17 and prints all of it.
"""

from __future__ import annotations

import argparse
import faulthandler
import json
import os
import re
import shlex
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

CLEAR_CACHES = 200  # drop compiled programs after this many cases, before they fill the memory
LONGEST = 120  # seconds after which a case that cannot be stopped ends the process


@dataclass(frozen=True)
class Ended:
    """How one case ended."""

    index: int
    command: str
    kind: str
    line: str
    """The command line."""
    change: str
    expected: str
    outcome: str
    reason: str
    code: int | None
    err: str
    seconds: float

    @property
    def bad(self) -> bool:
        from .oracle import BAD

        return self.outcome in BAD

    def __str__(self) -> str:
        change = f" with {self.kind}: {self.change}" if self.change else ""
        return f"#{self.index} `{self.line}`{change} -> {self.outcome} ({self.reason}): {self.err}"


def prepared() -> None:
    """Configure this process like that of a command, before jax is imported."""
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    from experiments import runtime

    runtime.configure()


def run_cases(seed: int, indices: Iterable[int], sound: Path) -> list[Ended]:
    """Run some cases in this process."""
    import jax

    from . import grammar, oracle, work

    ended = []
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder, work.replaced(*work.PLACES):
        for number, index in enumerate(indices, 1):
            case = grammar.case(seed, index, sound)
            line = shlex.join([case.command, *case.words])
            faulthandler.dump_traceback_later(LONGEST, exit=True)
            print(f"case {index}: {line!r} {case.kind}: {case.change!r}", file=sys.stderr)
            ran = oracle.run(case, sound, Path(folder) / "root")
            faulthandler.cancel_dump_traceback_later()
            outcome, reason = oracle.judge(case, ran)
            ended.append(
                Ended(
                    index=index,
                    command=case.command,
                    kind=case.kind,
                    line=line,
                    change=case.change,
                    expected=case.expected,
                    outcome=outcome,
                    reason=reason,
                    code=ran.code,
                    err=(ran.escaped or ran.err).strip()[-1_000:],
                    seconds=round(ran.seconds, 3),
                )
            )
            if number % CLEAR_CACHES == 0:
                jax.clear_caches()
    return ended


def _counts(title: str, names: Sequence[str], outcomes: Sequence[str]) -> str:
    """Markdown table of outcomes by name."""
    counts = Counter(zip(names, outcomes, strict=True))
    columns = sorted(set(outcomes))
    head = f"| {title} | {' | '.join(columns)} | all |\n|{' --- |' * (len(columns) + 2)}\n"
    rows = [
        f"| {name} | {' | '.join(str(counts[name, c] or '') for c in columns)} "
        f"| {sum(counts[name, c] for c in columns)} |"
        for name in sorted(set(names))
    ]
    return head + "\n".join(rows) + "\n"


def signature(one: Ended) -> str:
    """A text that failures with the same cause should have in common, to group them."""
    text = re.sub(r"'[^']*'|\d+|\S*/\S*", "..", f"{one.reason} {one.err}".splitlines()[0][:90])
    return f"{one.outcome}: {one.kind if one.kind != 'flags' else one.command + ' flags'}: {text}"


def report(ended: Sequence[Ended], seed: int) -> str:
    """The report: all counts, and the smallest example of each kind of failure."""
    outcomes = [one.outcome for one in ended]
    bad = [one for one in ended if one.bad]
    slowest = max(ended, key=lambda one: one.seconds)
    parts = [
        f"# Fuzz suite: {len(ended)} cases, seed {seed}\n",
        f"{len(bad)} ended badly. {sum(one.seconds for one in ended):.0f} s of processor time; the slowest "
        f"case is #{slowest.index} with {slowest.seconds:.1f} s.\n",
        _counts("command", [one.command for one in ended], outcomes),
        _counts("input", [one.kind for one in ended], outcomes),
    ]
    groups: dict[str, list[Ended]] = {}
    for one in bad:
        groups.setdefault(signature(one), []).append(one)
    for name, members in sorted(groups.items(), key=lambda item: (-len(item[1]), item[0])):
        smallest = min(members, key=lambda one: len(one.line) + len(one.change))
        parts.append(f"## {len(members)} x {name!r}\n\n{smallest!s:.900}\n")
    return "\n".join(parts)


def main() -> None:
    """Run some cases and report; exits with 1 if one ended badly."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="index of the first case")
    parser.add_argument("--seed", "--fuzz-seed", type=int, default=0, dest="seed")
    parser.add_argument("--sound", type=Path, help="folder of the sound material, made if missing")
    parser.add_argument("--report", type=Path, help="write the report to this file")
    parser.add_argument("--json", type=Path, help="write how each case ended to this file")
    words = parser.parse_args()
    prepared()
    from . import sound

    with tempfile.TemporaryDirectory(prefix="fuzz-sound-") as folder:
        material = sound.make((words.sound or Path(folder) / "sound").absolute())
        indices = range(words.first, words.first + words.cases)
        ended = run_cases(words.seed, indices, material)
    text = report(ended, words.seed)
    if words.json:
        words.json.write_text(json.dumps([{**asdict(one), "bad": one.bad} for one in ended]))
    if words.report:
        words.report.write_text(text)
    else:
        print(text if words.cases > 1 else ended[0])
    sys.exit(any(one.bad for one in ended))


if __name__ == "__main__":
    main()
