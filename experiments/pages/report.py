"""The report: a page that shows adaptations to the same tasks, down to every episode."""

from __future__ import annotations

import base64
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Environment
from envs.episodes import replay
from envs.errors import DataError, UsageError, printable
from envs.page import Page
from experiments.drawing import is_kept, labeled
from experiments.figures import method_styles
from experiments.pages.build import SCRIPTS, html, script_of
from experiments.pages.knowledge import knowledge_of
from experiments.pages.packing import packed, smallest
from experiments.pages.plans import plan_of
from experiments.pages.tracks import tracks_of
from experiments.pages.worlds import page_of, tasks_in_page
from experiments.store.layout import META
from experiments.store.paper import paper_final
from experiments.store.policies import far_prompts, seen_goals_of
from experiments.store.provenance import read_meta
from experiments.store.result_files import load_results
from experiments.store.results import Results
from experiments.store.rows import Row, read_row
from experiments.store.seals import write_sealed
from experiments.store.statistics import Interval, PartShare, SeedSpread, compare, same_tasks
from experiments.store.summary import ADAPT_AGAIN, method_of
from experiments.store.tables import number

ENTRY = SCRIPTS / "report.js"
REPORT = "report.html"  # name of the report in the folder of an adaptation
VERSIONS = ("python", "jax", "numpy")  # packages whose versions are shown
MOST_BYTES = 5_000_000  # maximum size of a page; a larger one leaves out what episodes did
PICTURES = {".gif": b"GIF8", ".png": b"\x89PNG"}
"""The pictures that a page can show: their suffixes, and the first bytes of their files."""


def write_report(folders: Sequence[Path], out: Path, pictures: Sequence[Path] = ()) -> None:
    """Write the page of some result folders atomically; see ``report``."""
    page = report(folders, pictures)
    write_sealed(out, lambda path: path.write_text(page, encoding="utf-8"))


def report_of_run(folder: Path) -> None:
    """Write the page of one adaptation to its folder; a page that the user changed is kept."""
    out = folder / REPORT
    if not is_kept(out):
        write_report([folder], out)
        print(printable(str(out)), file=sys.stderr)


def report(folders: Sequence[Path], pictures: Sequence[Path] = ()) -> str:
    """Make the page of some result folders.

    Args:
      folders: the result folders; videos in them are shown at the end.
      pictures: further pictures and videos to show.

    Raises:
      UsageError: if they ran on different tasks, or a picture is not one or is too large.
      DataError: if a folder is damaged.
    """
    videos = [path for folder in dict.fromkeys(folders) for path in sorted(folder.glob("*.gif"))]
    shown = [_picture(path) for path in dict.fromkeys([*pictures, *videos])]
    found = {folder: load_results(folder) for folder in dict.fromkeys(folders)}
    rows = [read_row(folder) for folder in found]
    first_folder, first = next(iter(found.items()))
    for folder, results in found.items():
        if not same_tasks(results, first):
            raise UsageError(
                f"{folder} and {first_folder} ran on different tasks; make a report of each by itself"
            )
    data = {**report_data(found, rows), "pictures": shown}
    page = _page(data, first)
    if len(page) > MOST_BYTES:
        page = _page({**data, **report_data(found, rows, with_episodes=False)}, first)
    return page


def _picture(path: Path) -> dict[str, str]:
    """A picture or a video as data for the page.

    Raises:
      UsageError: if it is not a GIF or PNG, or too large for a page.
    """
    begins = PICTURES.get(path.suffix)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UsageError(f"the picture {path} cannot be read: {error.strerror}") from None
    if begins is None or not content.startswith(begins):
        raise UsageError(
            f"{path} is not a picture that a page can show; those are GIF and PNG files"
        )
    source = f"data:image/{path.suffix[1:]};base64,{base64.b64encode(content).decode()}"
    if len(source) > MOST_BYTES:
        raise UsageError(
            f"{path} has {len(content) / 1e6:.1f} MB, a page {MOST_BYTES / 1e6:.0f} MB at most; draw fewer "
            "tasks or a shorter video"
        )
    return {"name": path.stem.replace("_", " "), "source": source}


def _page(data: Mapping[str, Any], results: Results) -> str:
    body = (SCRIPTS / "report.html").read_text(encoding="utf-8")
    return html(body, script_of(ENTRY, [page_of(results.world).script]), data)


