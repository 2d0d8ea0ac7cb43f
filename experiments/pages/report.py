"""The report: a page that shows adaptations to the same tasks, down to every episode."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from envs.errors import DataError, UsageError, printable
from experiments.drawing import is_kept, labeled
from experiments.figures import method_styles
from experiments.pages.build import SCRIPTS, html, script_of
from experiments.pages.colors import run_colors
from experiments.pages.knowledge import knowledge_of
from experiments.pages.packing import packed, smallest
from experiments.pages.pictures import Picture, read_picture, those_with_room
from experiments.pages.plans import plan_of
from experiments.pages.runs import LEFT_OUT, Arrays, Detail, arrays_of, stages_of
from experiments.pages.worlds import page_of, tasks_in_page
from experiments.store.layout import META
from experiments.store.paper import paper_final
from experiments.store.policies import far_prompts
from experiments.store.provenance import read_meta
from experiments.store.result_files import load_results
from experiments.store.results import Results
from experiments.store.rows import Row, read_row
from experiments.store.seals import write_sealed
from experiments.store.statistics import Interval, PartShare, SeedSpread, compare, same_tasks
from experiments.store.summary import ADAPT_AGAIN, method_of
from experiments.store.summary_text import named_goal_rows, sampling_rows
from experiments.store.tables import number

ENTRY = SCRIPTS / "report.js"
REPORT = "report.html"  # name of the report in the folder of an adaptation
VERSIONS = ("python", "jax", "numpy")  # packages whose versions are shown
MOST_BYTES = 5_000_000  # maximum size of a page; a larger one leaves out pictures and details
LARGE = f"Left out, because the page would have more than {MOST_BYTES / 1e6:.0f} MB: {{}}."
NOTHING_KNOWN = (
    "Shown for methods that keep arms, a map, an order or an estimate of prompts. {} keeps none of these, "
    "or its settings are those of an older version."
)


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
      pictures: further pictures and videos to show, before those.

    Raises:
      UsageError: if they ran on different tasks, or a picture is not one or is too large.
      DataError: if a folder is damaged.
    """
    found = {folder: load_results(folder) for folder in dict.fromkeys(folders)}
    videos = [path for folder in dict.fromkeys(folders) for path in sorted(folder.glob("*.gif"))]
    named = [read_picture(path, MOST_BYTES) for path in dict.fromkeys(pictures)]
    shown = [*named, *(read_picture(path) for path in videos if path not in pictures)]
    rows = [read_row(folder) for folder in found]
    first_folder, first = next(iter(found.items()))
    for folder, results in found.items():
        if not same_tasks(results, first):
            raise UsageError(
                f"{folder} and {first_folder} ran on different tasks; make a report of each by itself"
            )
    page = _largest_page(found, rows, shown)
    if (size := len(page.encode())) > MOST_BYTES:
        print(f"the report has {size / 1e6:.1f} MB, and cannot be made smaller", file=sys.stderr)
    return page


def _largest_page(
    found: Mapping[Path, Results], rows: Sequence[Row], pictures: Sequence[Picture]
) -> str:
    """The page with as many details, and then as many pictures, as it may have bytes."""
    first = next(iter(found.values()))
    bare, known = _bare_data(found, rows), [_knowledge(results) for results in found.values()]

    def data_of(detail: Detail) -> dict[str, Any]:
        return _with_arrays(bare, found, known, detail)

    def size_of(data: Mapping[str, Any]) -> int:
        return len(_page(data, first).encode())

    stages = stages_of(page_of(first.world))
    # To draw episodes on a map takes long, and is of no use if there is no room for the rest already.
    later = stages[1:] if Detail.NO_TRACKS in stages else stages
    for detail in later:
        data = data_of(detail)
        if size_of(data) <= MOST_BYTES:
            break
    if detail == Detail.NO_TRACKS and size_of(whole := data_of(Detail.ALL)) <= MOST_BYTES:
        data = whole
    kept, others = those_with_room(pictures, MOST_BYTES - size_of(data) - len(LARGE))
    left_out = [
        *data["notes"],
        *([LARGE.format("the pictures " + ", ".join(others))] if others else []),
    ]
    for note in left_out:
        print(printable(note), file=sys.stderr)
    notes = left_out if pictures else [*left_out, *_how_to_draw(first)]
    return _page({**data, "pictures": kept, "notes": notes}, first)


def _page(data: Mapping[str, Any], results: Results) -> str:
    body = (SCRIPTS / "report.html").read_text(encoding="utf-8")
    return html(body, script_of(ENTRY, [page_of(results.world).script]), data)


