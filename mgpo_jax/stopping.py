"""Searches that end early: as soon as their best choice is judged good enough, they use no more episodes.

Lanes of one program go on together, so that a search that has ended is a lane whose episodes end before
their first step (``adaptation.idle_when``). The host decides after each judgement which lanes those are,
and fills in what their episodes did not find.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from mgpo_jax.adaptation import AdaptLog, Judged


def ended(judged: Sequence[Judged], stop_at: float) -> np.ndarray:
    """Which lanes [L] have been judged at ``stop_at`` or more."""
    return np.any([one.return_ >= stop_at for one in judged], axis=0)


def filled(
    log: AdaptLog, judged: Judged, stopped: np.ndarray, before: Sequence[tuple[AdaptLog, Judged]]
) -> tuple[AdaptLog, Judged]:
    """A segment in which the lanes that had stopped keep what they had reached.

    Args:
      log: of the segment, rows of L lanes.
      judged: the judgement after it.
      stopped: [L] which searches had ended before it.
      before: logs and judgements of the segments before, of which the first has a judgement only.

    Returns:
      The log, in which the returns of these searches are the best that any of their episodes had (that of
      the first judgement where there was no episode), and the judgement before.
    """
    last = before[-1][1]
    rows = [one.returns.reshape(len(stopped), -1) for one, _ in before]
    best = np.concatenate([before[0][1].return_[:, None], *rows[1:]], axis=1)
    best = best[:, 1:].max(axis=1) if best.shape[1] > 1 else best[:, 0]
    returns = np.where(stopped[:, None, None], best[:, None, None], log.returns)

    def kept(new: np.ndarray, old: np.ndarray) -> np.ndarray:
        return np.where(stopped.reshape(-1, *[1] * (new.ndim - 1)), old, new)

    judged = jax.tree.map(kept, judged, last)
    num_failed: Any = np.where(stopped, 0, judged.num_failed)
    held: Any = returns.astype(log.returns.dtype)
    return log._replace(returns=held), judged._replace(num_failed=num_failed)