def report_data(
    found: Mapping[Path, Results], rows: Sequence[Row], with_episodes: bool = True
) -> dict[str, Any]:
    """The data of the page, as JSON values.

    Args:
      found: adaptations to the same tasks, by folder.
      rows: their rows in a table, in the same order.
      with_episodes: whether to include what every episode did.
    """
    by_label = labeled(found)
    first = next(iter(by_label.values()))
    page, looks = page_of(first.world), method_styles(by_label)
    tasks = tasks_in_page(page, first.task_set)
    facts = [_facts(results, row) for results, row in zip(by_label.values(), rows, strict=True)]
    runs = []
    for (label, results), told in zip(by_label.items(), facts, strict=True):
        changed, note = _knowledge(results)
        arrays = _arrays_of(results, page, with_episodes) | changed
        runs.append(
            {
                "label": looks[label].name,
                "color": looks[label].color,
                "facts": told,
                "comparison": "" if results is first else _comparison(results, first),
                "note": note,
                "arrays": packed(arrays),
            }
        )
    return {
        "world": {
            "name": first.env,
            "summary": first.world.summary,
            "facts": dict(page.facts),
            "parts": list(page.parts),
        },
        "tasks": tasks,
        "optimum": first.optimal_returns.tolist() if first.optimum_known else None,
        "withEpisodes": with_episodes,
        "runs": runs,
    }


def _facts(results: Results, row: Row) -> list[tuple[str, str]]:
    """The settings and results of a run, as pairs of a name and a text."""
    summary = row.summary
    low, high = summary["final_return_iqm_95"] or (None, None)
    final = SeedSpread(summary["final_return"], summary["final_return_std_over_seeds"])
    solved, unsolvable = summary["solved_optimally"], summary.get("unsolvable_tasks", 0)
    meta = read_meta((results.folder or Path()) / META, ADAPT_AGAIN)
    shares = [
        f"p{k} {PartShare(*pair)}" for k, pair in enumerate(summary.get("part_shares") or (), 1)
    ]
    paper = paper_final(summary["env"], method_of(summary)) if row.like_the_paper else ""
    return [
        ("world", summary["env"]),
        ("method", method_of(summary)),
        ("tasks x seeds x episodes",
         f"{summary['num_tasks']} x {summary['num_seeds']} x {summary['num_episodes']}"),
        ("tasks", row.tasks),
        ("settings that differ from the defaults",
         ", ".join(f"{n}={v}" for n, v in row.settings.items()) or "none"),
        ("initial return", number(summary["initial_return"])),
        ("final return", str(final)),
        ("IQM of the final return [95 % interval]", str(Interval(summary["final_return_iqm"], low, high))),
        ("optimal return", number(summary["optimal_return"])),
        ("regret", number(summary["regret"])),
        ("regret after 40 episodes", number(summary["regret_after_40"])),
        ("solved optimally", "" if solved is None else f"{100 * solved:.0f} %"),
        ("unsolvable tasks", str(unsolvable) if unsolvable else ""),
        ("parts in order", ", ".join(shares)),
        ("paper's final return", paper),
        ("prompts far from training goals", far_prompts(results)),
        ("weights", (summary.get("policy_sha256") or "")[:12]),
        ("command", " ".join(meta.command)),
        ("revision", meta.revision),
        ("devices", meta.hardware),
        ("versions", ", ".join(f"{n} {v}" for n, v in meta.versions.items() if n in VERSIONS)),
        ("folder", row.folder),
    ]  # fmt: skip


def _comparison(results: Results, first: Results) -> str:
    """The paired comparison with the first run, in words."""
    difference, improvement = compare(results, first)
    return f"{difference} in return, better with probability {improvement}"


def _knowledge(results: Results) -> tuple[dict[str, np.ndarray], str]:
    """What the search knew after each episode, and a note if that cannot be shown."""
    try:
        knowledge = knowledge_of(results)
        if knowledge is None:
            return plan_of(results), ""
    except DataError as error:
        return {}, str(error)
    return {"arm": knowledge.row, "pulls": smallest(knowledge.pulls)}, ""


