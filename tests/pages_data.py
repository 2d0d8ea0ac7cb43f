"""Saved results for pages, and what is in a page: its elements and its data."""

from __future__ import annotations

import json
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

from experiments.store.result_files import save_results
from experiments.store.results import Results
from experiments.store.summary import summarize


def saved(folder: Path, results: Results) -> Path:
    summary = summarize(
        results, policy_sha256="0" * 64, num_episodes=80, num_failed=0, cpu_seconds=1.0
    )
    save_results(folder, replace(results, summary=summary))
    return folder


def config_of(env: str, method: str = "ucb", **more: Any) -> dict[str, Any]:
    return {"env": env, "method": method, "policy": None, **more}


class Elements(HTMLParser):
    """The elements of a page, with the content of scripts and styles."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[int, str] = {}
        self.is_open = False
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        self.is_open = True

    def handle_endtag(self, tag: str) -> None:
        self.is_open = False

    def handle_data(self, data: str) -> None:
        place = len(self.found) - 1
        if self.is_open:
            self.texts[place] = self.texts.get(place, "") + data

    def of(self, tag: str) -> list[tuple[dict[str, str | None], str]]:
        return [
            (attrs, self.texts.get(place, ""))
            for place, (name, attrs) in enumerate(self.found)
            if name == tag
        ]


def data_of(page: str) -> Any:
    (text,) = [text for attrs, text in Elements(page).of("script") if attrs.get("id") == "data"]
    return json.loads(text)
