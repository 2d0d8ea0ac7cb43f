"""Bundle JavaScript modules, a style sheet and data into one HTML file that needs no server or network.

Modules are joined unchanged, except that comments with types (JSDoc) are removed. Each becomes a function
that returns its exports, so that their names cannot clash. Two forms of module syntax are supported:
``import { a, b } from "./x.js"`` on one line, and ``export`` before ``const``, ``function`` and ``class``.
The page's Content-Security-Policy allows its own script and style by their hashes, and pictures within the
file. Data is embedded as JSON that an HTML parser cannot mistake for markup.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

SCRIPTS = Path(__file__).parent / "js"
IMPORT = re.compile(r'^import \{ (\w+(?:, \w+)*) \} from "(\./[\w-]+\.js)";$', re.M)
EXPORT = re.compile(r"^export (?=(?:const|(?:async )?function\*?|class) (\w+))", re.M)
TYPES = re.compile(r"^[ \t]*/\*\*(?:(?!\*/).)*\*/([^\n]*)\n", re.M | re.S)
"""A comment that begins with its line, and what follows it on its last line."""
OTHER_SYNTAX = re.compile(r"^(?:import|export)\b.*$", re.M)


class Bundle:
    """Modules, ordered so that each comes after those that it imports."""

    def __init__(self) -> None:
        self._names: dict[Path, str] = {}
        self._parts: list[str] = []

    def add(self, path: Path, above: tuple[Path, ...] = ()) -> str:
        """Add a module and those that it imports.

        Args:
          path: the module.
          above: the modules that import it.

        Returns:
          The name of the variable that holds its exports.

        Raises:
          ValueError: if imports are circular, or a module has unsupported module syntax.
        """
        path = path.resolve()
        if path in above:
            raise ValueError(f"{path.name} imports itself through {above[-1].name}")
        if path not in self._names:
            source = _without_types(path)

            def imported(match: re.Match[str]) -> str:
                of = self.add(path.parent / match[2], (*above, path))
                return f"const {{ {match[1]} }} = {of};"

            source = IMPORT.sub(imported, source)
            exports = EXPORT.findall(source)
            source = EXPORT.sub("", source)
            if other := OTHER_SYNTAX.search(source):
                raise ValueError(f"{path.name}: {other[0]!r} is not among the syntax of build.py")
            name = f"module{len(self._names)}"
            self._names[path] = name
            result = f"return {{ {', '.join(exports)} }};"
            self._parts.append(f"const {name} = (() => {{\n{source}\n{result}\n}})();\n")
        return self._names[path]

    @property
    def source(self) -> str:
        """All modules as one script."""
        return '"use strict";\n' + "".join(self._parts)


def _without_types(path: Path) -> str:
    """The source of a module without its comments with types.

    Raises:
      ValueError: if code follows such a comment on its line.
    """

    def removed(match: re.Match[str]) -> str:
        if code := match[1].strip():
            raise ValueError(f"{path.name}: {code!r} must be on a line below the comment before it")
        return ""

    return TYPES.sub(removed, path.read_text(encoding="utf-8"))


def script_of(entry: Path, worlds: Sequence[Path | None]) -> str:
    """The script of a page: its modules, those of some worlds, and the call that starts it.

    Args:
      entry: the main module of the page, which exports ``main(worlds, data)``.
      worlds: the modules of the worlds; None for a world without one.
    """
    bundle = Bundle()
    found = [f"{bundle.add(path)}.world" if path else "null" for path in worlds]
    begin = f"{bundle.add(entry)}.main"
    data = 'JSON.parse(document.getElementById("data").textContent)'
    return f"{bundle.source}{begin}([{', '.join(found)}], {data});\n"


def html(body: str, script: str, data: Mapping[str, Any]) -> str:
    """A complete HTML page.

    Args:
      body: the markup of the page, from this package and never from a user's file.
      script: the script of the page.
      data: JSON values, whose texts may come from anywhere.

    Raises:
      ValueError: if the script contains text that would end its own element.
    """
    if "</script" in script.lower() or "<!--" in script:
        raise ValueError("a script of a page must not hold </script or <!--; write '<\\/script'")
    style = (SCRIPTS / "style.css").read_text(encoding="utf-8")
    policy = (
        f"default-src 'none'; script-src {_hash(script)}; style-src {_hash(style)}; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<style>{style}</style>\n</head>\n<body>\n{body}"
        f'<script type="application/json" id="data">{as_text(data)}</script>\n'
        f"<script>{script}</script>\n</body>\n</html>\n"
    )


def as_text(data: Any) -> str:
    """JSON without characters that could end the enclosing HTML element; raises ``ValueError`` for NaN."""
    text = json.dumps(data, allow_nan=False, ensure_ascii=True, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _hash(content: str) -> str:
    """The hash of an inline script or style in a Content-Security-Policy."""
    digest = hashlib.sha256(content.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"