def _arrays_of(results: Results, page: Page, with_episodes: bool) -> dict[str, np.ndarray]:
    """The arrays of one run: returns, prompts, and what its episodes did, as far as that is known."""
    arrays = {
        "returns": results.returns.astype(np.float32),
        "evalEpisodes": results.eval_episodes.astype(np.uint32),
        "evalReturns": results.eval_returns.astype(np.float32),
    }
    has_rules = page.script is not None and page.track is None
    reached = results.reached if with_episodes and not has_rules else None
    goals = [np.zeros((0, results.task_goals.shape[1]), np.float32)]
    if "prompt.goals" in results.choices:
        goals += [
            part["prompt.goals"][part["prompt.mask"]] for part in (results.choices, results.best)
        ]
    if reached is not None:
        goals.append(reached.goals)
    table, index = np.unique(np.concatenate(goals), axis=0, return_inverse=True)
    arrays["goals"] = table.astype(np.float32)
    if (seen := seen_goals_of(results)) is not None:
        arrays["far"] = seen.far(table).astype(np.uint8)
    parts = np.split(index.ravel(), np.cumsum([len(part) for part in goals])[:-1])[1:]
    if "prompt.goals" in results.choices:
        arrays |= _prompts(results, parts[:2])
    if reached is not None:
        arrays["reachedCounts"] = smallest(reached.counts)
        arrays["reachedSteps"] = smallest(reached.steps)
        arrays["reachedGoals"] = smallest(parts[-1])
    if with_episodes:
        arrays |= _actions(results, page) if has_rules else tracks_of(results, page)
    return arrays


def _prompts(results: Results, index: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    """Prompts as rows of a table, numbered in order of first appearance.

    Args:
      results: the adaptation.
      index: indices into the table of goals, of the goals of the acting and of the best choices.
    """
    filled = []
    for part, places in zip((results.choices, results.best), index, strict=True):
        rows = np.zeros(part["prompt.mask"].shape, np.int64)
        rows[part["prompt.mask"]] = places + 1
        filled.append(rows)
    flat = np.concatenate([rows.reshape(-1, rows.shape[-1]) for rows in filled])
    _, first, inverse = np.unique(flat, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    numbers = np.argsort(order)[inverse.ravel()]
    choice, best = np.split(numbers, 2)
    shape = filled[0].shape[:-1]
    greedy = results.choices.get("greedy", np.zeros(shape, bool))
    return {
        "prompts": smallest(flat[first[order]]),
        "choice": smallest(_new_or_known(choice).reshape(shape)),
        "best": smallest(best.reshape(shape)),
        "greedy": greedy.astype(np.uint8),
    }


def _new_or_known(numbers: np.ndarray) -> np.ndarray:
    """Replace the first appearance of each number by 0, and all others by the number plus 1.

    Numbers must first appear in ascending order, from 0. Most are new, so this halves the compressed size.
    """
    _, first = np.unique(numbers, return_index=True)
    coded = numbers + 1
    coded[first] = 0
    return coded


def _actions(results: Results, page: Page) -> dict[str, np.ndarray]:
    """The actions of all episodes, concatenated, for a world whose rules are in the page.

    Under noise there are none, since the rules do not know how the noise changed the actions.
    """
    actions = results.actions
    noisy = results.environment != results.world.make()
    if actions is None or actions.dtype.kind == "f" or noisy:
        return {}
    real = actions != np.iinfo(actions.dtype).max
    found = {"lengths": smallest(real.sum(axis=-1)), "actions": smallest(actions[real])}
    if page.start is not None:
        if results.keys is None:
            return {}
        found["starts"] = _starts(results, page)
    return found


def _starts(results: Results, page: Page) -> np.ndarray:
    """``[S, N, E, ..]`` what the rules need of the first observation of each episode."""
    assert results.keys is not None
    assert page.start is not None
    env = results.world.make()
    seeds, num, episodes = results.keys.shape[:3]
    by_task = results.keys.swapaxes(0, 1).reshape(num, -1, 2)
    tasks = jax.tree.map(jnp.asarray, results.task_set)
    obs = np.asarray(_first_obs(env)(jnp.asarray(by_task), tasks))
    obs = obs.reshape(num, seeds, episodes, *obs.shape[2:]).swapaxes(0, 1)
    flat = obs.reshape(-1, *obs.shape[3:])
    return smallest(np.array([page.start(row) for row in flat]).reshape(*obs.shape[:3], -1))


def _first_obs(env: Environment) -> Any:
    """First observations ``[N, K, ..]`` of episodes with raw keys ``[N, K, 2]`` on N tasks."""

    def of(raw: jax.Array, task: Any) -> jax.Array:
        actions = jnp.zeros((1, *env.spec.zero_action().shape), env.spec.zero_action().dtype)
        return replay(jax.random.wrap_key_data(raw), env, task, actions, jnp.int32(0)).last_obs

    return jax.jit(jax.vmap(jax.vmap(of, (0, None))))
