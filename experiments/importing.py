"""Import logs of other programs as a dataset: read, check and write one episode after the other.

``converting`` makes the rows of a dataset of each episode; here they are written, and the manifest with
them.
"""

from __future__ import annotations

import getpass
import re
from pathlib import Path
from typing import Any

import numpy as np

from envs.errors import DataError, printable
from experiments.converting import BadEpisodeError, Converter, Rows, sized_of
from experiments.dropped_ends import Tally
from experiments.sources import Source, opened
from experiments.store.data_settings import ImportConfig
from experiments.store.provenance import versions
from mgpo_jax.dataset import finish_mapped
from mgpo_jax.files import new_folder
from mgpo_jax.growing import GrowingFiles
from mgpo_jax.progress import Progress


class Writer:
    """Writes trajectories one after the other; all must have the same arrays, shapes and dtypes."""

    def __init__(self, files: GrowingFiles) -> None:
        self.place, self.grown = files.folder, files
        self.lengths: list[int] = []

    def add(self, who: str, rows: Rows) -> None:
        files = self.grown.files
        if files and files.keys() != rows.keys():
            odd = min(files.keys() ^ rows.keys())
            raise DataError(
                f"{who} has {'no ' if odd in files else ''}{odd}, unlike those before it; "
                "log the same arrays in all episodes"
            )
        for name, file in files.items():
            array = rows[name]
            if (array.shape[1:], array.dtype) != (file.shape, file.dtype):
                raise DataError(
                    f"{who}: {name} has rows of {array.dtype}{list(array.shape[1:])}, those before have "
                    f"{file.dtype}{list(file.shape)}; import them one kind at a time"
                )
        self.grown.append(rows)
        self.lengths.append(len(rows["actions"]))

    def finish(self, manifest: dict[str, Any]) -> None:
        lengths = np.array(self.lengths, np.int32)
        names = [*self.grown.finish(), "lengths"]
        np.save(self.place / "lengths.npy", lengths)
        finish_mapped(self.place, names, len(lengths), int(lengths.sum()), manifest)


def import_dataset(config: ImportConfig) -> str:
    """Convert logs to a dataset; returns a report for the user.

    Raises:
      UsageError: if the settings do not fit the logs.
      DataError: if the logs are invalid.
    """
    assert config.out is not None
    skipped: list[str] = []
    with (
        opened(config.source) as source,
        new_folder(config.out) as place,
        GrowingFiles(place) as files,
    ):
        converter, writer, ends = Converter(config, source), Writer(files), Tally()
        horizon = _horizon(config, source)
        with Progress(source.num, "episode") as progress:
            for who, arrays in source.episodes:
                try:
                    rows = converter.rows(who, arrays)
                    _check_length(who, len(rows["actions"]), horizon)
                except BadEpisodeError as error:
                    if not config.skip_bad:
                        text = f"{error}; fix it, or leave such episodes out with --skip-bad"
                        raise DataError(text) from None
                    skipped.append(str(error))
                    continue
                writer.add(who, rows)
                if converter.dropped_end is not None:
                    ends.add(len(writer.lengths) - 1, *converter.dropped_end)
                progress.update()
        if not writer.lengths:
            raise DataError(f"{config.source} has no episode that can be used")
        manifest = _manifest(config, source, writer, horizon, skipped)
        writer.finish({**manifest, **ends.entry()})
    lengths = np.array(writer.lengths)
    said = [
        f"{config.out}: {len(lengths)} trajectories of {lengths.min()} to {lengths.max()} steps, "
        f"{lengths.sum()} in all"
    ]
    if converter.num_cut:
        said.append(
            f"  {converter.num_cut} episodes have no observation after their last action, so that action "
            "was dropped"
        )
    said += [f"  left out: {printable(text)}" for text in skipped[:5]]
    if len(skipped) > 5:
        said.append(f"  left out: {len(skipped) - 5} more")
    return "\n".join(said)


def _horizon(config: ImportConfig, source: Source) -> int | None:
    own = sized_of(source, "horizon")
    return config.horizon or (int(own[0]) if own else source.horizon)


def _check_length(who: str, length: int, horizon: int | None) -> None:
    if horizon is not None and length > horizon:
        raise BadEpisodeError(f"{who} has {length} steps, the horizon is {horizon} (see --horizon)")


def _manifest(
    config: ImportConfig,
    source: Source,
    writer: Writer,
    horizon: int | None,
    skipped: list[str],
) -> dict[str, Any]:
    """The entries of the manifest, except for hashes and counts."""
    lengths = np.array(writer.lengths)
    discrete = writer.grown.files["actions"].dtype.kind in "iu"
    size = 1 if discrete else writer.grown.files["actions"].shape[0]
    known = config.num_actions or (sized_of(source, "num_actions") or [source.num_actions])[0]
    cut = sized_of(source, "cut_in_hindsight")
    if discrete and known is None:
        writer.grown.files["actions"].file.flush()
        path = writer.place / "actions.npy"
        known = 1 + int(
            np.fromfile(path, np.int32, offset=writer.grown.files["actions"].start).max()
        )
    stem = config.name or Path(config.source).absolute().stem
    spec = {
        "name": re.sub(r"[^\w.-]", "-", stem).lstrip("-.")[:100] or "data",
        "horizon": int(horizon or lengths.max()),
        "num_actions": int(known) if discrete else None,
        "truncate_in_hindsight": bool(cut[0]) if cut and config.cut else config.cut,
    }
    for name in ("action_low", "action_high"):
        bounds = list(getattr(config, name)) or sized_of(source, name) or []
        spec[name] = bounds * size if len(bounds) == 1 else bounds
    goal = config.goal or config.goal_array or list(config.goal_columns) or "achieved_goals"
    return {
        "spec": spec,
        "imported": {
            "source": str(config.source),
            "kind": source.kind,
            "author": source.author,
            "by": _user(),
            "goal": goal,
            "obs_arrays": list(config.obs_arrays),
            "reached": config.reached,
            "left_out": len(skipped),
        },
        "versions": versions(),
        "length": {
            "mean": float(lengths.mean()),
            "quartiles": np.percentile(lengths, [0, 25, 50, 75, 100]).tolist(),
        },
    }


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # the user has no name, as in some containers
        return ""