def report_data(
    found: Mapping[Path, Results], rows: Sequence[Row], detail: Detail = Detail.ALL
) -> dict[str, Any]:
    """The data of the page without pictures, as JSON values.

    Args:
      found: adaptations to the same tasks, by folder.
      rows: their rows in a table, in the same order.
      detail: how much the page shows.
    """
    known = [_knowledge(results) for results in found.values()]
    return _with_arrays(_bare_data(found, rows), found, known, detail)


def _bare_data(found: Mapping[Path, Results], rows: Sequence[Row]) -> dict[str, Any]:
    """The data of the page that does not depend on its details."""
    by_label = labeled(found)
    first = next(iter(by_label.values()))
    page, looks = page_of(first.world), method_styles(by_label)
    colors = run_colors([looks[label].color for label in by_label])
    runs = [
        {
            "label": looks[label].name,
            "colors": color,
            "facts": _facts(results, row),
            "comparison": "" if results is first else _comparison(results, first),
        }
        for (label, results), row, color in zip(by_label.items(), rows, colors, strict=True)
    ]
    return {
        "world": {
            "name": first.env,
            "summary": first.world.summary,
            "facts": dict(page.facts),
            "parts": list(page.parts),
        },
        "tasks": tasks_in_page(page, first.task_set),
        "optimum": first.optimal_returns.tolist() if first.optimum_known else None,
        "runs": runs,
    }


def _with_arrays(
    bare: Mapping[str, Any],
    found: Mapping[Path, Results],
    known: Sequence[tuple[Arrays, str]],
    detail: Detail,
) -> dict[str, Any]:
    """The data of the page with what the runs did and knew, as far as the details include it."""
    runs = [
        {**run, "note": note, "arrays": packed(arrays_of(results, arrays, detail))}
        for run, results, (arrays, note) in zip(bare["runs"], found.values(), known, strict=True)
    ]
    stages = stages_of(page_of(next(iter(found.values())).world))
    left_out = [LEFT_OUT[stage] for stage in stages if Detail.ALL < stage <= detail]
    notes = [LARGE.format(", ".join(left_out))] if left_out else []
    return {**bare, "runs": runs, "notes": notes, "withEpisodes": detail < Detail.NO_COURSES}


def _how_to_draw(first: Results) -> list[str]:
    """How to get pictures of a world whose episodes the page cannot draw, if there are any.

    The page shows a note that begins with ``python`` as a command.
    """
    make = first.world.pictures
    if page_of(first.world).script is not None or make is None or first.best_goals(0, 0) is None:
        return []
    pictures = make(first.world.make())
    if not (pictures.video or pictures.frame):
        return []
    folder = shlex.quote(str(first.folder))
    own = f" --env {shlex.quote(first.env)}" if ":" in first.env else ""
    return [
        "This page cannot draw the episodes of this world. Pictures and videos of them are made by",
        f"python -m experiments.plot {folder}{own} --tasks 0 --out figures-of-report",
        "and are shown at the end of the page that is made by",
        f"python -m experiments.report {folder}{own} --pictures figures-of-report/*.gif",
    ]


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
        *_named_figures(summary),
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


NAMED_FIGURES = {
    "best single episode": "best single episode",
    "fresh": "fresh",
    "  minus initial": "fresh minus initial",
    "score": "score",
    "goals achieved": "goals achieved",
}
"""The rows that worlds have where single episodes are luck or goals have names: their labels in a printed
summary, and in a page."""


def _named_figures(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What a printed summary says of sampled episodes and named goals; empty texts where it says nothing.

    Every run of a page has all of these rows, since the page compares runs row by row.
    """
    said = dict(sampling_rows(summary) + named_goal_rows(summary))
    return [(name, said.get(label, "")) for label, name in NAMED_FIGURES.items()]


def _comparison(results: Results, first: Results) -> str:
    """The paired comparison with the first run, in words."""
    difference, improvement = compare(results, first)
    return f"{difference} in return, better with probability {improvement}"


def _knowledge(results: Results) -> tuple[Arrays, str]:
    """What the search knew after each episode, and a note if that cannot be shown."""
    try:
        knowledge = knowledge_of(results)
        known = plan_of(results) if knowledge is None else {}
    except DataError as error:
        return {}, str(error)
    if knowledge is not None:
        return {"arm": knowledge.row, "pulls": smallest(knowledge.pulls)}, ""
    has_prompts = "prompt.goals" in results.choices
    return known, NOTHING_KNOWN.format(results.method) if has_prompts and not known else ""
