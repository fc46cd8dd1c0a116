"""Read the options of ``run`` from a TOML file."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

from oodd_eval.errors import UsageError


def options_of(file: str) -> list[str]:
    """Return a TOML file's content as command-line options.

    Keys are long option names. Lists become comma lists, ``true`` a flag, and a table ``param`` one
    ``--param`` each.

    Raises
    ------
    UsageError
        When the file cannot be read.
    """
    try:
        content = tomllib.loads(Path(file).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError(f"configuration file {file!r} cannot be read: {error}") from None
    options: list[str] = []
    for name, value in content.items():
        options += _options(file, name, value)
    return options


def _options(file: str, name: str, value: Any) -> list[str]:
    match value:
        case dict() if name == "param":
            return [f"--param={key}={json.dumps(v)}" for key, v in value.items()]
        case True:
            return [f"--{name}"]
        case False:
            return []
        case list() if all(isinstance(v, str | int) for v in value):
            return [f"--{name}={','.join(map(str, value))}"]
        case str() | int():
            return [f"--{name}={value}"]
    raise UsageError(f"configuration file {file!r}: {name} is {value!r}, which no option takes")
