"""What mkdocs does not do by itself: the navigation, and pages that are made of other files.

The site has pages that no file in ``docs`` holds: the README is its home, ``CONTRIBUTING.md`` and
``CHANGELOG.md`` are pages, the tour is shown with its outputs, and the reference lists the public names.
"""

from __future__ import annotations

import ast
import json
import posixpath
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
DOCS = "docs"
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "docs/tour.ipynb": "tour.md",
}
"""Files of the repository that are pages of the site under another name."""
MODULES = (
    "envs.base",
    "envs.specs",
    "envs.agents",
    "envs.registry",
    "envs.gymnasium_world",
    "envs.live",
    "envs.to_gymnasium",
    "envs.checks",
    "mgpo_jax.adaptation",
    "mgpo_jax.methods",
    "mgpo_jax.optimizers.base",
)
"""Modules that users extend; each has a page of the reference to itself."""
PACKAGE = "mgpo_jax"
OUTSIDE = re.compile(r"[a-z][a-z0-9+.-]*:", re.IGNORECASE)  # http:, mailto:, data:

SECTIONS: tuple[tuple[str, Sequence[str]], ...] = (
    ("Home", ["index.md"]),
    ("Guides", ["install.md", "tour.md", "training.md", "guides/*", "export.md", "pages.md"]),
    ("Results", ["results.md", "ablations.md", "baselines.md", "differences.md"]),
    ("How it works", ["architecture.md", "plan.md", "environments.md"]),
    ("API reference", ["api/mgpo_jax.md", *(f"api/{name}.md" for name in MODULES)]),
    ("Speed", ["speed.md"]),
    ("Scale", ["scale.md"]),
    ("Safety", ["safety.md"]),
    ("Limitations", ["limitations.md"]),
    ("Project", ["contributing.md", "changelog.md"]),
)
"""The navigation. A name that ends in ``*`` stands for all pages of a folder; a page that is not there is
left out, and pages that no section names are in one of their own, the last."""
REST = "More"


def navigation(pages: Sequence[str]) -> list[dict[str, Any]]:
    """The navigation of a site that has these pages.

    Args:
      pages: paths of all pages within the site, such as ``guides/own-data.md``.
    """
    left, entries = sorted(pages), []
    for title, patterns in (*SECTIONS, (REST, ["*"])):
        found = []
        for pattern in patterns:
            is_folder = pattern.endswith("*")
            found += [
                page
                for page in left
                if page not in found
                and (page.startswith(pattern[:-1]) if is_folder else page == pattern)
            ]
        left = [page for page in left if page not in found]
        alone = len(found) == 1 and len(patterns) == 1 and title != REST
        if found:
            entries.append({title: found[0] if alone else found})
    return entries


def place_in_site(path: str) -> str | None:
    """Where a file of the repository is in the site; None if it is not there."""
    if path in PAGES:
        return PAGES[path]
    folder, _, name = path.partition("/")
    return name if folder == DOCS and name else None


def links_in_site(text: str, source: str) -> str:
    """A Markdown text whose links and pictures hold in the site.

    Links to files of the repository that are no part of the site become plain text.

    Args:
      text: the text.
      source: its file, as a path within the repository.
    """
    here = posixpath.dirname(place_in_site(source) or "")

    def target(link: str) -> str | None:
        path, mark, anchor = link.partition("#")
        if not path or OUTSIDE.match(link):
            return link
        there = place_in_site(posixpath.normpath(posixpath.join(posixpath.dirname(source), path)))
        return None if there is None else posixpath.relpath(there, here or ".") + mark + anchor

    def link(match: re.Match[str]) -> str:
        to = target(match[2])
        return match[1] if to is None else f"[{match[1]}]({to})"

    def picture(match: re.Match[str]) -> str:
        return f'src="{target(match[1]) or match[1]}"'

    # The text of a link may hold code, so links are looked for in the whole line.
    fences = re.split(r"(^```.*?^```[^\n]*$)", text, flags=re.DOTALL | re.MULTILINE)
    for index in range(0, len(fences), 2):
        changed = re.sub(r"\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s]+)\)", link, fences[index])
        fences[index] = re.sub(r'src="([^"]+)"', picture, changed)
    return "".join(fences)


def imports(module: str) -> dict[str, str]:
    """Names that a package imports, with the place that each comes from; empty for a module."""
    path = ROOT.joinpath(*module.split("."), "__init__.py")
    tree = ast.parse(path.read_text()) if path.is_file() else ast.Module([], [])
    return {
        alias.asname or alias.name: f"{line.module}.{alias.name}"
        for line in ast.walk(tree)
        if isinstance(line, ast.ImportFrom)
        for alias in line.names
    }


def public_names() -> dict[str, str]:
    """The public names of the package and the place where each is defined, read from its source."""
    hidden = ("Any", "TYPE_CHECKING", "annotations")
    names = {name: place for name, place in imports(PACKAGE).items() if name not in hidden}
    for name, place in names.items():
        module, _, attribute = place.rpartition(".")
        # A package may import a function from a module of the same name.
        names[name] = imports(module).get(attribute, place)
    return names


def reference() -> Iterator[tuple[str, str]]:
    """Path and Markdown text of each page of the reference."""
    for module in MODULES:
        yield (
            f"api/{module}.md",
            f"# {module}\n\n::: {module}\n    options: {{show_root_heading: false}}\n",
        )
    names = public_names()
    lines = [
        f"# {PACKAGE}",
        "",
        f"Everything here is imported as `from {PACKAGE} import NAME`.",
        "",
        *(f"- [`{name}`][{place}]" for name, place in sorted(names.items())),
        "",
    ]
    for place in sorted(names.values()):
        if place.rpartition(".")[0] not in MODULES:
            lines += [f"::: {place}", ""]
    yield f"api/{PACKAGE}.md", "\n".join(lines)


def tour_page(notebook: dict[str, Any]) -> str:
    """A notebook as Markdown: its text, its code, and what that printed and drew."""
    blocks = []
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            blocks.append(source)
            continue
        blocks.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            data = output.get("data", {})
            if "image/png" in data:
                picture = "".join(data["image/png"]).strip()
                blocks.append(f"![what the code above draws](data:image/png;base64,{picture})")
            elif text := "".join(output.get("text", data.get("text/plain", []))).rstrip():
                blocks.append(f"```text\n{text}\n```")
    return "\n\n".join(blocks) + "\n"


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that are made of other files, and set the navigation."""
    from mkdocs.structure.files import File

    made = dict(reference())
    for source, page in PAGES.items():
        if (path := ROOT / source).is_file():
            text = path.read_text()
            text = tour_page(json.loads(text)) if path.suffix == ".ipynb" else text
            made[page] = links_in_site(text, source)
    for page, text in made.items():
        files.append(File.generated(config, page, content=text))
    config.nav = navigation([file.src_uri for file in files.documentation_pages()])
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Mend the links of pages that are files in ``docs``."""
    if page.file.generated_by:
        return markdown
    return links_in_site(markdown, f"{DOCS}/{page.file.src_uri}")
