"""Early stopping: a search runs no more episodes once its best choice is judged good enough.

All lanes of a program run together, so the lane of a search that has ended runs episodes that end before
their first step (``adaptation.idle_when``). After each judgement the host decides which searches have
ended, and fills in the results that their lanes no longer produce.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from mgpo_jax.adaptation import AdaptLog, Judged


def ended(judged: Sequence[Judged], stop_at: float) -> np.ndarray:
    """Which lanes [L] have ever been judged at a return of ``stop_at`` or more."""
    return np.any([one.return_ >= stop_at for one in judged], axis=0)


def filled(
    log: AdaptLog, judged: Judged, stopped: np.ndarray, before: Sequence[tuple[AdaptLog, Judged]]
) -> tuple[AdaptLog, Judged]:
    """Fill in the results of stopped lanes in a part of a segment.

    Args:
      log: the log of the part, rows of L lanes.
      judged: the latest judgement (``Part.judged``).
      stopped: which searches had ended before the segment, [L].
      before: logs and judgements of the earlier parts, of which the first has only a judgement.

    Returns:
      The log and the judgement. In the rows of stopped lanes, returns are the best one of any earlier
      episode (that of the first judgement if there was no episode), and the judgement is the previous one.
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
