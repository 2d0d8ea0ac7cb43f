"""Ends of episodes that an import dropped with their last actions.

Logs with one observation for each action do not show the result of the last action, so an import drops that
action, and with it the mark that says how the episode ended. The manifest keeps what the logs said, so that
the check can still find ends that were marked wrongly.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from mgpo_jax.manifest import DroppedEnds, EndCount

KINDS = ("terminated", "truncated", "both", "neither")


class Tally:
    """Counts how episodes ended whose last action was dropped."""

    def __init__(self) -> None:
        self._found: dict[str, dict[int, list[int]]] = {kind: {} for kind in KINDS}

    def add(self, trajectory: int, kind: str, steps: int) -> None:
        """Count one episode.

        Args:
          trajectory: its index in the dataset.
          kind: how it ended, one of ``KINDS``.
          steps: the number of its actions in the logs.
        """
        self._found[kind].setdefault(steps, []).append(trajectory)

    def entry(self) -> dict[str, Any]:
        """The entry of the manifest; empty if nothing was counted."""
        if not any(self._found.values()):
            return {}
        ends = DroppedEnds(**{kind: _counts(found) for kind, found in self._found.items()})
        return {"dropped_ends": ends.model_dump()}


def _counts(found: dict[int, list[int]]) -> list[EndCount]:
    """The counts of episodes that ended in one way, of which the trajectories are given by length."""
    return [
        EndCount(steps=steps, episodes=len(trajectories), first=trajectories[0])
        for steps, trajectories in sorted(found.items())
    ]


def kind_of_end(terminated: bool, truncated: bool) -> str:
    """One of ``KINDS`` for the marks of an episode's last step."""
    if terminated and truncated:
        return "both"
    return "truncated" if truncated else "terminated" if terminated else "neither"


def wrong_ends(ends: DroppedEnds, horizon: int) -> Iterator[tuple[str, str, str]]:
    """Find time limits that were logged as terminations, and the reverse.

    The rules are those for ends that the dataset still has, with one finding for each length instead of one
    for each trajectory. They apply to the lengths in the logs; the
    horizon is that of the dataset, or the longest episode of the logs if that is longer.

    Args:
      ends: what the logs said.
      horizon: the horizon of the dataset.

    Yields:
      ``fault`` or ``note``, the kind of finding, and a sentence.
    """
    counts = {kind: list(getattr(ends, kind)) for kind in KINDS}
    horizon = max([horizon, *(one.steps for found in counts.values() for one in found)])
    at = {kind: [one for one in found if one.steps == horizon] for kind, found in counts.items()}
    whole = sum(one.episodes for found in at.values() for one in found)
    for one in at["terminated"]:
        if one.episodes >= 3 and one.episodes >= 0.9 * whole:
            yield (
                "fault",
                "time limits",
                f"trajectory {one.first}, step {horizon - 1} of its logs: it is marked as terminated at "
                f"the very horizon, as {one.episodes} of {whole} of this length are; a time limit is a "
                "truncation, or terminals and timeouts are swapped",
            )
    early = [one for one in counts["truncated"] if one.steps < horizon]
    if early and (at["truncated"] or at["both"]):
        num = sum(one.episodes for one in early)
        yield (
            "note",
            "cut early",
            f"trajectory {early[0].first}, step {early[0].steps - 1} of its logs: it is marked as "
            f"truncated before the horizon of {horizon}, as {num} are; an end of the task is a termination",
        )


def in_words(ends: DroppedEnds | None) -> str:
    """What is added to a description of the ends of a dataset; empty if nothing was dropped."""
    if ends is None:
        return ""
    nums = {kind: sum(one.episodes for one in getattr(ends, kind)) for kind in KINDS}
    told = ", ".join(f"{num} {kind}" for kind, num in nums.items() if num or kind != "both")
    return f"; in the logs {told}, which was dropped with their last actions"
